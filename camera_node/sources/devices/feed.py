"""What the driver of a real camera offers: an open camera that hands out stamped images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Pinhole
from freshfield.scenario import Scenario

Image = NDArray[np.uint8]


class CameraError(ValueError):
    """A camera that cannot be used, or gave no frame; one line: what, where, what to do."""


class Feed(ABC):
    """An open camera. Constructed with (camera, device, config, fps, clock); raises CameraError.

    intrinsics: the device's own, for images as ``grab`` returns them; None where it knows none.
    no_intrinsics: why ``intrinsics`` is None and what to do, in one line; else "".
    stamped_by: where a frame's instant comes from, for people; known when the first frame has come.
    """

    intrinsics: Pinhole | None = None
    no_intrinsics: str = ""
    stamped_by: str = ""

    @classmethod  # noqa: B027
    def check(cls, scenario: Scenario, config: Any, cameras: Sequence[str]) -> None:
        """What can be known to be wrong before anything is opened. Raises ScenarioError or CameraError."""

    @abstractmethod
    def grab(self, timeout_s: float) -> tuple[int, Image] | None:
        """The next frame: when the middle of it was exposed (ns, our clock) and uint8 RGB (H, W, 3); None
        after ``timeout_s`` without one. Raises CameraError if the camera is gone."""

    @abstractmethod
    def close(self) -> None: ...


def as_camera_error(camera: str, error: Exception) -> CameraError:
    """What a camera's driver raised, in one line that names the camera."""
    if isinstance(error, CameraError):
        return error
    return CameraError(f"{camera}: {type(error).__name__}: {' '.join(str(error).split())}")


def select_device(camera: str, make: str, device: str | None, serials: Sequence[str]) -> int:
    """Index in ``serials`` (at least one) of the device that is named, or of the only one. Raises CameraError
    naming those that are there. make: for messages."""
    names = ", ".join(serials)
    if device is None:
        if len(serials) > 1:
            raise CameraError(f"{camera}: several {make} cameras, name one in source.devices: {names}")
        return 0
    if device not in serials:
        raise CameraError(f"{camera}: no {make} camera {device}; there are {names}")
    return serials.index(device)


def intrinsics_or_reason(find: Callable[[], Pinhole]) -> tuple[Pinhole | None, str]:
    """``intrinsics`` and ``no_intrinsics`` of a feed. Not an error yet: a calibration may replace them."""
    try:
        return find(), ""
    except CameraError as error:
        return None, str(error)
