"""Exports fields and runs as files for other programs, one module per format.

Files are written atomically (``freshfield.files``). Each module states how its format's conventions differ
from ours (camera-to-world, OpenCV axes, meters, w-first quaternions).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Pinhole


class ExportError(ValueError):
    """The export cannot be written as asked; the message says why and what to do."""


@dataclass(frozen=True)
class PosedImage:
    """An image with its pose. name: file name without folder and extension. image: uint8 (H, W, 3 or 4).
    camera_to_world: (4, 4), OpenCV axes, meters."""

    name: str
    image: NDArray[np.uint8]
    camera_to_world: NDArray[np.float64]
    intrinsics: Pinhole


def file_names(cameras: list[str]) -> list[str]:
    """A file name per camera, without extension: the last part of its name, numbered if two are equal."""
    plain = [camera.replace("\\", "/").rsplit("/", 1)[-1].rsplit(".", 1)[0] or "camera" for camera in cameras]
    safe = ["".join(c if c.isalnum() or c in "-_." else "_" for c in name) for name in plain]
    return safe if len(set(safe)) == len(safe) else [f"{k:05d}_{name}" for k, name in enumerate(safe)]
