"""A lens from pictures: rendered through a known one, and real ones."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from camera_node.cli import main
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.files import list_images, read_lens
from camera_node.robot.calibration.lens.solve import calibrate, calibrate_folder
from camera_node.robot.calibration.targets import Corners, parse_target
from camera_node.sources.rig_calibration import load_calibration
from freshfield.geometry import Pinhole, so3_exp
from tests.camera_node.robot.calibration import known_truth as simulated
from tests.camera_node.robot.calibration import pictures
from tests.conftest import data_dir

TRUE = Pinhole(640, 480, 520.0, 523.0, 331.0, 236.0, (-0.12, 0.05, 0.002, -0.001))


def views(count: int = 14):
    """Corners of a board through the true lens, as a detector would find them, a tenth of a pixel off."""
    rng = np.random.default_rng(2)
    points = np.array([[x, y, 0.0] for y in np.arange(6) * 0.03 for x in np.arange(9) * 0.03])
    out = {}
    for k, hand in enumerate(simulated.random_hands(count, rng)):
        seen = simulated.observed_targets(hand[None])[0]
        middle = points.mean(axis=0)
        pixels = TRUE.project((points - middle) @ seen[:3, :3].T + [0.02 * (k % 3 - 1), 0.01, 0.33])
        inside = np.all((pixels > 0) & (pixels < (640, 480)), axis=1)
        out[f"{k}"] = Corners(pixels[inside] + rng.normal(0, 0.1, pixels[inside].shape), points[inside])
    return out


def test_a_known_lens_is_found_within_its_own_deviations():
    found = calibrate(views(), (640, 480), {})
    p = found.pinhole
    off = np.array([p.fx, p.fy, p.cx, p.cy, *p.distortion]) - [520, 523, 331, 236, *TRUE.distortion]
    assert np.all(np.abs(off) < 4 * np.array(found.std))
    assert abs(p.fx / 520 - 1) < 0.005 and abs(p.cx - 331) < 2
    assert found.error_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)


def test_a_picture_that_does_not_fit_is_left_out_and_named():
    seen = views()
    seen["3"] = Corners(seen["3"].pixels[::-1] * [1.0, 0.7] + 20, seen["3"].points)
    found = calibrate(seen, (640, 480), {"blank.png": "not found"})
    assert found.unused == {"blank.png": "not found", "3": "does not fit the others, left out"}
    assert abs(found.pinhole.fx / 520 - 1) < 0.005


def test_pictures_that_determine_nothing_are_refused():
    with pytest.raises(CalibrationError, match="too few pictures show the target: 2 of 3"):
        calibrate(dict(list(views().items())[:2]), (640, 480), {"x": "not found"})


@pytest.mark.parametrize(
    ("tilt_deg", "noise_px", "message"),
    [(0.0, 0.0, "do not determine"), (0.0, 0.1, "do not determine"), (1.0, 0.0, "held the same way")],
)
def test_a_target_held_parallel_to_the_sensor_tells_no_focal_length(tilt_deg, noise_px, message):
    rng = np.random.default_rng(2)
    points = np.array([[x, y, 0.0] for y in np.arange(6) * 0.03 for x in np.arange(9) * 0.03])
    seen = {}
    for k in range(12):
        turn = so3_exp([*np.deg2rad(tilt_deg) * rng.uniform(-1, 1, 2), rng.uniform(-1, 1)])
        at = (points - points.mean(axis=0)) @ turn.T + [0.02 * (k % 3 - 1), 0.01, 0.3 + 0.01 * k]
        pixels = TRUE.project(at)
        inside = np.all((pixels > 0) & (pixels < (640, 480)), axis=1)
        noise = rng.normal(0, noise_px, pixels[inside].shape)
        seen[f"{k}"] = Corners(pixels[inside] + noise, points[inside])
    with pytest.raises(CalibrationError, match=message):
        calibrate(seen, (640, 480), {})


def test_from_pictures_to_a_file_that_the_node_reads(tmp_path, capsys):
    taken, _ = pictures.taken()
    for k, picture in enumerate(taken):
        cv2.imwrite(str(tmp_path / f"view-{k}.png"), picture)
    cv2.imwrite(str(tmp_path / "view-99.png"), np.zeros_like(taken[0]))
    out = tmp_path / "lens.json"
    assert (
        main(
            ["calibrate", "intrinsics", str(tmp_path), "--board", pictures.BOARD, "--camera", "eye", "--out", str(out)]
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "12 pictures of 320 x 240" in said and "view-99.png: charuco" in said
    lens = load_calibration(out)["eye"].intrinsics
    assert read_lens(out) == lens
    assert abs(lens.fx / pictures.LENS.fx - 1) < 0.005 and abs(lens.cx - 160) < 1.5 and abs(lens.cy - 120) < 1.5
    assert np.abs(lens.distortion[:2]).max() < 0.1
    assert json.loads(out.read_text())["eye"]["error_px"] < 0.15


def test_real_pictures():
    folder = data_dir("handeye_visp_franka")
    board = parse_target("chessboard:9x6:23.6mm")
    found = calibrate_folder(list_images(folder), board, lambda done: None)
    published = read_lens(folder / "franka_camera.xml")
    assert len(found.views) == 8 and found.error_px < 0.4
    # The published lens has no distortion; ours, which has, differs by a hundredth.
    assert abs(found.pinhole.fx / published.fx - 1) < 0.02
