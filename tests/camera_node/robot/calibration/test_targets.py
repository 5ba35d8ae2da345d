"""The real detectors on pictures whose true pose is known; boards of both prints; a board that is not found; a lens
from what is found."""

import json

import cv2
import numpy as np
import pytest

from camera_node.cli import main
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.samples import angle_deg
from camera_node.robot.calibration.inputs import find_corners, list_images, read_lens
from camera_node.robot.calibration.lens_calibration import calibrate_lens
from camera_node.robot.calibration.targets import WHICH_PRINT, Corners, estimate_pose, parse_target
from camera_node.sources.rig_calibration import load_calibration
from freshfield.geometry import Pinhole, look_at, se3_inverse, so3_exp
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.known_truth import BOARD, photo
from tests.support import refused, turned_jpeg

LENS = Pinhole(400, 300, 330.0, 332.0, 203.0, 148.0, (-0.05, 0.02, 0.001, -0.001))


def found_in(folder, spec):
    return find_corners(list_images(folder), parse_target(spec), None, lambda done: None)


@pytest.mark.parametrize(("spec", "origin_m"), [("charuco:7x5:24mm:18mm", 0.0), ("chessboard:7x4:20mm", 2 * 0.02)])
def test_a_rendered_target_is_found_where_it_is_and_only_where_it_is(spec, origin_m):
    """Upside down, too. origin_m: where a picture's own origin lies in its target's axes: a chessboard's is its first
    inner corner."""
    target = parse_target(spec)
    middle = np.array([*target.size_m, 0.0]) / 2
    for x, y, z, roll in ((0.05, 0.08, -0.22, 0.4), (-0.07, 0.03, -0.20, 3.3)):
        camera = look_at(middle + np.array([x, y, z]), middle, up=(0.0, -1.0, 0.0))
        camera[:3, :3] = camera[:3, :3] @ so3_exp([0, 0, roll])
        found = estimate_pose(target.find(photo(target, LENS, camera)), LENS)
        truth = se3_inverse(camera)
        truth[:3, 3] += truth[:3, :3] @ [origin_m, origin_m, 0.0]
        assert angle_deg(found, truth) < 0.1
        assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) * 1e3 < 0.1
    noise = np.random.default_rng(0).integers(0, 256, (120, 160)).astype(np.uint8)
    for picture in (np.zeros((120, 160), np.uint8), noise):
        assert target.find(picture) is None


def test_a_chessboard_is_the_same_way_up_however_it_is_held():
    """Its first corner stays the first: the picture is turned and the corners with it."""
    target = parse_target("chessboard:7x4:20mm")
    straight = cv2.GaussianBlur(target.draw(600), (0, 0), 1.0)
    x, y = target.find(straight).pixels[0]
    height, width = straight.shape
    for turn, expected in (
        (cv2.ROTATE_90_CLOCKWISE, (height - y, x)),
        (cv2.ROTATE_180, (width - x, height - y)),
        (cv2.ROTATE_90_COUNTERCLOCKWISE, (y, width - x)),
    ):
        np.testing.assert_allclose(target.find(cv2.rotate(straight, turn)).pixels[0], expected, atol=0.1)


def test_a_small_tag_seen_straight_on_may_be_tilted_either_way():
    points = np.array([[0, 0, 0], [0.02, 0, 0], [0.02, 0.02, 0], [0, 0.02, 0]])
    pixels = LENS.project(points - [0.01, 0.01, -0.8])
    wobble = np.random.default_rng(0).normal(0, 0.05, pixels.shape)
    refused(CalibrationError, "tilted either way", estimate_pose, Corners(pixels + wobble, points), LENS)


def test_specs_that_are_none_say_what_is_one():
    for spec, why in (
        ("circles:3x4", "no kind 'circles'"),
        ("chessboard:9x6:23.6", "needs a unit"),
        ("chessboard:8x6:20mm", "odd and the other even"),
    ):
        refused(CalibrationError, rf"charuco:7x5:30mm:22mm .*{why}", parse_target, spec)


