"""The RealSense source with the real library and its software device, which makes real frames."""

from __future__ import annotations

import sys
import time
from fractions import Fraction
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from camera_node.settings import source_config
from camera_node.sources.devices.feed import CameraError
from camera_node.sources.devices.live import open_feed
from freshfield.clock import VirtualClock, WallClock
from freshfield.scenario import parse

rs = pytest.importorskip(
    "pyrealsense2",
    exc_type=ImportError,
    reason="needs pyrealsense2, pip install -e '.[realsense]', and libusb-1.0, apt install libusb-1.0-0",
)

from camera_node.sources.devices import realsense  # noqa: E402

WIDTH, HEIGHT = 64, 48
OURS_NS, SYSTEM_NS = 5 * 10**9, 1_700_000_000 * 10**9  # now, where the system's clock has stepped since
CLOCKS = (VirtualClock(OURS_NS), VirtualClock(SYSTEM_NS))


def intrinsics(model=None, coefficients=(0.0,) * 5):
    found = rs.intrinsics()
    found.width, found.height = WIDTH, HEIGHT
    found.fx, found.fy, found.ppx, found.ppy = 60.0, 61.0, 31.5, 23.5
    found.model = rs.distortion.inverse_brown_conrady if model is None else model
    found.coeffs = list(coefficients)
    return found


def frames(domain, stamps_ms, metadata=()):
    """Color frames of a software device, with these stamps and metadata (key, value)."""
    device = rs.software_device()
    sensor = device.add_sensor("Color")
    stream = rs.video_stream()
    stream.type, stream.uid, stream.width, stream.height = rs.stream.color, 1, WIDTH, HEIGHT
    stream.fps, stream.bpp, stream.fmt, stream.intrinsics = 30, 3, rs.format.rgb8, intrinsics()
    profile = sensor.add_video_stream(stream)
    queue = rs.frame_queue(10)
    sensor.open(profile)
    sensor.start(queue)
    for key, value in metadata:
        sensor.set_metadata(key, value)
    for number, stamp_ms in enumerate(stamps_ms):
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        image[:, :, 0] = 10 * number
        frame = rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = image, WIDTH * 3, 3
        frame.timestamp, frame.domain, frame.frame_number = stamp_ms, domain, number
        frame.profile = profile.as_video_stream_profile()
        sensor.on_video_frame(frame)
        yield queue.wait_for_frame(5000).as_video_frame()
    sensor.stop()
    sensor.close()


def test_global_time_is_the_hosts():
    (frame,) = frames(rs.timestamp_domain.global_time, [SYSTEM_NS / 1e6 - 40.0])
    captured_ns, image = realsense.as_grabbed(frame, realsense.FrameClock(*CLOCKS))
    assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.uint8
    assert captured_ns == pytest.approx(OURS_NS - 40e6, abs=1e3)


def test_a_stamp_is_moved_to_the_middle_of_the_exposure():
    key = rs.frame_metadata_value
    told = [(key.frame_timestamp, 5_012_000), (key.sensor_timestamp, 5_000_000)]
    (frame,) = frames(rs.timestamp_domain.global_time, [SYSTEM_NS / 1e6 - 40.0], told)
    captured_ns, _ = realsense.as_grabbed(frame, realsense.FrameClock(*CLOCKS))
    assert captured_ns == pytest.approx(OURS_NS - 52e6, abs=1e3)


def test_a_lens_that_is_not_opencvs_opens_all_the_same(monkeypatch):
    """Whoever calibrated it themselves names the file: the device is not asked."""
    pipeline = MagicMock()
    stream = pipeline.start.return_value.get_stream.return_value.as_video_stream_profile.return_value
    stream.get_intrinsics.return_value = intrinsics(rs.distortion.kannala_brandt4)
    monkeypatch.setattr(rs, "pipeline", lambda: pipeline)
    monkeypatch.setattr(realsense, "find", lambda camera, device: "1")
    scenario = parse({"cameras": {"ids": ["eye"]}, "source": {"kind": "realsense"}}, Path("scenario.yaml"))
    feed = realsense.RealsenseFeed("eye", None, source_config(scenario), Fraction(15), WallClock())
    assert feed.intrinsics is None and "name the file in source.calibration" in feed.no_intrinsics
    stream.get_intrinsics.side_effect = RuntimeError("get_intrinsics failed")
    with pytest.raises(CameraError, match="eye: RuntimeError: get_intrinsics failed"):
        realsense.RealsenseFeed("eye", None, source_config(scenario), Fraction(15), WallClock())
    assert pipeline.stop.called


def test_a_devices_own_time_is_mapped_by_arrival():
    clock = WallClock()
    stamps = realsense.FrameClock(clock, clock)
    begin_ns = clock.now_ns()
    taken = []
    for number, frame in enumerate(frames(rs.timestamp_domain.hardware_clock, [1000.0, 1033.0, 1066.0])):
        taken.append(realsense.as_grabbed(frame, stamps))
        assert taken[-1][1][0, 0, 0] == 10 * number
    assert all(begin_ns - 10**8 < captured_ns <= clock.now_ns() for captured_ns, _ in taken)


def test_intrinsics_are_the_devices():
    lens = realsense.lens("eye", intrinsics())
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (60.0, 61.0, 32.0, 24.0) and not lens.distorted
    bent = realsense.lens("eye", intrinsics(rs.distortion.brown_conrady, (-0.1, 0.02, 1e-3, -1e-3, 0.0)))
    assert np.allclose(bent.distortion, (-0.1, 0.02, 1e-3, -1e-3), atol=1e-6)


def test_a_lens_that_cannot_be_described_is_refused():
    with pytest.raises(CameraError, match=r"lens model .* is not supported"):
        realsense.lens("eye", intrinsics(rs.distortion.kannala_brandt4))
    with pytest.raises(CameraError, match="cannot be undone"):
        realsense.lens("eye", intrinsics(coefficients=(0.1, 0, 0, 0, 0)))


def test_without_a_device_one_clear_line_within_three_seconds():
    if len(rs.context().query_devices()):
        pytest.skip("there is a RealSense camera here")
    scenario = parse({"cameras": {"ids": ["eye"]}, "source": {"kind": "realsense"}}, Path("scenario.yaml"))
    begin = time.monotonic()
    with pytest.raises(CameraError, match="eye: no RealSense camera found: is it plugged in"):
        open_feed("eye", source_config(scenario), Fraction(15), WallClock())
    assert time.monotonic() - begin < 3.0


def test_a_library_that_cannot_be_loaded_is_told_from_one_that_is_not_there(tmp_path, monkeypatch):
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open shared object file')")
    monkeypatch.delitem(sys.modules, "pyrealsense2")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(CameraError, match=r"libusb-1\.0\.so\.0.*apt install libusb-1\.0-0"):
        realsense.library()
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(CameraError, match=r"pip install 'freshfield\[realsense\]'"):
        realsense.library()
