"""The color stream of Intel RealSense D400 cameras, such as the thesis's D435i (thesis 4.3.1).

With the library's global time, stamps are on the host's clock; for a device without it, the device's clock is
mapped to ours by the fastest samples (``ArrivalClock``). A stamp is the beginning of the readout; if the
frame's metadata tell the middle of the exposure, that is used instead.
"""

from __future__ import annotations

import contextlib
from fractions import Fraction
from typing import Any, cast

import numpy as np

from camera_node.clocks import ArrivalClock
from camera_node.settings import RealsenseConfig
from camera_node.sources.devices.feed import (
    CameraError,
    Feed,
    Image,
    as_camera_error,
    intrinsics_or_reason,
    select_device,
)
from camera_node.sources.devices.lens_coefficients import fit_opencv_distortion
from freshfield.clock import Clock, SystemClock
from freshfield.geometry import Pinhole

_LONGEST_EXPOSURE_US = 200_000  # the color sensors of the series expose at most 165 ms


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


def find(camera: str, device: str | None) -> str:
    """The serial number of the camera to use: ``device``, or the only one if None. Raises CameraError naming
    those that are there.

    Queries the context, because a pipeline would search for a camera for 15 s.
    """
    rs = library()
    try:
        serials = [each.get_info(rs.camera_info.serial_number) for each in rs.context().query_devices()]
    except RuntimeError as error:  # while one is being plugged in
        raise as_camera_error(camera, error) from None
    if not serials:
        raise CameraError(
            f"{camera}: no RealSense camera found: is it plugged in (USB 3), and may this user open it (udev "
            "rules of librealsense, see deploy/lab)?"
        )
    return serials[select_device(camera, "RealSense", device, serials)]


class RealsenseFeed(Feed):
    """A running pipeline of one camera's color stream."""

    stamped_by = "the device, at the middle of the exposure where it tells that"

    def __init__(self, camera: str, device: str | None, config: RealsenseConfig, fps: Fraction, clock: Clock) -> None:
        rs = library()
        self._camera = camera
        wanted = rs.config()
        wanted.enable_device(find(camera, device))
        wanted.enable_stream(rs.stream.color, config.width, config.height, rs.format.rgb8, round(fps))
        self._pipeline = rs.pipeline()
        try:
            profile = self._pipeline.start(wanted)
        except RuntimeError as error:
            raise CameraError(
                f"{camera}: the RealSense camera offers no color stream of {config.width} x "
                f"{config.height} at {round(fps)} a second: {error}"
            ) from None
        try:
            found = self._set_up(profile, config)
        except RuntimeError as error:
            self.close()
            raise as_camera_error(camera, error) from None
        self.intrinsics, self.no_intrinsics = intrinsics_or_reason(lambda: lens(camera, found))
        self._stamps = FrameClock(clock, SystemClock())

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
        return as_grabbed(frame, self._stamps) if frame else None

    def close(self) -> None:
        with contextlib.suppress(RuntimeError):  # it may be gone
            self._pipeline.stop()


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
    return max(0, min(readout_us - exposed_us, _LONGEST_EXPOSURE_US)) * 1000


def as_grabbed(frame: Any, stamps: FrameClock) -> tuple[int, Image]:
    """The result of ``Feed.grab`` for an RGB frame. The image is copied, because the library reuses its
    memory."""
    return stamps.captured_ns(frame), cast(Image, np.array(frame.get_data(), dtype=np.uint8))


def lens(camera: str, intrinsics: Any) -> Pinhole:
    """Intrinsics from the library's. Raises CameraError for a lens model that is not OpenCV's."""
    rs = library()
    straight = intrinsics.model in (rs.distortion.none, rs.distortion.inverse_brown_conrady)
    if not straight and intrinsics.model not in (rs.distortion.brown_conrady, rs.distortion.modified_brown_conrady):
        raise CameraError(
            f"{camera}: lens model {intrinsics.model} is not supported: calibrate the camera and name "
            "the file in source.calibration"
        )
    # Color streams of the D400 are rectified; their coefficients describe the inverse, and are zero.
    distortion = [] if straight and not any(intrinsics.coeffs) else list(intrinsics.coeffs)
    if straight and distortion:
        raise CameraError(
            f"{camera}: its pictures are straightened by coefficients that cannot be undone here: calibrate "
            "the camera and name the file in source.calibration"
        )
    matrix = [[intrinsics.fx, 0, intrinsics.ppx], [0, intrinsics.fy, intrinsics.ppy], [0, 0, 1]]
    return fit_opencv_distortion(intrinsics.width, intrinsics.height, matrix, distortion)[0]
