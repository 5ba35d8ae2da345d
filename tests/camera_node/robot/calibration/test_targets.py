"""The real detectors on pictures that the project's own ray caster made, so that the true pose is known; boards of both
prints, and what is said of a board that is not found."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.samples import angle_deg
from camera_node.robot.calibration.inputs import find_corners, list_images
from camera_node.robot.calibration.lens_calibration import calibrate_lens
from camera_node.robot.calibration.targets import WHICH_PRINT, Corners, estimate_pose, parse_target
from freshfield.geometry import Pinhole, look_at, se3_inverse, so3_exp
from tests.camera_node.robot.calibration.rendered import render
from tests.conftest import data_dir

LENS = Pinhole(400, 300, 330.0, 332.0, 203.0, 148.0, (-0.05, 0.02, 0.001, -0.001))
# Where a picture's own origin lies in its target's axes: a chessboard's is its first inner corner.
ORIGIN = {"chessboard": 2 * 0.02}
KINDS = ["charuco:7x5:24mm:18mm", "chessboard:7x4:20mm"]


def cameras(target) -> list[np.ndarray]:
    """Two cameras in the picture's axes (z into the paper), one of them upside down."""
    width, height = target.size_m
    middle = np.array([width / 2, height / 2, 0.0])
    out = []
    for x, y, z, roll in ((0.05, 0.08, -0.22, 0.4), (-0.07, 0.03, -0.20, 3.3)):
        camera = look_at(middle + np.array([x, y, z]), middle, up=(0.0, -1.0, 0.0))
        camera[:3, :3] = camera[:3, :3] @ so3_exp([0, 0, roll])
        out.append(camera)
    return out


@pytest.mark.parametrize("spec", KINDS)
def test_a_rendered_target_is_found_where_it_is(spec):
    target = parse_target(spec)
    for camera in cameras(target):
        picture = render(target, LENS, camera, 2)
        corners = target.find(picture)
        assert corners is not None
        found = estimate_pose(corners, LENS)
        truth = se3_inverse(camera)
        truth[:3, 3] += truth[:3, :3] @ ([ORIGIN.get(spec.split(":")[0], 0.0)] * 2 + [0.0])
        assert angle_deg(found, truth) < 0.1
        assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) * 1e3 < 0.1


@pytest.mark.parametrize("spec", KINDS)
def test_nothing_is_found_where_nothing_is(spec):
    noise = np.random.default_rng(0).integers(0, 256, (120, 160)).astype(np.uint8)
    for picture in (np.zeros((120, 160), np.uint8), np.full((120, 160), 255, np.uint8), noise):
        assert parse_target(spec).find(picture) is None


@pytest.mark.parametrize("turn", [None, cv2.ROTATE_90_CLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_COUNTERCLOCKWISE])
def test_a_chessboard_is_the_same_way_up_however_it_is_held(turn):
    """Its first corner stays the first: the picture is turned and the corners with it."""
    target = parse_target("chessboard:7x4:20mm")
    straight = cv2.GaussianBlur(target.draw(600), (0, 0), 1.0)
    first = target.find(straight).pixels[0]
    height, width = straight.shape
    if turn is None:
        picture, expected = straight, first
    else:
        picture = cv2.rotate(straight, turn)
        x, y = first
        expected = {
            cv2.ROTATE_90_CLOCKWISE: (height - y, x),
            cv2.ROTATE_180: (width - x, height - y),
            cv2.ROTATE_90_COUNTERCLOCKWISE: (y, width - x),
        }[turn]
    np.testing.assert_allclose(target.find(picture).pixels[0], expected, atol=0.1)


def test_a_small_tag_seen_straight_on_may_be_tilted_either_way():
    points = np.array([[0, 0, 0], [0.02, 0, 0], [0.02, 0.02, 0], [0, 0.02, 0]])
    pixels = LENS.project(points - [0.01, 0.01, -0.8])
    wobble = np.random.default_rng(0).normal(0, 0.05, pixels.shape)
    with pytest.raises(CalibrationError, match="tilted either way"):
        estimate_pose(Corners(pixels + wobble, points), LENS)


@pytest.mark.parametrize(
    ("spec", "why"),
    [
        ("circles:3x4", "no kind 'circles'"),
        ("charuco:7x5:20mm:30mm", "smaller than the squares"),
        ("charuco:7x5:30mm:20mm:9X9_50", "no dictionary 9X9_50"),
        ("chessboard:9x6:23.6", "needs a unit"),
        ("chessboard:8x6:20mm", "odd and the other even"),
        ("chessboard:9x6:90m", "not within"),
    ],
)
def test_specs_that_are_none_say_what_is_one(spec, why):
    with pytest.raises(CalibrationError, match=why) as error:
        parse_target(spec)
    assert "charuco:7x5:30mm:22mm" in str(error.value)


