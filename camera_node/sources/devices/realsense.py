"""The color and depth streams of Intel RealSense D400 cameras, such as the thesis's D435i (thesis 4.3.1).

Depth is sent as it is measured, with the intrinsics and the place of its own sensor: aligning it to the color stream
would cost time here, and pixels. A camera that cannot stream both, as on USB 2, streams color alone.

With the library's global time, stamps are on the host's clock; for a device without it, the device's clock is
mapped to ours by the fastest samples (``ArrivalClock``). A stamp is the beginning of the readout; if the
frame's metadata tell the middle of the exposure, that is used instead.
"""

from __future__ import annotations

import contextlib
import logging
from fractions import Fraction
from typing import Any, cast

import numpy as np

from camera_node.clocks import ArrivalClock
from camera_node.settings import RealsenseConfig
from camera_node.sources import source_constants as tuned
from camera_node.sources.devices.feed import (
    CameraError,
    Feed,
    Image,
    Plugged,
    as_camera_error,
    intrinsics_or_reason,
    select_device,
)
from freshfield.clock import Clock, SystemClock
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole, Pose, se3

log = logging.getLogger("camera-node")

_ADVICE = "is it plugged in (USB 3), and may this user open it (udev rules of librealsense, see deploy/lab)?"


def library() -> Any:
    """The module pyrealsense2. Raises CameraError saying what to install."""
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise CameraError(
            "RealSense cameras need the package pyrealsense2: pip install 'freshfield[realsense]'"
        ) from None
    except ImportError as error:  # it is there, and lacks a library of the system's
        raise CameraError(
            f"RealSense cameras: pyrealsense2 cannot be loaded: {error}; on Debian and Ubuntu: apt install libusb-1.0-0"
        ) from None
    return pyrealsense2


def plugged_in() -> list[Plugged]:
    """The devices. Raises CameraError without the library, RuntimeError while one is being plugged in.

    Queries the context, because a pipeline would search for a camera for 15 s.
    """
    rs = library()
    serial, name = rs.camera_info.serial_number, rs.camera_info.name
    return [Plugged(each.get_info(serial), each.get_info(name)) for each in rs.context().query_devices()]


class RealsenseFeed(Feed):
    """A running pipeline of one camera's color stream, and of its depth unless ``depth_every`` is 0."""

    stamped_by = "the device, at the middle of the exposure where it tells that"

    def __init__(self, camera: str, device: str | None, config: RealsenseConfig, fps: Fraction, clock: Clock) -> None:
        rs = library()
        self._camera = camera
        self._pipeline = rs.pipeline()
        self._sensor: DepthSensor | None = None
        serial = select_device(camera, "RealSense", device, plugged_in, _ADVICE).serial
        size_and_rate = (config.width, config.height, round(fps))
        try:
            profile = self._start(serial, size_and_rate, bool(config.depth_every))
        except RuntimeError as error:
            raise CameraError(
                f"{camera}: the RealSense camera offers no color stream of {config.width} x "
                f"{config.height} at {round(fps)} a second: {error}"
            ) from None
        try:
            found = self._set_up(profile, config)
            if any(stream.stream_type() == rs.stream.depth for stream in profile.get_streams()):
                self._sensor = DepthSensor(camera, profile, FrameClock(clock, SystemClock()))
        except (RuntimeError, CameraError) as error:
            self.close()
            raise as_camera_error(camera, error) from None
        self.intrinsics, self.no_intrinsics = intrinsics_or_reason(lambda: lens(camera, found))
        self._stamps = FrameClock(clock, SystemClock())

    def _start(self, serial: str, size_and_rate: tuple[int, int, int], with_depth: bool) -> Any:
        """Start the pipeline, without depth if it cannot start with it. Returns its profile. Raises RuntimeError."""
        rs = library()
        wanted = rs.config()
        wanted.enable_device(serial)
        *size, rate = size_and_rate
        wanted.enable_stream(rs.stream.color, *size, rs.format.rgb8, rate)
        if not with_depth:
            return self._pipeline.start(wanted)
        wanted.enable_stream(rs.stream.depth, *size, rs.format.z16, rate)
        try:
            return self._pipeline.start(wanted)
        except RuntimeError as error:
            log.warning("%s: no depth of %d x %d at %d a second: %s", self._camera, *size_and_rate, error)
            return self._start(serial, size_and_rate, with_depth=False)

    def _set_up(self, profile: Any, config: RealsenseConfig) -> Any:
        """Enable global time and set the exposure. Returns the library's intrinsics."""
        rs = library()
        for sensor in profile.get_device().query_sensors():
            if sensor.supports(rs.option.global_time_enabled):
                sensor.set_option(rs.option.global_time_enabled, 1)
            if sensor.is_color_sensor() and config.exposure_us is not None:
                sensor.set_option(rs.option.enable_auto_exposure, 0)
                sensor.set_option(rs.option.exposure, config.exposure_us / 100.0)  # it counts 100 us
        stream = profile.get_stream(rs.stream.color).as_video_stream_profile()
        return stream.get_intrinsics()

    def grab(self, timeout_s: float) -> tuple[int, Image] | None:
        try:
            arrived, frames = self._pipeline.try_wait_for_frames(round(timeout_s * 1e3))
        except RuntimeError as error:
            raise CameraError(f"{self._camera}: the RealSense camera is gone: {error}") from None
        frame = frames.get_color_frame() if arrived else None
        if not frame:
            return None
        captured_ns = self._stamps.captured_ns(frame)
        measured = frames.get_depth_frame() if self._sensor is not None else None
        self.depth = self._sensor.image(measured, captured_ns) if self._sensor is not None and measured else None
        # The image is copied, because the library reuses its memory.
        return captured_ns, cast(Image, np.array(frame.get_data(), dtype=np.uint8))

    def close(self) -> None:
        with contextlib.suppress(RuntimeError):  # it may be gone
            self._pipeline.stop()


