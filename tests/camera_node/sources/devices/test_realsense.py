"""The RealSense source with the real library and its software device, which makes real frames."""

from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import MagicMock

import numpy as np
import pytest

from camera_node.settings import source_config
from camera_node.sources.devices.feed import CameraError, Plugged
from freshfield.clock import VirtualClock, WallClock
from freshfield.geometry import look_at
from freshfield.scenario import parse
from tests.support import refused

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


def config(**source):
    source = {"kind": "realsense", **source}
    return source_config(parse({"cameras": {"ids": ["eye"]}, "source": source}, Path("scenario.yaml")))


def frame_of(stream, values, stamp_ms, metadata=()):
    """A frame of global time as the library hands it out. stream: a profile of ``Both``. metadata: (key, value)."""
    sensor, queue = stream.sensor, rs.frame_queue(2)
    sensor.open(stream.profile)
    sensor.start(queue)
    for key, value in metadata:
        sensor.set_metadata(key, value)
    frame = rs.software_video_frame()
    frame.pixels, frame.stride, frame.bpp = values, values.strides[0], values.strides[1]
    frame.timestamp, frame.domain, frame.frame_number = stamp_ms, rs.timestamp_domain.global_time, 1
    frame.profile = stream.profile.as_video_stream_profile()
    sensor.on_video_frame(frame)
    taken = queue.wait_for_frame(5000)
    sensor.stop()
    sensor.close()
    return taken


def test_global_time_is_the_hosts_moved_to_the_middle_of_the_exposure():
    key = rs.frame_metadata_value
    told = [(key.frame_timestamp, 5_012_000), (key.sensor_timestamp, 5_000_000)]
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for metadata, age_ns in (([], 40e6), (told, 52e6)):
        color = Both(np.eye(4), 0.001).streams[rs.stream.color]
        frame = frame_of(color, image, SYSTEM_NS / 1e6 - 40.0, metadata).as_video_frame()
        captured_ns = realsense.FrameClock(*CLOCKS).captured_ns(frame)
        assert captured_ns == pytest.approx(OURS_NS - age_ns, abs=1e3)


@pytest.fixture
def pipeline(monkeypatch):
    """A stand-in, since the library's own finds no device."""
    made = MagicMock()
    monkeypatch.setattr(rs, "pipeline", lambda: made)
    monkeypatch.setattr(realsense, "plugged_in", lambda: [Plugged("1", "D435I")])
    return made


def test_a_lens_that_is_not_opencvs_opens_all_the_same(pipeline):
    """Whoever calibrated it themselves names the file: the device is not asked."""
    stream = pipeline.start.return_value.get_stream.return_value.as_video_stream_profile.return_value
    stream.get_intrinsics.return_value = intrinsics(rs.distortion.kannala_brandt4)
    feed = realsense.RealsenseFeed("eye", None, config(), Fraction(15), WallClock())
    assert feed.intrinsics is None and "name the file in source.calibration" in feed.no_intrinsics
    stream.get_intrinsics.side_effect = RuntimeError("get_intrinsics failed\nlast error: 5")
    with pytest.raises(CameraError, match=r"^eye: RuntimeError: get_intrinsics failed last error: 5$"):
        realsense.RealsenseFeed("eye", None, config(), Fraction(15), WallClock())
    assert pipeline.stop.called


def test_intrinsics_are_the_devices_or_refused_if_a_frame_cannot_carry_them():
    lens = realsense.lens("eye", intrinsics())
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (60.0, 61.0, 32.0, 24.0) and not lens.distorted
    bent = realsense.lens("eye", intrinsics(rs.distortion.brown_conrady, (-0.1, 0.02, 1e-3, -1e-3, 0.0)))
    assert np.allclose(bent.distortion, (-0.1, 0.02, 1e-3, -1e-3), atol=1e-6)
    for model, coefficients in ((None, (0.1, 0, 0, 0, 0)), (rs.distortion.brown_conrady, (0.1, 0, 0, 0, 0.2))):
        refused(CameraError, "a frame cannot carry", realsense.lens, "eye", intrinsics(model, coefficients))


class Stream(NamedTuple):
    sensor: Any
    profile: Any


class Both:
    """The profile of a pipeline that streams both; streams and device are the library's own."""

    def __init__(self, apart: np.ndarray, scale: float) -> None:
        device = rs.software_device()
        self.streams: dict[Any, Stream] = {}
        for kind, form, bpp in ((rs.stream.depth, rs.format.z16, 2), (rs.stream.color, rs.format.rgb8, 3)):
            sensor = device.add_sensor(kind.name)
            stream = rs.video_stream()
            stream.type, stream.uid, stream.width, stream.height = kind, bpp, WIDTH, HEIGHT
            stream.fps, stream.bpp, stream.fmt, stream.intrinsics = 30, bpp, form, intrinsics()
            self.streams[kind] = Stream(sensor, sensor.add_video_stream(stream))
        depth, color = self.streams.values()
        depth.sensor.add_read_only_option(rs.option.depth_units, scale)
        place = rs.extrinsics()
        place.rotation, place.translation = apart[:3, :3].T.ravel().tolist(), apart[:3, 3].tolist()
        depth.profile.register_extrinsics_to(color.profile, place)
        self.get_device = lambda: device
        self.get_stream = lambda kind: self.streams[kind].profile


def test_depth_comes_with_its_unit_its_lens_its_place_and_its_time():
    apart = look_at([0.015, 0.001, 0.0], [0.03, 0.001, 2.0], up=(0.0, -1.0, 0.0))
    both = Both(apart, 0.0005)
    sensor = realsense.DepthSensor("eye", both, realsense.FrameClock(*CLOCKS))
    counts = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    frame = frame_of(both.streams[rs.stream.depth], counts, SYSTEM_NS / 1e6 - 40.0)
    found = sensor.image(frame, OURS_NS - 50_000_000)
    assert np.array_equal(found.counts, counts) and found.counts.dtype == np.uint16
    assert found.meters_per_count == pytest.approx(0.0005)
    assert found.after_image_ns == pytest.approx(10e6, abs=1e3)
    assert (found.intrinsics.fx, found.intrinsics.cx) == (60.0, 32.0)
    # A point in front of the depth sensor, in the camera's axes as the library itself moves it.
    place = both.get_stream(rs.stream.depth).get_extrinsics_to(both.get_stream(rs.stream.color))
    expected = rs.rs2_transform_point_to_point(place, [0.1, -0.2, 1.5])
    assert np.allclose((found.to_camera.matrix() @ [0.1, -0.2, 1.5, 1.0])[:3], expected, atol=1e-6)
    assert np.allclose(found.to_camera.matrix(), apart, atol=1e-6)


@pytest.mark.parametrize("every", [0, 5])
def test_a_camera_that_cannot_stream_both_streams_color(pipeline, caplog, every):
    profile = pipeline.profile
    pipeline.start.side_effect = [RuntimeError("Couldn't resolve requests"), profile] if every else [profile]
    profile.get_stream.return_value.as_video_stream_profile.return_value.get_intrinsics.return_value = intrinsics()
    profile.get_streams.return_value = [MagicMock(stream_type=lambda: rs.stream.color)]
    feed = realsense.RealsenseFeed("eye", None, config(depth_every=every), Fraction(15), WallClock())
    assert pipeline.start.call_count == (2 if every else 1) and feed.intrinsics is not None and feed.depth is None
    assert ("eye: no depth of 640 x 400 at 15 a second: Couldn't" in caplog.text) == bool(every)
