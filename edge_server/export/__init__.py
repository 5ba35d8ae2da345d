"""What leaves the edge as files that other programs read: one module a format, none needs the others.

Everything written is whole or not there at all (``freshfield.files``). Conventions are those of the format:
each module says how they differ from ours (camera-to-world, OpenCV axes, metres, w-first quaternions).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Pinhole


class ExportError(ValueError):
    """Something that cannot be written as asked; the message says why and what to do."""


@dataclass(frozen=True)
class PosedImage:
    """A posed picture as formats want it. name: of the file, without folder or extension. image: uint8
    (H, W, 3 or 4). camera_to_world: (4, 4), OpenCV axes, metres. t_s: when, in seconds."""

    name: str
    image: NDArray[np.uint8]
    camera_to_world: NDArray[np.float64]
    intrinsics: Pinhole
    t_s: float = 0.0


def file_names(cameras: list[str]) -> list[str]:
    """A file name for each camera, without extension: its own last part where no two share it."""
    plain = [camera.replace("\\", "/").rsplit("/", 1)[-1].rsplit(".", 1)[0] or "camera" for camera in cameras]
    safe = ["".join(c if c.isalnum() or c in "-_." else "_" for c in name) for name in plain]
    return safe if len(set(safe)) == len(safe) else [f"{k:05d}_{name}" for k, name in enumerate(safe)]
