"""Poses and lenses of a rig of fixed cameras, against known ones; one lens, and the detectors of targets of both prints
on pictures whose true pose is known."""

import itertools
import json
import time
from contextlib import closing

import cv2
import numpy as np
import pytest

from camera_node.cli import main
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.samples import angle_deg
from camera_node.robot.calibration.inputs import find_corners, list_images, read_lens
from camera_node.robot.calibration.lens_calibration import calibrate_lens
from camera_node.robot.calibration.rig import rig_inputs
from camera_node.robot.calibration.rig.rig_calibration import calibrate_rig
from camera_node.robot.calibration.targets import WHICH_PRINT, Corners, estimate_pose, parse_target
from camera_node.sources.calibration_file import load_calibration
from freshfield.clock import WallClock
from freshfield.geometry import Pinhole, look_at, se3, se3_inverse, so3_exp, so3_log
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.sources.datasets import sets
from tests.camera_node.sources.devices.mjpeg import NetworkCamera, camera_file, number_of
from tests.conftest import data_dir
from tests.support import refusal, refused, turned_jpeg

BOARD = "charuco:8x5:60mm:45mm"
TARGET = parse_target(BOARD)
LENSES = {
    f"cam{k}": Pinhole(640, 480, 520.0 + 9 * k, 523.0 + 8 * k, 331.0 - 4 * k, 236.0 + 3 * k, (-0.1, 0.03, 1e-3, -1e-3))
    for k in range(4)
}
# Four cameras on a third of a circle of a meter, as on stands around a table.
POSES = {
    f"cam{k}": look_at((np.cos(a), np.sin(a), 1.0), (0.0, 0.0, 0.2))
    for k, a in enumerate(np.radians([-60, -20, 20, 60]))
}
START = {name: Pinhole.from_fov(640, 480, 63.0) for name in POSES}


def boards(count: int) -> list[np.ndarray]:
    """Target to world (4, 4): first flat on the floor, then held towards the cameras, near and far, tilted."""
    rng = np.random.default_rng(5)
    found = [se3(np.diag([1.0, -1.0, -1.0]), [-0.24, 0.15, 0.0])]
    # A target's z looks away from who sees it: from the cameras at +x.
    facing = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for _ in range(count - 1):
        turn = so3_exp(rng.normal(0, 0.35, 3)) @ facing
        middle = rng.uniform([-0.2, -0.3, 0.1], [0.3, 0.3, 0.5])
        found.append(se3(turn, middle - turn @ [0.24, 0.15, 0.0]))
    return found


def near(name: str) -> list[np.ndarray]:
    """Target to world (4, 4), held before one camera, tilted, in the middle and every corner: they tell of its lens."""
    found = []
    for k, (x, y) in enumerate([(0, 0), (-1, -1), (1, -1), (-1, 1), (1, 1), (0, 0)]):
        turn = so3_exp(np.radians(35) * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.0]))
        middle = np.array([0.13 * x, 0.1 * y, 0.62])
        found.append(POSES[name] @ se3(turn, middle - turn @ [0.24, 0.15, 0.0]))
    return found


def noisy_corners(lens: Pinhole, at, points, noise_px: float, rng: np.random.Generator) -> Corners:
    """Corners as a detector finds them, those within the image. at: in the camera's axes, (N, 3)."""
    pixels = lens.project(at)
    inside = np.all((pixels > 0) & (pixels < (640, 480)), axis=1)
    return Corners(pixels[inside] + rng.normal(0, noise_px, pixels[inside].shape), points[inside])


