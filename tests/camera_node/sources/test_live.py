"""Real cameras as sources, with a camera that streams over the network."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from camera_node.build import build_cameras
from camera_node.config import source_config
from camera_node.sources.live import CameraError
from freshfield import payload
from freshfield.clock import WallClock
from freshfield.scenario import ScenarioError, parse
from tests.camera_node.sources.mjpeg import SIZE, NetworkCamera, number_of

WITHIN_S = 20.0
CALIBRATION = {
    "eye": {
        "width": SIZE[0],
        "height": SIZE[1],
        "K": [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]],
        "R_world_to_cam": np.eye(3).tolist(),
        "t_world_to_cam": [0.0, 0.0, 1.0],
    }
}


@pytest.fixture
def clock():
    return WallClock()


@pytest.fixture
def network_camera(clock):
    camera = NetworkCamera(clock)
    yield camera
    camera.close()


def scenario(folder: Path, device: str, calibration=CALIBRATION, **source):
    (folder / "calibration.json").write_text(json.dumps(calibration))
    section = {
        "kind": "camera",
        "devices": {"eye": device},
        "width": SIZE[0],
        "height": SIZE[1],
        "fps": 10,
        "codec": "png",
        "calibration": "calibration.json",
        **source,
    }
    return parse({"cameras": {"ids": ["eye"]}, "source": section}, folder / "scenario.yaml")


def opened(plan):
    (camera,) = build_cameras(plan, source_config(plan), plan.cameras)
    return camera


def read(camera):
    return patiently(lambda: camera.source.read(0))


def patiently(take):
    """The next frame; a busy machine may be late."""
    until = time.monotonic() + WITHIN_S
    while True:
        try:
            return take()
        except CameraError:
            assert time.monotonic() < until


def test_frames_come_once_each_in_order_and_with_the_time_of_their_arrival(tmp_path, network_camera, clock):
    camera = opened(scenario(tmp_path, network_camera.address))
    seen = []
    for _ in range(8):
        shot = read(camera)
        now_ns = clock.now_ns()
        assert 0 <= now_ns - shot.captured_ns < WITHIN_S * 1e9
        seen.append((number_of(shot.image), shot.captured_ns))
    numbers, stamps = zip(*seen)
    assert list(numbers) == sorted(set(numbers)) and list(stamps) == sorted(set(stamps))
    # No frame is stamped before it was sent.
    assert all(stamp > network_camera.sent_ns[number] for number, stamp in seen)
    assert shot.image[40, 10, 2] > 150 > shot.image[40, 10, 0]  # RGB
    assert shot.intrinsics.fx == 60.0 and shot.intrinsics.cx == 32.0
    assert shot.pose.translation_m == (0.0, 0.0, -1.0)
    encoded = patiently(lambda: camera.capture(1))
    assert payload.decode(encoded.payload, "png", *SIZE).shape == (48, 64, 3)
    assert encoded.captured_ns is not None
    camera.source.close()


def test_latency_is_taken_off(tmp_path, network_camera, clock):
    camera = opened(scenario(tmp_path, network_camera.address, latency_ms=5000.0))
    assert clock.now_ns() - read(camera).captured_ns >= 5_000_000_000
    camera.source.close()


def test_a_camera_that_falls_silent_gives_no_old_frames_and_comes_back(tmp_path, network_camera):
    camera = opened(scenario(tmp_path, network_camera.address))
    read(camera)
    network_camera.silent.set()
    with pytest.raises(CameraError, match="eye: no new frame"):
        for _ in range(200):
            camera.source.read(0)
    network_camera.silent.clear()
    assert read(camera).captured_ns
    camera.source.close()


def test_a_camera_that_was_gone_is_opened_again(tmp_path, clock):
    first = NetworkCamera(clock)
    camera = opened(scenario(tmp_path, first.address))
    read(camera)
    first.close()
    with pytest.raises(CameraError, match=r"no new frame: eye: (no camera at|the camera gives no more)"):
        until = time.monotonic() + WITHIN_S
        while time.monotonic() < until:
            try:
                camera.source.read(0)
            except CameraError as error:
                if "eye: no camera" in str(error) or "no more frames" in str(error):
                    raise
    second = NetworkCamera(clock, port=first.port)
    assert read(camera).image.shape == (48, 64, 3)
    camera.source.close()
    second.close()


@pytest.mark.parametrize(
    "device, says",
    [
        ("http://127.0.0.1:9/none", "eye: no camera at http://127.0.0.1:9/none: is the address right"),
        ("77", "eye: no camera at 77: is it plugged in"),
        ("/dev/v4l/by-id/none", "eye: no camera at /dev/v4l/by-id/none: is it plugged in"),
    ],
)
def test_no_camera_is_one_clear_line_within_three_seconds(tmp_path, device, says):
    begin = time.monotonic()
    with pytest.raises(CameraError, match=says):
        opened(scenario(tmp_path, device))
    assert time.monotonic() - begin < 3.0


def test_a_calibration_of_another_shape_is_refused(tmp_path, network_camera):
    wide = {"eye": {**CALIBRATION["eye"], "width": 100}}
    with pytest.raises(CameraError, match=r"pictures are 64 x 48, calibrated for 100 x 48"):
        opened(scenario(tmp_path, network_camera.address, wide))


def test_one_of_another_size_is_scaled(tmp_path, network_camera):
    double = {"eye": {**CALIBRATION["eye"], "width": 128, "height": 96}}
    camera = opened(scenario(tmp_path, network_camera.address, double))
    assert camera.source.intrinsics.fx == 30.0 and camera.source.intrinsics.width == 64
    camera.source.close()


def test_what_nobody_calibrated_is_refused(tmp_path, network_camera):
    plan = scenario(tmp_path, network_camera.address, calibration=None)
    plan.source.pop("calibration")
    with pytest.raises(ScenarioError, match=r"camera eye has no pose: name it in arm.cameras"):
        opened(plan)


def test_several_cameras_must_say_which_is_which(tmp_path):
    plan = scenario(tmp_path, "0")
    both = {"eye": CALIBRATION["eye"], "other": CALIBRATION["eye"]}
    (tmp_path / "calibration.json").write_text(json.dumps(both))
    plan = parse({"cameras": {"ids": ["eye", "other"]}, "source": plan.source}, tmp_path / "scenario.yaml")
    with pytest.raises(ScenarioError, match=r"source.devices.other: missing: which camera is it"):
        build_cameras(plan, source_config(plan), plan.cameras)


@pytest.mark.parametrize(
    "wrong", [{"width": 3}, {"exposure_us": 0}, {"first_frame_s": 0}, {"kind": "oak", "iso": 1}]
)
def test_wrong_settings_are_refused(tmp_path, wrong):
    plan = scenario(tmp_path, "0", **wrong)
    plan.source.pop("latency_ms", None)
    with pytest.raises(ScenarioError, match=next(k for k in wrong if k != "kind")):
        source_config(plan)