def printed(across: int, down: int, legacy: bool = False) -> np.ndarray:
    """A board of squares of 80 pixels, with 40 of white around it."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((across, down), 0.03, 0.022, dictionary)
    board.setLegacyPattern(legacy)
    return np.pad(board.generateImage((80 * across, 80 * down)), 40, constant_values=255)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(("across", "down"), [(5, 8), (7, 5), (4, 6)])
def test_boards_of_both_prints_are_found_where_they_are(across, down, legacy):
    corners = parse_target(f"charuco:{across}x{down}:30mm:22mm").find(printed(across, down, legacy))
    assert len(corners.points) == (across - 1) * (down - 1)
    np.testing.assert_allclose(corners.pixels, 40 + corners.points[:, :2] / 0.03 * 80, atol=0.5)


@pytest.mark.parametrize(
    ("legacy", "columns", "decided"),
    [
        (True, (0, 4), False),  # 21 corners of each print
        (True, (1, 5), True),  # 14 and 21
        (False, (1, 5), False),
        (False, (0, 4), True),
    ],
)
def test_parts_that_fit_both_prints_are_told_by_a_whole_board_among_them(legacy, columns, decided, tmp_path):
    whole = printed(5, 8, legacy)
    part = np.full_like(whole, 255)
    seen = np.s_[:, 40 + 80 * columns[0] : 40 + 80 * columns[1]]
    part[seen] = whole[seen]
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), part)
    board = parse_target("charuco:5x8:30mm:22mm")
    found, unused, _ = find_corners(list_images(tmp_path), board, None, lambda done: None)
    assert len(found) == 3 * decided == 3 - len(unused) and set(unused.values()) <= {WHICH_PRINT}
    cv2.imwrite(str(tmp_path / "3.png"), whole)
    found, unused, _ = find_corners(list_images(tmp_path), board, None, lambda done: None)
    assert len(found) == 4 and not unused
    for corners in found.values():
        np.testing.assert_allclose(corners.pixels, 40 + corners.points[:, :2] / 0.03 * 80, atol=0.5)


@pytest.mark.parametrize(
    ("spec", "image", "says"),
    [
        ("7x5:30mm:22mm", printed(5, 7), "its sizes are swapped: 5x7 squares, not 7x5"),
        ("8x5:30mm:22mm", printed(5, 8, legacy=True), "its sizes are swapped: 5x8 squares, not 8x5"),
        ("9x6:30mm:22mm", printed(7, 5), "it is a board of another size: 7x5 squares, not 9x6"),
        ("7x5:30mm:22mm:5X5_100", printed(7, 5), "its markers are of dictionary 4X4_50, not 5X5_100"),
        ("7x5:30mm:22mm", printed(7, 5)[:, ::-1], "the picture is mirrored"),
        ("7x5:30mm:22mm", np.full((300, 400), 200, np.uint8), "no markers are seen"),
    ],
)
def test_a_board_that_is_not_found_is_examined(spec, image, says):
    board = parse_target(f"charuco:{spec}")
    image = np.ascontiguousarray(image)
    assert board.find(image) is None and board.explain(image).startswith(says)


def test_a_chessboard_that_is_described_by_its_squares_is_told():
    image = cv2.GaussianBlur(parse_target("chessboard:8x5:20mm").draw(600), (0, 0), 1.0)
    board = parse_target("chessboard:9x6:20mm")
    assert board.find(image) is None
    assert board.explain(image) == "a board of 8x5 inner corners is seen, not of 9x6"


def test_the_reason_is_in_the_refusal(tmp_path):
    for k in range(6):
        cv2.imwrite(str(tmp_path / f"{k}.png"), printed(5, 7))
    found, unused, size = find_corners(list_images(tmp_path), parse_target("charuco:7x5:30mm:22mm"), None, print)
    with pytest.raises(ValueError, match=r"0 of 6.*0\.png: .*its sizes are swapped"):
        calibrate_lens(found, size, unused)
    assert sum("swapped" in why for why in unused.values()) == 4, "the others are not examined"


def with_orientation(jpeg: bytes, orientation: int) -> bytes:
    """The JPEG with an EXIF block that says how to turn it."""
    tag = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<I", 8) + struct.pack("<H", 1) + tag + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_pictures_count_as_they_are_stored_whatever_their_orientation(orientation, tmp_path):
    image = printed(7, 5)
    _, jpeg = cv2.imencode(".jpg", image)
    (tmp_path / "0.jpg").write_bytes(with_orientation(jpeg.tobytes(), orientation))
    assert orientation < 6 or cv2.imread(str(tmp_path / "0.jpg")).shape[:2] == image.shape[::-1]
    board = parse_target("charuco:7x5:30mm:22mm")
    found, _, size = find_corners(list_images(tmp_path), board, None, lambda done: None)
    assert size == image.shape[::-1]
    np.testing.assert_allclose(found["0.jpg"].pixels, 40 + found["0.jpg"].points[:, :2] / 0.03 * 80, atol=0.5)


@pytest.mark.parametrize(
    ("case", "spec", "pictures", "lens"),
    [
        ("15-legacy-charuco", "5x8", 6, (620, 618, 321.8, 238.6)),
        ("19-exif-in-calibration", "7x5", 5, (620, 618, 321.8, 238.6)),
    ],
)
def test_pictures_that_people_took(case, spec, pictures, lens):
    files = list_images(data_dir(f"../cases/{case}") / "pictures")
    corners, unused, size = find_corners(files, parse_target(f"charuco:{spec}:30mm:22mm"), None, lambda done: None)
    found = calibrate_lens(corners, size, unused)
    p = found.pinhole
    assert len(found.views) == pictures and size == (640, 480)
    assert np.all(np.abs(np.subtract([p.fx, p.fy, p.cx, p.cy], lens)) < 3 * np.array(found.std[:4]))
