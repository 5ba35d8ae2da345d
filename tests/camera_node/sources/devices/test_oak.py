"""The OAK source with the real depthai and no device: its own replay node makes real frames."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from camera_node.settings import source_config
from camera_node.sources.devices import oak
from camera_node.sources.devices.feed import CameraError, Plugged
from freshfield.clock import WallClock
from freshfield.scenario import parse

try:
    dai = oak.library()
except CameraError as error:
    pytest.skip(str(error), allow_module_level=True)

WIDTH, HEIGHT = 64, 48


def plan(**source):
    return parse({"cameras": {"ids": ["eye"]}, "source": {"kind": "oak", **source}}, Path("scenario.yaml"))


@pytest.fixture
def replay(tmp_path):
    """A running pipeline without a device whose output replays twenty pictures for ever."""
    file = tmp_path / "pictures.avi"
    video = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (WIDTH, HEIGHT))
    for k in range(20):
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        image[:, :, 2] = 10 * k  # red in OpenCV's order
        video.write(image)
    video.release()
    pipeline = dai.Pipeline(False)
    node = pipeline.create(dai.node.ReplayVideo)
    node.setReplayVideoFile(file)
    node.setOutFrameType(dai.ImgFrame.Type.BGR888i)
    node.setSize(WIDTH, HEIGHT)
    node.setFps(20.0)
    node.setLoop(True)
    queue = node.out.createOutputQueue(maxSize=2, blocking=False)
    pipeline.start()
    yield pipeline, queue
    pipeline.stop()


def test_real_frames_come_as_rgb_with_their_time_on_our_clock_until_the_camera_is_gone(replay):
    pipeline, queue = replay
    clock = WallClock()
    frames = oak.FrameQueue("eye", queue, clock)
    seen = []
    for _ in range(6):
        captured_ns, image = frames.grab(10.0)
        assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.uint8
        assert image[:, :, 1:].max() < 40  # only red
        assert -1_000_000 < clock.now_ns() - captured_ns < 10_000_000_000
        seen.append((captured_ns, int(image[0, 0, 0])))
    stamps = [stamp for stamp, _ in seen]
    assert stamps == sorted(set(stamps)) and len({red for _, red in seen}) > 3
    pipeline.stop()
    with pytest.raises(CameraError, match="eye: the OAK camera is gone"):
        for _ in range(5):
            frames.grab(10.0)


def test_depth_is_the_newest_frame_in_millimeters_with_its_time():
    queue, clock = dai.MessageQueue("depth", 4, False), WallClock()
    depths = oak.DepthQueue(queue, clock)
    assert depths.newest(0) is None
    for number in (1, 2):
        frame = dai.ImgFrame()
        frame.setType(dai.ImgFrame.Type.RAW16)
        frame.setWidth(WIDTH)
        frame.setHeight(HEIGHT)
        frame.setFrame(np.full((HEIGHT, WIDTH), 1000 * number, np.uint16))
        frame.setTimestamp(dai.Clock.now())
        queue.send(frame)
    measured = depths.newest(clock.now_ns() - 20_000_000)
    assert measured.counts.shape == (HEIGHT, WIDTH) and (measured.counts == 2000).all()
    assert measured.meters_per_count == 0.001 and measured.intrinsics is None, "registered to the image"
    assert 10_000_000 < measured.after_image_ns < 30_000_000
    assert depths.newest(0) is None, "each once"


def calibration():
    """As it is burnt into a device."""
    handler = dai.CalibrationHandler()
    matrix = [[1500.0, 0.0, 959.5], [0.0, 1500.0, 719.5], [0.0, 0.0, 1.0]]
    handler.setCameraIntrinsics(dai.CameraBoardSocket.CAM_A, matrix, 1920, 1440)
    handler.setDistortionCoefficients(dai.CameraBoardSocket.CAM_A, [0.0] * 14)
    return handler


def test_only_a_device_that_was_calibrated_straightens_pictures_and_fixes_its_focus(monkeypatch):
    """Whoever calibrated it themselves names the file. Autofocus would change the focal length unnoticed."""
    device, pipeline = MagicMock(), MagicMock()
    monkeypatch.setattr(dai, "Device", lambda info: device)
    monkeypatch.setattr(dai, "Pipeline", pipeline)
    monkeypatch.setattr(oak, "plugged_in", lambda: [Plugged("1", "OAK")])
    fixed, focused = calibration(), calibration()
    focused.setLensPosition(dai.CameraBoardSocket.CAM_A, 131)
    device.readCalibration.side_effect = [dai.CalibrationHandler(), fixed, focused]
    bare, *calibrated = (oak.OakFeed("eye", None, source_config(plan()), Fraction(10), WallClock()) for _ in range(3))
    assert bare.intrinsics is None and "eye: the device holds no calibration" in bare.no_intrinsics
    assert all(feed.intrinsics.fx == pytest.approx(1500 * 640 / 1920, abs=1e-3) for feed in calibrated)
    camera = pipeline.return_value.create.return_value.build.return_value
    asked = camera.requestOutput.call_args_list
    straightened = [each.kwargs["enableUndistortion"] for each in asked if "enableUndistortion" in each.kwargs]
    assert straightened == [False, True, True]
    assert camera.initialControl.setManualFocus.call_args_list == [((131,),)]
    assert hasattr(dai.CameraControl(), "setManualFocus")


def test_the_library_leaves_the_processs_signals_alone():
    # Of 1 to 31: those above are the C library's own, which any first thread makes it catch.
    code = (
        "from camera_node.sources.devices import oak\n"
        "def caught():\n"
        "    told = dict(line.split(':', 1) for line in open('/proc/self/status'))\n"
        "    return [int(told[name], 16) & 0x7FFFFFFF for name in ('SigBlk', 'SigIgn', 'SigCgt')]\n"
        "before = caught()\n"
        "oak.library()\n"
        "assert caught() == before, (before, caught())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
