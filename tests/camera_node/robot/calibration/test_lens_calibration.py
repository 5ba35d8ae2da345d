"""A lens from images, through a known one and real ones."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from camera_node.cli import main
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.inputs import find_corners, list_images, read_lens
from camera_node.robot.calibration.lens_calibration import calibrate_lens
from camera_node.robot.calibration.targets import Corners, parse_target
from camera_node.sources.rig_calibration import load_calibration
from freshfield.geometry import Pinhole, so3_exp
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.known_truth import BOARD
from tests.conftest import data_dir

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


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (views(0.1, count=3), "too few pictures show the target: 3 of 4"),
        (views(0.1, 0.0), "do not determine"),
        (views(0.0, 2.0), "held the same way"),
    ],
)
def test_images_that_tell_no_focal_length_are_refused(seen, message):
    with pytest.raises(CalibrationError, match=message):
        calibrate_lens(seen, (640, 480), {"x": "not found"})


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


def test_real_images():
    folder = data_dir("handeye_visp_franka")
    board = parse_target("chessboard:9x6:23.6mm")
    corners, unused, size = find_corners(list_images(folder), board, None, lambda done: None)
    found = calibrate_lens(corners, size, unused)
    assert len(found.views) == 8 and found.error_px == pytest.approx(0.260, abs=0.002)
    # The published lens has no distortion; ours, which has, differs by a hundredth.
    assert abs(found.pinhole.fx / read_lens(folder / "franka_camera.xml").fx - 1) < 0.02
