"""The OAK source with the real depthai and no device."""

import signal
from fractions import Fraction
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from camera_node.settings import source_config
from camera_node.sources.devices import oak
from camera_node.sources.devices.feed import CameraError, Plugged
from freshfield.clock import WallClock
from freshfield.scenario import parse
from tests.support import refused

try:
    dai = oak.library()
except CameraError as error:
    pytest.skip(str(error), allow_module_level=True)

WIDTH, HEIGHT = 64, 48


def sent(queue, values: np.ndarray, kind) -> None:
    frame = dai.ImgFrame()
    frame.setType(kind)
    frame.setWidth(WIDTH)
    frame.setHeight(HEIGHT)
    frame.setFrame(values)
    frame.setTimestamp(dai.Clock.now())
    queue.send(frame)


def test_frames_come_as_rgb_with_their_time_on_our_clock_until_the_camera_is_gone():
    queue, clock = dai.MessageQueue("color", 4, False), WallClock()
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    stamps = []
    for _ in range(3):
        sent(queue, image[..., ::-1].copy(), dai.ImgFrame.Type.BGR888i)
        captured_ns, found = oak.next_frame("eye", queue, clock, 10.0)
        assert np.array_equal(found, image)
        assert -1_000_000 < clock.now_ns() - captured_ns < 1_000_000_000
        stamps.append(captured_ns)
    assert stamps == sorted(set(stamps)) and oak.next_frame("eye", queue, clock, 0.001) is None
    queue.close()
    refused(CameraError, "eye: the OAK camera is gone", oak.next_frame, "eye", queue, clock, 10.0)


def test_depth_is_the_newest_frame_in_millimeters_with_its_time():
    queue, clock = dai.MessageQueue("depth", 4, False), WallClock()
    for number in (1, 2):
        sent(queue, np.full((HEIGHT, WIDTH), 1000 * number, np.uint16), dai.ImgFrame.Type.RAW16)
    measured = oak.newest_depth(queue, clock, clock.now_ns() - 20_000_000)
    assert measured.counts.shape == (HEIGHT, WIDTH) and (measured.counts == 2000).all()
    assert measured.meters_per_count == 0.001 and measured.intrinsics is None, "registered to the image"
    assert 10_000_000 < measured.after_image_ns < 30_000_000
    assert oak.newest_depth(queue, clock, 0) is None, "each once"


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
    config = source_config(parse({"cameras": {"ids": ["eye"]}, "source": {"kind": "oak"}}, Path("scenario.yaml")))
    bare, *calibrated = (oak.OakFeed("eye", None, config, Fraction(10), WallClock()) for _ in range(3))
    assert bare.intrinsics is None and "eye: the device holds no calibration" in bare.no_intrinsics
    assert all(feed.intrinsics.fx == pytest.approx(1500 * 640 / 1920, abs=1e-3) for feed in calibrated)
    camera = pipeline.return_value.create.return_value.build.return_value
    asked = camera.requestOutput.call_args_list
    straightened = [each.kwargs["enableUndistortion"] for each in asked if "enableUndistortion" in each.kwargs]
    assert straightened == [False, True, True]
    queues = camera.requestOutput.return_value.createOutputQueue.call_args_list
    assert not any(queue.kwargs["blocking"] for queue in queues), "what nobody takes must not stop the device"
    assert camera.initialControl.setManualFocus.call_args_list == [((131,),)]
    assert hasattr(dai.CameraControl(), "setManualFocus")


def test_the_library_leaves_the_processs_signals_alone():
    """SIGXFSZ would end the node when a file reaches its size limit; Python itself ignores it."""
    ignored = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("SigIgn"))
    assert int(ignored.split()[1], 16) >> (signal.SIGXFSZ - 1) & 1
