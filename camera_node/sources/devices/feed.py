"""The interface of drivers for real cameras: an open camera that returns time-stamped images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole

Image = NDArray[np.uint8]


class CameraError(ValueError):
    """A camera that cannot be used, or gave no frame. The message is one line: what, where, what to do."""


class Feed(ABC):
    """An open camera. Constructed with (camera, device, config, fps, clock); raises CameraError.

    intrinsics: the device's own, for images as ``grab`` returns them; None if it has none.
    no_intrinsics: one line on why ``intrinsics`` is None and what to do; else "".
    stamped_by: where time stamps come from, for people; known after the first frame.
    depth: what a depth sensor measured with the frame that ``grab`` returned last; None: nothing, or there is none.
    """

    intrinsics: Pinhole | None = None
    no_intrinsics: str = ""
    stamped_by: str = ""
    depth: DepthImage | None = None

    @abstractmethod
    def grab(self, timeout_s: float) -> tuple[int, Image] | None:
        """The next frame: the middle of its exposure (ns, our clock) and uint8 RGB (H, W, 3); None if no
        frame came within ``timeout_s``. Raises CameraError if the camera is gone."""

    @abstractmethod
    def close(self) -> None: ...


def as_camera_error(camera: str, error: Exception) -> CameraError:
    """A driver's exception as a CameraError, in one line that names the camera."""
    if isinstance(error, CameraError):
        return error
    return CameraError(f"{camera}: {type(error).__name__}: {' '.join(str(error).split())}")


def select_device(camera: str, make: str, device: str | None, serials: Sequence[str]) -> int:
    """Index in ``serials`` of the device to use.

    camera, make: for error messages.
    device: its serial number; None: the only one.
    serials: serial numbers of the connected devices, at least one.
    Raises CameraError if the device is not connected, or None was given and there are several.
    """
    names = ", ".join(serials)
    if device is None:
        if len(serials) > 1:
            raise CameraError(f"{camera}: several {make} cameras, name one in source.devices: {names}")
        return 0
    if device not in serials:
        raise CameraError(f"{camera}: no {make} camera {device}; there are {names}")
    return serials.index(device)


def intrinsics_or_reason(find: Callable[[], Pinhole]) -> tuple[Pinhole | None, str]:
    """``intrinsics`` and ``no_intrinsics`` of a feed. A CameraError of ``find`` is no error yet, because a
    calibration file may replace the intrinsics."""
    try:
        return find(), ""
    except CameraError as error:
        return None, str(error)