def sightings(noise_px: float, count: int = 20) -> dict[str, dict[str, Corners]]:
    rng = np.random.default_rng(1)
    points = np.array([[x, y, 0.0] for y in np.arange(1, 5) * 0.06 for x in np.arange(1, 8) * 0.06])
    seen: dict[str, dict[str, Corners]] = {name: {} for name in POSES}
    for k, board in enumerate(boards(count)):
        for name, pose in POSES.items():
            at = points @ (se3_inverse(pose) @ board)[:3, :3].T + (se3_inverse(pose) @ board)[:3, 3]
            found = noisy_corners(LENSES[name], at, points, noise_px, rng)
            if len(found.points) >= 6:
                seen[name][f"{k:02d}"] = found
    return seen


def errors(poses: dict[str, np.ndarray]) -> tuple[float, float]:
    """Largest error of a camera's pose relative to the first one's: millimeters and degrees."""
    first = next(iter(poses))
    off = np.array([se3_inverse(POSES[n]) @ POSES[first] @ se3_inverse(poses[first]) @ poses[n] for n in poses])
    turns = [np.degrees(np.linalg.norm(so3_log(each))) for each in off[:, :3, :3]]
    return 1e3 * float(np.linalg.norm(off[:, :3, 3], axis=1).max()), float(max(turns))


def test_a_rig_is_exact_from_exact_corners_and_stands_where_the_target_lay():
    found = calibrate_rig(sightings(0.0, 10), START, True)
    assert max(found.error_px.values()) < 1e-3 and found.origin == "00"
    # The board's top left corner is the origin, x along its top, y up along it: half a board from the world's middle.
    shift = se3(np.eye(3), [0.24, -0.15, 0.0])
    for name, pose in found.poses.items():
        np.testing.assert_allclose(pose, shift @ POSES[name], atol=1e-4)
        np.testing.assert_allclose(found.lenses[name].distortion, LENSES[name].distortion, atol=1e-3)
    # With lenses that are known, and the origin elsewhere.
    known = calibrate_rig(sightings(0.0, 8), LENSES, False, "04")
    to_board = np.diag([1.0, -1.0, -1.0, 1.0]) @ se3_inverse(boards(8)[4])
    np.testing.assert_allclose(known.poses["cam1"], to_board @ POSES["cam1"], atol=1e-6)
    assert known.lenses == LENSES


def test_errors_are_within_their_own_deviations_and_within_3_mm_and_a_fifth_of_a_degree():
    found = calibrate_rig(sightings(0.2, 40), START, True)
    mm, deg = errors(dict(found.poses))
    assert mm < 3.0 and deg < 0.2
    assert all(0.6 < off / max(std.values()) < 1.7 for off, std in ((mm, found.std_mm), (deg, found.std_deg)))
    assert list(found.error_px.values()) == pytest.approx([0.2 * 2**0.5] * 4, rel=0.1)  # of both coordinates
    assert not calibrate_rig(sightings(0.8, 8), START, True).unused, "all of them are noisy, none is wrong"
    with pytest.raises(CalibrationError, match="--origin 99: no camera saw the target then; there are 00, 01, 02"):
        calibrate_rig(sightings(0.1, 8), START, True, "99")


@pytest.mark.stability
def test_a_moment_that_was_mixed_up_is_left_out_and_named():
    views = sightings(0.1, 12)
    views["cam2"]["07"] = views["cam2"]["11"]
    found = calibrate_rig(views, START, True)
    assert list(found.unused) == ["cam2 at 07"]
    del views["cam2"]["07"]
    assert errors(dict(found.poses)) == pytest.approx(errors(dict(calibrate_rig(views, START, True).poses)), rel=1e-3)


@pytest.mark.stability
def test_moments_of_cameras_that_lag_are_refused():
    views = sightings(0.1, 12)
    for camera in ("cam1", "cam3"):
        shown = list(views[camera].items())
        views[camera] = {moment: corners for (moment, _), (_, corners) in itertools.pairwise(shown)}
    with pytest.raises(CalibrationError, match=r"reprojection \d+ px\): pictures of one moment are not of one instant"):
        calibrate_rig(views, START, False)