class DepthSensor:
    """Converts depth frames. stamps: of the depth stream. Raises CameraError for a lens that is not OpenCV's."""

    def __init__(self, camera: str, profile: Any, stamps: FrameClock) -> None:
        rs = library()
        streams = [profile.get_stream(kind).as_video_stream_profile() for kind in (rs.stream.depth, rs.stream.color)]
        self._stamps = stamps
        self._meters_per_count = float(profile.get_device().first_depth_sensor().get_depth_scale())
        self._lens = lens(camera, streams[0].get_intrinsics())
        place = streams[0].get_extrinsics_to(streams[1])  # rotation column by column, meters
        rotation = np.array(place.rotation, dtype=np.float64).reshape(3, 3).T
        self._to_camera = Pose.from_matrix(se3(rotation, place.translation))

    def image(self, frame: Any, image_ns: int) -> DepthImage:
        """The measurement of a depth frame, with an image that was captured at ``image_ns``."""
        counts = np.array(frame.get_data(), dtype=np.uint16)
        after_ns = self._stamps.captured_ns(frame) - image_ns
        return DepthImage(counts, self._meters_per_count, self._lens, self._to_camera, after_ns)


class FrameClock:
    """Converts frame stamps to ``clock`` (ns). system: the clock of the library's UTC stamps."""

    def __init__(self, clock: Clock, system: Clock) -> None:
        self._clock, self._system = clock, system
        self._device = ArrivalClock()

    def captured_ns(self, frame: Any) -> int:
        """When a frame was captured, on ``clock``. Stamps of global and system time are on the host's UTC
        clock; the frame's age on that clock is subtracted from ours, which does not step."""
        rs = library()
        now_ns, stamp_ns = self._clock.now_ns(), round(frame.get_timestamp() * 1e6) - _since_exposed_ns(frame)
        if frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock:
            return self._device.host_ns(stamp_ns, now_ns)
        return now_ns - (self._system.now_ns() - stamp_ns)


def _since_exposed_ns(frame: Any) -> int:
    """Time from the middle of the exposure to the frame's stamp; 0 if the metadata do not tell."""
    value = library().frame_metadata_value
    keys = (value.frame_timestamp, value.sensor_timestamp)
    if not all(frame.supports_frame_metadata(key) for key in keys):
        return 0
    readout_us, exposed_us = (frame.get_frame_metadata(key) for key in keys)
    return max(0, min(readout_us - exposed_us, tuned.LONGEST_EXPOSURE_US)) * 1000


def lens(camera: str, intrinsics: Any) -> Pinhole:
    """Intrinsics from the library's. Raises CameraError for a lens model that is not OpenCV's."""
    rs = library()
    straight = intrinsics.model in (rs.distortion.none, rs.distortion.inverse_brown_conrady)
    if not straight and intrinsics.model not in (rs.distortion.brown_conrady, rs.distortion.modified_brown_conrady):
        raise CameraError(
            f"{camera}: lens model {intrinsics.model} is not supported: calibrate the camera and name "
            "the file in source.calibration"
        )
    k1, k2, p1, p2, k3 = map(float, intrinsics.coeffs)
    # Color streams of the D400 are rectified; their coefficients describe the inverse, and are zero.
    if k3 or (straight and any((k1, k2, p1, p2))):
        raise CameraError(
            f"{camera}: its pictures are bent by coefficients that a frame cannot carry: calibrate "
            "the camera and name the file in source.calibration"
        )
    # Pixel centers are at whole numbers there.
    center = (float(intrinsics.ppx) + 0.5, float(intrinsics.ppy) + 0.5)
    size = (intrinsics.width, intrinsics.height)
    return Pinhole(*size, float(intrinsics.fx), float(intrinsics.fy), *center, (k1, k2, p1, p2))
