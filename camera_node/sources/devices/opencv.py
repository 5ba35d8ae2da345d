"""Any camera that OpenCV can open: USB cameras, and network cameras by address.

Linux drivers (V4L2) stamp a frame when its transfer begins, on the machine's monotonic clock, and OpenCV
returns that stamp; if the exposure is fixed, half of it is subtracted. Stamps of other back ends cannot be
trusted; for them the arrival time minus ``latency_ms`` is used. The first frame decides which of the two is
used while the camera is open. A thread (``live``) reads without pause, so that no frame ages in the driver.
"""

from __future__ import annotations

import logging
import time
from fractions import Fraction
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from camera_node.settings import CameraConfig
from camera_node.sources import source_constants as tuned
from camera_node.sources.devices.feed import CameraError, Feed, Image
from freshfield.clock import Clock

log = logging.getLogger("camera-node")

_BY_KERNEL, _BY_ARRIVAL = "the kernel", "their arrival, less latency_ms"
_MANUAL = 1  # V4L2's value for manual exposure


class OpenCvFeed(Feed):
    """An open ``cv2.VideoCapture``, which has no intrinsics."""

    def __init__(self, camera: str, device: str | None, config: CameraConfig, fps: Fraction, clock: Clock) -> None:
        self._camera, self._clock = camera, clock
        self.no_intrinsics = (
            f"{camera}: this camera does not know its intrinsics: calibrate it (camera-node calibrate "
            "intrinsics) and name the file in source.calibration"
        )
        self._latency_ns = round(config.latency_ms * 1e6)
        self._half_exposure_ns = (config.exposure_us or 0) * 500
        self._capture = _open(camera, "0" if device is None else device)
        self._v4l2 = self._capture.getBackendName() == "V4L2"
        for key, value in (
            (cv2.CAP_PROP_FRAME_WIDTH, config.width),
            (cv2.CAP_PROP_FRAME_HEIGHT, config.height),
            (cv2.CAP_PROP_FPS, float(fps)),
            # One is filled while OpenCV decodes the other, which it gives back to V4L2 only then: with one alone a
            # camera loses the frame that begins meanwhile, and with it up to half of its rate.
            (cv2.CAP_PROP_BUFFERSIZE, 2),
        ):
            self._capture.set(key, value)  # an unsupported value is ignored; the images show the real size
        if config.exposure_us is not None:
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
            self._capture.set(cv2.CAP_PROP_EXPOSURE, config.exposure_us / 100.0)  # V4L2 counts 100 us

    def grab(self, timeout_s: float) -> tuple[int, Image] | None:
        """As ``Feed.grab``, but it waits as long as the driver does (network cameras: two seconds)."""
        if not self._capture.grab():
            raise CameraError(f"{self._camera}: the camera gives no more frames: unplugged, or its stream ended")
        age_ns = self._age_ns()
        if age_ns is None:
            return None
        captured_ns = self._clock.now_ns() - age_ns
        ok, picture = self._capture.retrieve()
        if not ok or picture is None:
            raise CameraError(f"{self._camera}: a frame could not be decoded")
        return captured_ns, cast(Image, np.ascontiguousarray(picture[:, :, ::-1]))

    def _age_ns(self) -> int | None:
        """Age of the frame that was just grabbed; None if it is unknown because its stamp, unlike the first
        frame's, is not from the machine's clock."""
        stamp_age_ns = None
        if self._v4l2 and self.stamped_by != _BY_ARRIVAL:
            stamp_age_ns = time.monotonic_ns() - round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            if not 0 <= stamp_age_ns < tuned.PLAUSIBLE_NS:
                stamp_age_ns = None
        if not self.stamped_by:
            self.stamped_by = _BY_ARRIVAL if stamp_age_ns is None else _BY_KERNEL
            log.info("%s: its frames are stamped by %s", self._camera, self.stamped_by)
        if self.stamped_by == _BY_ARRIVAL:
            return self._latency_ns
        return None if stamp_age_ns is None else stamp_age_ns + self._half_exposure_ns

    def close(self) -> None:
        self._capture.release()


def _open(camera: str, device: str) -> cv2.VideoCapture:
    if "://" in device:
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, tuned.OPEN_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, tuned.READ_MS]
        capture = cv2.VideoCapture(device, cv2.CAP_FFMPEG, limits)
        advice = "is the address right, and does the camera answer there?"
    else:
        if Path(device).is_file():
            raise CameraError(
                f"{camera}: no camera at {device}: it is a file, not a device: a recorded video is a source of kind "
                "video (freshfield scenario init FILE.yaml --like videos)"
            )
        if device.isdecimal():
            missing = not Path(f"/dev/video{device}").exists()
            capture = cv2.VideoCapture() if missing else cv2.VideoCapture(int(device), cv2.CAP_V4L2)
        else:
            capture = cv2.VideoCapture(device, cv2.CAP_V4L2) if Path(device).exists() else cv2.VideoCapture()
        advice = "is it plugged in, is the user in the group video, does another program hold it?"
    if not capture.isOpened():
        raise CameraError(f"{camera}: no camera at {device}: {advice}")
    return capture