@pytest.mark.stability
@pytest.mark.parametrize("together", [[], ["00"]])
def test_a_camera_that_shares_nothing_or_one_moment_is_named(together):
    views = sightings(0.1)
    views["cam3"] = {m if m in together else f"x{m}": corners for m, corners in views["cam3"].items()}
    with pytest.raises(CalibrationError, match="cam3: never saw the target at the same moment as cam0, cam1, cam2"):
        calibrate_rig(views, START, True)


def taken_of(name: str, board: np.ndarray, noise: float, seed: int) -> np.ndarray:
    return known_truth.photo(TARGET, LENSES[name], se3_inverse(board) @ POSES[name], noise, seed)


def test_pictures_of_noisy_webcams_give_a_file_that_a_scenario_reads(tmp_path, capsys):
    out = tmp_path / "rig.json"
    for name in ("cam1", "cam2"):
        for folder in ("all", "few"):
            (tmp_path / folder / name).mkdir(parents=True)
        for k, board in enumerate([*boards(7), *near("cam1")[:4], *near("cam2")[:4]]):
            image = taken_of(name, board, 4.0, 100 * int(name[3]) + k)
            for folder in ("all", "few")[: 1 + (k < 6)]:
                cv2.imwrite(str(tmp_path / folder / name / f"{k:02d}.png"), image)
    words = ["calibrate", "rig", "--board", BOARD]
    assert main([*words, str(tmp_path / "all"), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "world: the target as it lay at 00" in said and "cam1 and cam2 saw the target together at" in said
    mm, deg = errors({name: camera.pose.matrix() for name, camera in load_calibration(out).items()})
    assert mm < 3.0 and deg < 0.2
    assert main([*words, str(tmp_path / "few"), "--lens", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["cam1"]["K"] == json.loads(out.read_text())["cam1"]["K"]


def test_videos_give_the_moments_at_which_the_target_stood_still(tmp_path):
    """Half a second still, half a second moving, in turn; the videos have different rates."""
    places = boards(5)
    for name, fps in (("cam1", 10.0), ("cam2", 12.5)):
        video = cv2.VideoWriter(str(tmp_path / f"{name}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), fps, (640, 480))
        for k in range(round(2 * fps)):
            at, part = divmod(k / fps, 0.5)
            board = places[int(at) + 1].copy()
            if at % 2:  # carried past
                board[:3, 3] += [0.0, 0.3 * part, 0.0]
            video.write(cv2.cvtColor(taken_of(name, board, 2.0, k), cv2.COLOR_GRAY2BGR))
        video.release()
    views = rig_inputs.read_folder(tmp_path, TARGET)
    assert views.sizes == {"cam1": (640, 480), "cam2": (640, 480)}
    assert all(seen and set(seen) <= {"0.0s", "1.0s"} for seen in views.corners.values())
    assert set(views.corners["cam1"]) & set(views.corners["cam2"])


def shown(images):
    """A camera's function for ``watch``: images one after another, then Ctrl-C."""
    rest = iter(images)

    def grab():
        for image in rest:
            return image
        raise KeyboardInterrupt

    return grab


def test_a_live_session_keeps_each_new_place_once_the_target_rests():
    said: list[str] = []
    cameras = {n: shown(taken_of(n, b, 2.0, k) for b in boards(3) for k in range(3)) for n in ("cam1", "cam2")}
    views = rig_inputs.watch(cameras, TARGET, None, said.append)
    assert len(said) == 3 and views.sizes["cam1"] == (640, 480)
    assert said[-1] == f"cam1 {len(views.corners['cam1'])}, cam2 {len(views.corners['cam2'])}"


@pytest.mark.stability
def test_a_live_camera_that_is_unplugged_is_named_and_the_others_go_on():
    still, said = taken_of("cam1", boards(1)[0], 2.0, 0), []
    cameras = {"cam1": lambda: still, "cam2": shown([still, still, None, None, still])}
    views = rig_inputs.watch(cameras, TARGET, None, said.append)
    assert said == ["cam1 1, cam2 1", "cam1 1, cam2 1; no picture of cam2: unplugged?", "cam1 1, cam2 1"]
    assert len(views.corners["cam1"]) == 1


@pytest.mark.stability
def test_a_live_camera_shows_its_newest_frame_however_slowly_it_is_asked(tmp_path):
    """Of network cameras, frames wait in the stream."""
    with closing(NetworkCamera(WallClock())) as camera:
        cameras, close = rig_inputs.open_cameras(str(camera_file(tmp_path, camera.address)))
        numbers = []
        for _ in range(3):
            time.sleep(1.0)
            numbers.append(number_of(np.repeat(cameras["eye"]()[..., None], 3, axis=2)))
        assert min(np.diff(numbers)) > 4
        close()


def test_what_cannot_be_used_is_refused_in_one_line(tmp_path, capsys):
    for name in ("cam0", "cam1"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "1.png"), np.zeros((48, 64), np.uint8))
    for words, message in (
        ([tmp_path / "cam0", "--board", BOARD], "for each of at least two cameras, found 0"),
        ([tmp_path, "--board", BOARD], "cam0 never sees the target: charuco:8x5:60mm:45mm not found: no markers"),
        (["--live", "room", "--board", BOARD], "expected camera, oak or realsense"),
        (["--live", "room", "--board", BOARD, "--seconds", "nan"], "--seconds: expected a positive number"),
        (["--colmap", tmp_path, "--lens", "x"], "--lens: goes with FOLDER or --live SCENARIO, not with --colmap MODEL"),
    ):
        error = refusal(capsys, main, "calibrate", "rig", *words)
        assert error.startswith("camera-node: ") and message in error


def test_a_colmap_model_is_scaled_by_a_known_length(tmp_path, capsys):
    lens, black = Pinhole.from_fov(sets.WIDTH, sets.HEIGHT, 60.0), np.zeros((sets.HEIGHT, sets.WIDTH), np.uint8)
    places = {name: se3(pose[:3, :3], 4 * pose[:3, 3]) for name, pose in POSES.items()}
    cameras = [sets.Taken(name, lens, place, lambda k: black) for name, place in places.items()]
    sets.write_colmap(tmp_path, cameras, "PINHOLE", binary=False)
    apart, out = np.linalg.norm(POSES["cam0"][:3, 3] - POSES["cam2"][:3, 3]), tmp_path / "rig.json"
    words = ["calibrate", "rig", "--colmap", str(tmp_path), "--out", str(out), "--length", "cam0 x"]
    assert main([*words, "cam2 x", f"{apart}"]) == 0
    assert "a unit of the model is 0.25 m" in capsys.readouterr().out
    for name, camera in load_calibration(out).items():
        np.testing.assert_allclose(camera.pose.matrix(), POSES[name[:4]], atol=1e-6)
    assert "no camera cam9; it has cam0" in refusal(capsys, main, *words, "cam9", apart)
    sets.write_colmap(tmp_path, cameras, "OPENCV_FISHEYE", binary=False)
    assert "cam0 x: the model's pictures are straightened" in refusal(capsys, main, *words, "cam2 x", apart)


LENS = Pinhole(400, 300, 330.0, 332.0, 203.0, 148.0, (-0.05, 0.02, 0.001, -0.001))


def found_in(folder, spec):
    return find_corners(list_images(folder), parse_target(spec))


@pytest.mark.parametrize(("spec", "origin_m"), [("charuco:7x5:24mm:18mm", 0.0), ("chessboard:7x4:20mm", 2 * 0.02)])
def test_a_rendered_target_is_found_where_it_is_and_only_where_it_is(spec, origin_m):
    """Upside down, too. origin_m: where a picture's own origin lies in its target's axes: a chessboard's is its first
    inner corner."""
    target = parse_target(spec)
    middle = np.array([*target.size_m, 0.0]) / 2
    for x, y, z, roll in ((0.05, 0.08, -0.22, 0.4), (-0.07, 0.03, -0.20, 3.3)):
        camera = look_at(middle + np.array([x, y, z]), middle, up=(0.0, -1.0, 0.0))
        camera[:3, :3] = camera[:3, :3] @ so3_exp([0, 0, roll])
        found = estimate_pose(target.find(known_truth.photo(target, LENS, camera)), LENS)
        truth = se3_inverse(camera)
        truth[:3, 3] += truth[:3, :3] @ [origin_m, origin_m, 0.0]
        assert angle_deg(found, truth) < 0.1
        assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) * 1e3 < 0.1
    noise = np.random.default_rng(0).integers(0, 256, (120, 160)).astype(np.uint8)
    for picture in (np.zeros((120, 160), np.uint8), noise):
        assert target.find(picture) is None


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
        ("charuco:12x9:30mm:22mm", "it has 54 markers, 4X4_50 50: add a larger one"),
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


def test_a_board_that_is_not_found_is_examined():
    chessboard = cv2.GaussianBlur(parse_target("chessboard:8x5:20mm").draw(600), (0, 0), 1.0)
    others = {}
    for across, down in ((9, 5), (7, 5), (8, 6), (8, 4)):  # which look the same upside down
        squares = np.kron(np.indices((down + 1, across + 1)).sum(axis=0) % 2 * 255, np.ones((50, 50))).astype(np.uint8)
        board = cv2.GaussianBlur(np.pad(squares, 50, constant_values=255), (0, 0), 1.0)
        others[f"{across}x{down}"] = board
    for spec, image, says in (
        ("charuco:7x5:30mm:22mm", printed(5, 7), "its sizes are swapped: 5x7 squares, not 7x5"),
        ("charuco:9x6:30mm:22mm", printed(7, 5), "it is a board of another size: 7x5 squares, not 9x6"),
        ("charuco:7x5:30mm:22mm:5X5_100", printed(7, 5), "its markers are of dictionary 4X4_50, not 5X5_100"),
        ("charuco:7x5:30mm:22mm", printed(7, 5)[:, ::-1], "the picture is mirrored"),
        ("charuco:7x5:30mm:22mm", np.full((300, 400), 200, np.uint8), "no markers are seen"),
        ("chessboard:9x6:20mm", chessboard, "a board of 8x5 inner corners is seen, not of 9x6"),
        *(("chessboard:8x5:20mm", board, f"a board of {size} inner corners is seen") for size, board in others.items()),
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
        out[f"{k}"] = noisy_corners(TRUE, at, points, noise_px, rng)
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
    words = ["calibrate", "intrinsics", str(tmp_path), "--board", known_truth.BOARD]
    assert main([*words, "--camera", "eye", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "12 pictures of 320 x 240" in said and "view-99.png: charuco" in said
    lens = load_calibration(out)["eye"].intrinsics
    assert read_lens(out) == lens
    assert abs(lens.fx / known_truth.LENS.fx - 1) < 0.005 and abs(lens.cx - 160) < 1.5 and abs(lens.cy - 120) < 1.5
    assert json.loads(out.read_text())["eye"]["error_px"] < 0.15


@pytest.mark.parametrize(
    ("case", "spec", "pictures"), [("15-legacy-charuco", "5x8", 6), ("19-exif-in-calibration", "7x5", 5)]
)
def test_pictures_that_people_took(case, spec, pictures):
    corners, unused, size = found_in(data_dir(f"../cases/{case}") / "pictures", f"charuco:{spec}:30mm:22mm")
    found = calibrate_lens(corners, size, unused)
    p = found.pinhole
    assert len(found.views) == pictures and size == (640, 480)
    off = np.subtract([p.fx, p.fy, p.cx, p.cy], (620, 618, 321.8, 238.6))
    assert np.all(np.abs(off) < 3 * np.array(found.std[:4]))
