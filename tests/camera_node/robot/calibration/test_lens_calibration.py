"""A lens from images: through a known one, real ones, and from a guided session."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import yaml

from camera_node.cli import main
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.guided import LensSession
from camera_node.robot.calibration.inputs import find_corners, list_images, read_lens
from camera_node.robot.calibration.lens_calibration import calibrate_lens
from camera_node.robot.calibration.targets import Corners, parse_target
from camera_node.sources.rig_calibration import load_calibration
from freshfield.clock import WallClock
from freshfield.geometry import Pinhole, se3, so3_exp
from tests.camera_node.robot.calibration import rendered
from tests.camera_node.robot.calibration.rendered import BOARD
from tests.camera_node.sources.devices.mjpeg import NetworkCamera
from tests.conftest import data_dir

TRUE = Pinhole(640, 480, 520.0, 523.0, 331.0, 236.0, (-0.12, 0.05, 0.002, -0.001))
LENS = Pinhole.from_fov(640, 480, 65.0)


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


def test_a_lens_is_exact_from_exact_corners():
    """In this project's convention: the principal point counts from the corner of the first pixel."""
    p = calibrate_lens(views(0.0), (640, 480), {}).pinhole
    np.testing.assert_allclose([p.fx, p.fy, p.cx, p.cy], [520.0, 523.0, 331.0, 236.0], atol=0.02)
    np.testing.assert_allclose(p.distortion, TRUE.distortion, atol=2e-4)


def test_a_lens_is_found_within_its_own_deviations():
    found = calibrate_lens(views(0.1), (640, 480), {})
    p = found.pinhole
    off = np.array([p.fx, p.fy, p.cx, p.cy, *p.distortion]) - [520, 523, 331, 236, *TRUE.distortion]
    assert np.all(np.abs(off) < 4 * np.array(found.std)) and found.std[0] < 2.0
    # 0.1 px a coordinate; images that were held out fit as well.
    assert found.error_px == pytest.approx(0.1 * np.sqrt(2), rel=0.15)
    assert found.held_out_px == pytest.approx(found.error_px, rel=0.2)
    assert calibrate_lens(views(0.1, count=5), (640, 480), {}).held_out_px is not None
    assert calibrate_lens(views(0.1, count=4), (640, 480), {}).held_out_px is None


def test_an_image_that_does_not_fit_is_left_out_and_named():
    seen = views(0.1)
    seen["3"] = Corners(seen["3"].pixels[::-1] * [1.0, 0.7] + 20, seen["3"].points)
    found = calibrate_lens(seen, (640, 480), {"blank.png": "not found"})
    assert found.unused == {"blank.png": "not found", "3": "does not fit the others, left out"}
    assert abs(found.pinhole.fx / 520 - 1) < 0.005


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        (views(0.1, count=2), "too few pictures show the target: 2 of 3"),
        (views(0.0, 0.0), "do not determine"),
        (views(0.1, 0.0), "do not determine"),
        (views(0.0, 2.0), "held the same way"),
    ],
)
def test_images_that_tell_no_focal_length_are_refused(seen, message):
    with pytest.raises(CalibrationError, match=message):
        calibrate_lens(seen, (640, 480), {"x": "not found"})


