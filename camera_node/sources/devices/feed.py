"""The interface of drivers for real cameras: an open camera that returns time-stamped images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

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


class Plugged(NamedTuple):
    """A device that is there. serial: its name in ``source.devices``; "" where there is none. about: its make, or why
    there is none. handle: what its driver opens, where not the serial."""

    serial: str
    about: str
    handle: Any = None


def select_device(
    camera: str, make: str, device: str | None, plugged_in: Callable[[], Sequence[Plugged]], advice: str
) -> Plugged:
    """The device to use.

    camera, make: for error messages.
    device: its serial number; None: the only one.
    plugged_in: finds those that are there; may raise RuntimeError while one is being plugged in.
    advice: what to look for where there is none.
    Raises CameraError if the device is not there, or None was given and there are several.
    """
    try:
        there = {each.serial: each for each in plugged_in()}
    except RuntimeError as error:
        raise as_camera_error(camera, error) from None
    if not there:
        raise CameraError(f"{camera}: no {make} camera found: {advice}")
    names = ", ".join(there)
    if device is None and len(there) > 1:
        raise CameraError(f"{camera}: several {make} cameras, name one in source.devices: {names}")
    if device is not None and device not in there:
        raise CameraError(f"{camera}: no {make} camera {device}; there are {names}")
    return there[next(iter(there)) if device is None else device]


def intrinsics_or_reason(find: Callable[[], Pinhole]) -> tuple[Pinhole | None, str]:
    """``intrinsics`` and ``no_intrinsics`` of a feed. A CameraError of ``find`` is no error yet, because a
    calibration file may replace the intrinsics."""
    try:
        return find(), ""
    except CameraError as error:
        return None, str(error)