def printed(across: int, down: int, legacy: bool = False) -> np.ndarray:
    """A board of squares of 80 pixels, with 40 of white around it."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((across, down), 0.03, 0.022, dictionary)
    board.setLegacyPattern(legacy)
    return np.pad(board.generateImage((80 * across, 80 * down)), 40, constant_values=255)


def assert_where_printed(corners: Corners) -> None:
    np.testing.assert_allclose(corners.pixels, 40 + corners.points[:, :2] / 0.03 * 80, atol=0.5)


@pytest.mark.parametrize(
    ("legacy", "columns", "decided"),
    [
        (True, (0, 4), False),  # 21 corners of each print
        (True, (1, 5), True),  # 14 and 21
        (False, (1, 5), False),
    ],
)
def test_parts_that_fit_both_prints_are_told_by_a_whole_board_among_them(legacy, columns, decided, tmp_path):
    whole = printed(5, 8, legacy)
    part = np.full_like(whole, 255)
    seen = np.s_[:, 40 + 80 * columns[0] : 40 + 80 * columns[1]]
    part[seen] = whole[seen]
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), part)
    found, unused, _ = found_in(tmp_path, "charuco:5x8:30mm:22mm")
    assert len(found) == 3 * decided == 3 - len(unused) and set(unused.values()) <= {WHICH_PRINT}
    cv2.imwrite(str(tmp_path / "3.png"), whole)
    found, unused, _ = found_in(tmp_path, "charuco:5x8:30mm:22mm")
    assert len(found) == 4 and not unused
    for corners in found.values():
        assert_where_printed(corners)


CHESSBOARD = cv2.GaussianBlur(parse_target("chessboard:8x5:20mm").draw(600), (0, 0), 1.0)


def test_a_board_that_is_not_found_is_examined():
    for spec, image, says in (
        ("charuco:7x5:30mm:22mm", printed(5, 7), "its sizes are swapped: 5x7 squares, not 7x5"),
        ("charuco:9x6:30mm:22mm", printed(7, 5), "it is a board of another size: 7x5 squares, not 9x6"),
        ("charuco:7x5:30mm:22mm:5X5_100", printed(7, 5), "its markers are of dictionary 4X4_50, not 5X5_100"),
        ("charuco:7x5:30mm:22mm", printed(7, 5)[:, ::-1], "the picture is mirrored"),
        ("charuco:7x5:30mm:22mm", np.full((300, 400), 200, np.uint8), "no markers are seen"),
        ("chessboard:9x6:20mm", CHESSBOARD, "a board of 8x5 inner corners is seen, not of 9x6"),
    ):
        board, image = parse_target(spec), np.ascontiguousarray(image)
        assert board.find(image) is None and board.explain(image).startswith(says)


def test_pictures_count_as_they_are_stored_whatever_their_orientation(tmp_path):
    image = printed(7, 5)
    (tmp_path / "0.jpg").write_bytes(turned_jpeg(cv2.imencode(".jpg", image)[1].tobytes(), 6))
    assert cv2.imread(str(tmp_path / "0.jpg")).shape[:2] == image.shape[::-1]
    found, _, size = found_in(tmp_path, "charuco:7x5:30mm:22mm")
    assert size == image.shape[::-1]
    assert_where_printed(found["0.jpg"])


TRUE = Pinhole(640, 480, 520.0, 523.0, 331.0, 236.0, (-0.12, 0.05, 0.002, -0.001))


def views(noise_px: float, tilt_deg: float = 45.0, count: int = 14) -> dict[str, Corners]:
    """Corners of a board through the true lens, tilted to all sides, as a detector would find them."""
    rng = np.random.default_rng(2)
    points = np.array([[x, y, 0.0] for y in np.arange(6) * 0.03 for x in np.arange(9) * 0.03])
    out = {}
    for k in range(count):
        towards = 2.4 * k
        tilt = np.deg2rad(tilt_deg) * rng.uniform(0.2, 1.0) * np.array([np.cos(towards), np.sin(towards), 0.0])
        turn = so3_exp(tilt) @ so3_exp([0.0, 0.0, rng.uniform(-1, 1)])
        at = (points - points.mean(axis=0)) @ turn.T + [0.02 * (k % 3 - 1), 0.01, 0.3 + 0.01 * (k % 5)]
        pixels = TRUE.project(at)
        inside = np.all((pixels > 0) & (pixels < (640, 480)), axis=1)
        out[f"{k}"] = Corners(pixels[inside] + rng.normal(0, noise_px, pixels[inside].shape), points[inside])
    return out


def test_a_lens_is_exact_from_exact_corners_and_within_its_own_deviations_from_others():
    """In this project's convention: the principal point counts from the corner of the first pixel."""
    p = calibrate_lens(views(0.0), (640, 480), {}).pinhole
    np.testing.assert_allclose([p.fx, p.fy, p.cx, p.cy], [520.0, 523.0, 331.0, 236.0], atol=0.02)
    np.testing.assert_allclose(p.distortion, TRUE.distortion, atol=2e-4)
    assert len(calibrate_lens(views(0.0, count=4), (640, 480), {}).views) == 4
    found = calibrate_lens(views(0.1), (640, 480), {})
    p = found.pinhole
    off = np.array([p.fx, p.fy, p.cx, p.cy, *p.distortion]) - [520, 523, 331, 236, *TRUE.distortion]
    assert np.all(np.abs(off) < 4 * np.array(found.std)) and found.std[0] < 2.0
    assert found.error_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)  # 0.1 px a coordinate


def test_an_image_that_does_not_fit_is_left_out_and_named():
    seen = views(0.1)
    seen["3"] = Corners(seen["3"].pixels[::-1] * [1.0, 0.7] + 20, seen["3"].points)
    found = calibrate_lens(seen, (640, 480), {"blank.png": "not found"})
    assert found.unused == {"blank.png": "not found", "3": "does not fit the others, left out"}
    assert abs(found.pinhole.fx / 520 - 1) < 0.005


def test_images_that_tell_no_focal_length_are_refused():
    for seen, message in (
        (views(0.1, count=3), "too few pictures show the target: 3 of 4"),
        (views(0.1, 0.0), "do not determine"),
        (views(0.0, 2.0), "held the same way"),
    ):
        refused(CalibrationError, message, calibrate_lens, seen, (640, 480), {"x": "not found"})


def test_from_images_to_a_file_that_the_node_reads(tmp_path, capsys):
    taken, _ = known_truth.taken()
    for k, image in enumerate(taken):
        cv2.imwrite(str(tmp_path / f"view-{k}.png"), image)
    cv2.imwrite(str(tmp_path / "view-99.png"), np.zeros_like(taken[0]))
    out = tmp_path / "lens.json"
    words = ["calibrate", "intrinsics", str(tmp_path), "--board", BOARD]
    assert main([*words, "--camera", "eye", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "12 pictures of 320 x 240" in said and "view-99.png: charuco" in said
    lens = load_calibration(out)["eye"].intrinsics
    assert read_lens(out) == lens
    assert abs(lens.fx / known_truth.LENS.fx - 1) < 0.005 and abs(lens.cx - 160) < 1.5 and abs(lens.cy - 120) < 1.5
    assert json.loads(out.read_text())["eye"]["error_px"] < 0.15