def test_from_images_to_a_file_that_the_node_reads(tmp_path, capsys):
    taken, _ = rendered.taken()
    for k, image in enumerate(taken):
        cv2.imwrite(str(tmp_path / f"view-{k}.png"), image)
    cv2.imwrite(str(tmp_path / "view-99.png"), np.zeros_like(taken[0]))
    out = tmp_path / "lens.json"
    words = ["calibrate", "intrinsics", str(tmp_path), "--board", BOARD]
    assert main([*words, "--camera", "eye", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "12 pictures of 320 x 240" in said and "held out" in said and "view-99.png: charuco" in said
    lens = load_calibration(out)["eye"].intrinsics
    assert read_lens(out) == lens
    assert abs(lens.fx / rendered.LENS.fx - 1) < 0.005 and abs(lens.cx - 160) < 1.5 and abs(lens.cy - 120) < 1.5
    assert json.loads(out.read_text())["eye"]["error_px"] < 0.15
    assert main([*words, "--seconds", "3"]) == 2
    assert "--seconds: goes with --live" in capsys.readouterr().err


def test_real_images():
    folder = data_dir("handeye_visp_franka")
    board = parse_target("chessboard:9x6:23.6mm")
    corners, unused, size = find_corners(list_images(folder), board, None, lambda done: None)
    found = calibrate_lens(corners, size, unused)
    published = read_lens(folder / "franka_camera.xml")
    assert len(found.views) == 8 and found.error_px == pytest.approx(0.260, abs=0.002)
    assert found.held_out_px < 0.4
    # The published lens has no distortion; ours, which has, differs by a hundredth.
    assert abs(found.pinhole.fx / published.fx - 1) < 0.02


@pytest.fixture(scope="module")
def shown():
    """Images of a board that is held into every part of the image, tilted."""
    target, rng = parse_target(BOARD), np.random.default_rng(8)
    middle = np.array([*np.array(target.size_m) / 2, 0.0])
    images = []
    for k, (x, y) in enumerate([(x, y) for y in (-0.45, 0.0, 0.45) for x in (-0.5, 0.0, 0.5)] * 2):
        tilt = np.deg2rad(35.0) * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.0])
        turn = so3_exp(tilt) @ so3_exp([0.0, 0.0, rng.uniform(-0.4, 0.4)])
        seen = se3(turn, rng.uniform(0.24, 0.30) * np.array([0.6 * x, 0.6 * y, 1.0]) - turn @ middle)
        images.append(rendered.render(target, LENS, np.linalg.inv(seen), 1))
    return images


def test_what_moves_and_what_was_shown_before_is_not_kept(shown):
    session, images = LensSession(parse_target(BOARD)), shown
    outcomes = [session.offer(images[k]).outcome for k in (0, 0, 0, 4, 4)]
    assert outcomes == ["moving", "kept", "like picture 1", "moving", "kept"]
    assert session.offer(np.zeros_like(images[0])).outcome == "target not found"
    assert session.offer(images[8]).outcome == "moving", "what was not found did not hold still"
    with pytest.raises(CalibrationError, match="too few pictures"):
        session.lens()


def test_a_session_asks_for_what_is_missing_until_the_lens_is_known(shown):
    session = LensSession(parse_target(BOARD))
    steps = [session.offer(image) for image in shown for _ in range(2)]
    kept = [step for step in steps if step.outcome == "kept"]
    # The first images leave out the lower parts, and it says so.
    assert "show it at the bottom" in kept[2].advice and kept[-1].enough and kept[-1].advice == "enough"
    found = session.lens()
    assert found.std[0] <= 0.003 * LENS.fx
    assert abs(found.pinhole.fx / LENS.fx - 1) < 0.01 and abs(found.pinhole.cx - LENS.cx) < 3.0


def test_a_camera_without_a_lens_is_what_it_is_for(tmp_path, capsys):
    """Its source would ask for the calibration that is to be made."""
    camera = NetworkCamera(WallClock())
    file = tmp_path / "bench.yaml"
    source = {"kind": "camera", "devices": {"eye": camera.address}, "first_frame_s": 10, "fps": 15}
    file.write_text(yaml.safe_dump({"cameras": {"ids": ["eye"]}, "source": source}))
    words = ["calibrate", "intrinsics", "--board", BOARD, "--camera", "eye", "--live", str(file)]
    assert main([*words, "--seconds", "0.5"]) == 2
    camera.close()
    assert "too few pictures show the target" in capsys.readouterr().err
    assert main(words) == 2
    assert "eye: no camera at http" in capsys.readouterr().err
    assert main([*words, str(tmp_path)]) == 2
    assert "expected one of FOLDER, --live SCENARIO" in capsys.readouterr().err
