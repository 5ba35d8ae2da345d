"""Luxonis OAK cameras through depthai 3: color frames stamped at the middle of their exposure (thesis 4.3.1).

The library synchronizes the device's clock with the host's. The device straightens the picture by the calibration
that is stored in it, and an autofocus lens is fixed at the position at which it was calibrated. A device that has a
stereo pair also measures depth and registers it to the straightened image; one that was never calibrated does neither.
"""

from __future__ import annotations

import datetime
import os
from fractions import Fraction
from typing import Any, cast

import numpy as np

from camera_node.settings import OakConfig
from camera_node.sources import source_constants as tuned
from camera_node.sources.devices.feed import CameraError, Feed, Image, Plugged, intrinsics_or_reason, select_device
from freshfield.clock import Clock
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole

_ADVICE = (
    "is it plugged in (USB 3, its own supply), and may this user open it (udev rule for vendor 03e7, see deploy/lab)?"
)
# Of the pair's images: what the mono cameras of all models offer, and what depth is computed from.
_STEREO_SIZE = (640, 400)
METERS_PER_COUNT = 0.001  # depthai's depth is in millimeters unless told otherwise


def library() -> Any:
    """The module depthai. Raises CameraError saying what to install."""
    os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", str(tuned.OAK_SEARCH_MS))
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    # Its signal handlers would end the node when a file reaches its size limit (SIGXFSZ).
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
    try:
        import depthai
    except ImportError:
        raise CameraError("OAK cameras need the package depthai: pip install 'freshfield[oak]'") from None
    return depthai


def plugged_in() -> list[Plugged]:
    """The devices. Raises CameraError without the library, RuntimeError while one is being plugged in."""
    there = library().Device.getAllAvailableDevices()
    return [Plugged(each.getDeviceId(), f"{each.name} {each.state.name}", each) for each in there]


class OakFeed(Feed):
    """A running depthai pipeline of one camera."""

    stamped_by = "the device, at the middle of the exposure"

    def __init__(self, camera: str, device: str | None, config: OakConfig, fps: Fraction, clock: Clock) -> None:
        dai = library()
        sockets = dai.CameraBoardSocket.__members__
        if config.socket not in sockets:
            raise CameraError(f"{camera}: source.socket: expected one of {', '.join(sockets)}")
        self._device: Any = None
        self._pipeline: Any = None
        self._depths: Any = None
        self._camera, self._clock = camera, clock
        try:
            self._device = dai.Device(select_device(camera, "OAK", device, plugged_in, _ADVICE).handle)
            self._pipeline = dai.Pipeline(self._device)
            socket = getattr(dai.CameraBoardSocket, config.socket)
            node = self._pipeline.create(dai.node.Camera).build(socket)
            calibration = self._device.readCalibration()
            focus = calibrated_focus(calibration, socket)
            if focus:
                node.initialControl.setManualFocus(focus)
            if config.exposure_us is not None:
                node.initialControl.setManualExposure(config.exposure_us, config.iso)
            size = (config.width, config.height)
            self.intrinsics, self.no_intrinsics = intrinsics_or_reason(lambda: lens(camera, calibration, socket, size))
            calibrated = self.intrinsics is not None
            output = node.requestOutput(size, dai.ImgFrame.Type.BGR888i, fps=float(fps), enableUndistortion=calibrated)
            self._frames = output.createOutputQueue(maxSize=2, blocking=False)
            pairs = self._device.getStereoPairs() if config.depth_every and calibrated else []
            if pairs:
                self._depths = self._measure_depth(pairs[0], output, float(fps))
            self._pipeline.start()
        except Exception as error:
            self.close()
            if isinstance(error, CameraError):
                raise
            raise CameraError(f"{camera}: the OAK camera could not be started: {_first_line(error)}") from None

    def _measure_depth(self, pair: Any, image: Any, fps: float) -> Any:
        """Add stereo of a pair of cameras, registered to the output ``image``. Returns the queue of depth frames."""
        dai = library()
        stereo = self._pipeline.create(dai.node.StereoDepth)
        for socket, seen_by in ((pair.left, stereo.left), (pair.right, stereo.right)):
            camera = self._pipeline.create(dai.node.Camera).build(socket)
            camera.requestOutput(_STEREO_SIZE, fps=fps).link(seen_by)
        registered = stereo.depth
        if self._device.getPlatform() == dai.Platform.RVC4:  # its stereo cannot register depth itself
            align = self._pipeline.create(dai.node.ImageAlign)
            stereo.depth.link(align.input)
            image.link(align.inputAlignTo)
            registered = align.outputAligned
        else:
            image.link(stereo.inputAlignTo)
        return registered.createOutputQueue(maxSize=2, blocking=False)

    def grab(self, timeout_s: float) -> tuple[int, Image] | None:
        taken = next_frame(self._camera, self._frames, self._clock, timeout_s)
        self.depth = newest_depth(self._depths, self._clock, taken[0]) if taken and self._depths is not None else None
        return taken

    def close(self) -> None:
        if self._pipeline is not None:
            self._pipeline.stop()
        if self._device is not None:
            self._device.close()


def next_frame(camera: str, queue: Any, clock: Clock, timeout_s: float) -> tuple[int, Image] | None:
    """As ``Feed.grab``, of a depthai queue of color frames."""
    try:
        frame = queue.get(datetime.timedelta(seconds=timeout_s))
    except (RuntimeError, library().MessageQueue.QueueException) as error:
        raise CameraError(f"{camera}: the OAK camera is gone: {_first_line(error)}") from None
    if frame is None:
        return None
    return captured_ns(frame, clock), cast(Image, np.ascontiguousarray(frame.getCvFrame()[:, :, ::-1]))


def newest_depth(queue: Any, clock: Clock, image_ns: int) -> DepthImage | None:
    """The newest frame of a depthai queue of depth in millimeters, registered to the images; None: none came since the
    last one. image_ns: when its image was captured. That the device is gone is said by the images' queue."""
    frames = queue.tryGetAll()
    if not frames:
        return None
    counts = np.array(frames[-1].getFrame(), dtype=np.uint16)
    return DepthImage(counts, METERS_PER_COUNT, after_image_ns=captured_ns(frames[-1], clock) - image_ns)


def captured_ns(frame: Any, clock: Clock) -> int:
    """The middle of a frame's exposure on ``clock``."""
    dai = library()
    age = dai.Clock.now() - frame.getTimestamp(dai.CameraExposureOffset.MIDDLE)
    return clock.now_ns() - (age // datetime.timedelta(microseconds=1)) * 1000


def calibrated_focus(calibration: Any, socket: Any) -> int:
    """Lens position (1 to 255) at which the device was calibrated; 0 for a fixed lens or an uncalibrated
    device. At other positions the focal length differs."""
    try:
        return int(calibration.getLensPosition(socket))
    except RuntimeError:
        return 0


def lens(camera: str, calibration: Any, socket: Any, size: tuple[int, int]) -> Pinhole:
    """Intrinsics of the images that the device straightens, from its calibration.

    size: width and height of the images. Raises CameraError if the device was never calibrated.
    """
    try:
        matrix = np.array(calibration.getCameraIntrinsics(socket, *size))
    except RuntimeError as error:
        raise CameraError(
            f"{camera}: the device holds no calibration of this camera ({_first_line(error)}): "
            "calibrate it and name the file in source.calibration"
        ) from None
    return Pinhole.from_opencv(*size, matrix)


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0]
