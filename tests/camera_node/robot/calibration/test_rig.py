"""Poses and lenses of a rig of fixed cameras, against known ones."""

import itertools
import json
import time
from contextlib import closing

import cv2
import numpy as np
import pytest

from camera_node.cli import main
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.rig import rig_inputs
from camera_node.robot.calibration.rig.rig_calibration import calibrate_rig
from camera_node.robot.calibration.targets import Corners, parse_target
from camera_node.sources.rig_calibration import load_calibration
from freshfield.clock import WallClock
from freshfield.geometry import Pinhole, look_at, se3, se3_inverse, so3_exp, so3_log
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.sources.datasets import sets
from tests.camera_node.sources.devices.mjpeg import NetworkCamera, camera_file, number_of
from tests.support import refusal

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


def sightings(noise_px: float, count: int = 20) -> dict[str, dict[str, Corners]]:
    """Corners as a detector finds them, those within the image."""
    rng = np.random.default_rng(1)
    points = np.array([[x, y, 0.0] for y in np.arange(1, 5) * 0.06 for x in np.arange(1, 8) * 0.06])
    views: dict[str, dict[str, Corners]] = {name: {} for name in POSES}
    for k, board in enumerate(boards(count)):
        for name, pose in POSES.items():
            at = points @ (se3_inverse(pose) @ board)[:3, :3].T + (se3_inverse(pose) @ board)[:3, 3]
            pixels = LENSES[name].project(at)
            inside = np.all((pixels > 0) & (pixels < (640, 480)), axis=1)
            if inside.sum() >= 6:
                noisy = pixels[inside] + rng.normal(0, noise_px, pixels[inside].shape)
                views[name][f"{k:02d}"] = Corners(noisy, points[inside])
    return views


def errors(poses: dict[str, np.ndarray]) -> tuple[float, float]:
    """Largest error of a camera's pose relative to the first one's: millimeters and degrees."""
    first = next(iter(poses))
    off = np.array([se3_inverse(POSES[n]) @ POSES[first] @ se3_inverse(poses[first]) @ poses[n] for n in poses])
    turns = [np.degrees(np.linalg.norm(so3_log(each))) for each in off[:, :3, :3]]
    return 1e3 * float(np.linalg.norm(off[:, :3, 3], axis=1).max()), float(max(turns))


def test_a_rig_is_exact_from_exact_corners_and_stands_where_the_target_lay():
    found = calibrate_rig(sightings(0.0), START, True)
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
    assert mm < 6 * max(found.std_mm.values()) and deg < 6 * max(found.std_deg.values())
    assert list(found.error_px.values()) == pytest.approx([0.2 * 2**0.5] * 4, rel=0.1)  # of both coordinates
    with pytest.raises(CalibrationError, match="--origin 99: no camera saw the target then; there are 00, 01, 02"):
        calibrate_rig(sightings(0.1), START, True, "99")


@pytest.mark.stability
def test_a_moment_that_was_mixed_up_is_left_out_and_named():
    views = sightings(0.1)
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


def photo(name: str, board: np.ndarray, noise: float, seed: int) -> np.ndarray:
    return known_truth.photo(TARGET, LENSES[name], se3_inverse(board) @ POSES[name], noise, seed)


def test_pictures_of_noisy_webcams_give_a_file_that_a_scenario_reads(tmp_path, capsys):
    out = tmp_path / "rig.json"
    for name in ("cam1", "cam2"):
        for folder in ("all", "few"):
            (tmp_path / folder / name).mkdir(parents=True)
        for k, board in enumerate([*boards(9), *near("cam1"), *near("cam2")]):
            image = photo(name, board, 4.0, 100 * int(name[3]) + k)
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
            video.write(cv2.cvtColor(photo(name, board, 2.0, k), cv2.COLOR_GRAY2BGR))
        video.release()
    views = rig_inputs.read_folder(tmp_path, TARGET, lambda done: None)
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
    cameras = {n: shown(photo(n, b, 2.0, k) for b in boards(3) for k in range(3)) for n in ("cam1", "cam2")}
    views = rig_inputs.watch(cameras, TARGET, None, said.append)
    assert len(said) == 3 and views.sizes["cam1"] == (640, 480)
    assert said[-1] == f"cam1 {len(views.corners['cam1'])}, cam2 {len(views.corners['cam2'])}"


@pytest.mark.stability
def test_a_live_camera_that_is_unplugged_is_named_and_the_others_go_on():
    still, said = photo("cam1", boards(1)[0], 2.0, 0), []
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
    ):
        assert main(["calibrate", "rig", *map(str, words)]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
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
