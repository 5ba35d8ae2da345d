"""Input of every metric: images become float64 in [0, 1]; anything else is refused by name. Images as files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from freshfield.files import write_bytes

Image = NDArray[np.float64]
Color = tuple[float, float, float]

BLACK: Color = (0.0, 0.0, 0.0)


def color_behind(options: Mapping[str, Any]) -> Color:
    """The color in [0, 1] that a field of these options shows where images are transparent: white, or as they say."""
    named = str(options.get("background")).replace("black", "#000000")
    red, green, blue = bytes.fromhex(named[1:] if re.fullmatch("#[0-9a-fA-F]{6}", named) else "ffffff")
    return red / 255, green / 255, blue / 255


class ImageError(ValueError):
    """An image that cannot be scored; the message says which one, what is wrong and what was expected."""


def to_unit(image: NDArray, what: str = "image", background: Color = BLACK) -> Image:
    """``image`` as float64 (H, W, 3) in [0, 1].

    image: uint8 in 0..255 or floating in [0, 1], (H, W, 3) RGB or (H, W, 4) straight-alpha RGBA. Floating
    values outside [0, 1] are clipped, as on a screen.
    what: its name in error messages.
    background: color in [0, 1] that RGBA is composited over.
    Raises ImageError for any other shape or type, an empty image, NaN or infinity (any metric of those would
    be NaN).
    """
    array = np.asarray(image)
    if array.ndim != 3 or array.shape[2] not in (3, 4) or 0 in array.shape:
        raise ImageError(f"{what}: expected (height, width, 3 or 4), got shape {array.shape}")
    if array.dtype == np.uint8:
        unit = array.astype(np.float64) / 255.0
    elif np.issubdtype(array.dtype, np.floating):
        unit = array.astype(np.float64)
        bad = ~np.isfinite(unit)
        if bad.any():
            row, column, channel = np.argwhere(bad)[0]
            raise ImageError(
                f"{what}: {int(bad.sum())} of {unit.size} values are NaN or infinite, the first at "
                f"row {row}, column {column}, channel {channel}; a score of it would mean nothing"
            )
        unit = np.clip(unit, 0.0, 1.0)
    else:
        raise ImageError(f"{what}: expected uint8 or floating values, got {array.dtype}")
    if unit.shape[2] == 4:
        alpha = unit[..., 3:]
        unit = unit[..., :3] * alpha + np.asarray(background, dtype=np.float64) * (1.0 - alpha)
    return unit


def same_size(rendering: Image, truth: Image) -> None:
    """ImageError unless both have the same shape: silently resizing one would change the score."""
    if rendering.shape != truth.shape:
        raise ImageError(
            f"rendering is {rendering.shape[1]} x {rendering.shape[0]} but the truth is "
            f"{truth.shape[1]} x {truth.shape[0]}: render with the held-out camera's own intrinsics"
        )


def opaque(image: NDArray[np.uint8], background: Color) -> NDArray[np.uint8]:
    """Bytes (H, W, 3) of an image (H, W, 3 or 4), over ``background`` where it is transparent."""
    return image if image.shape[2] == 3 else to_bytes(to_unit(image, background=background).astype(np.float32))


def to_bytes(image: NDArray[np.uint8] | NDArray[np.float32]) -> NDArray[np.uint8]:
    """Colors (H, W, 3) in [0, 1] as bytes, rounded; bytes as they are."""
    if image.dtype == np.uint8:
        return np.asarray(image, np.uint8)
    unit: NDArray[np.float32] = np.asarray(image, np.float32)
    return (np.clip(unit, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB image (H, W, 3). Raises OSError, of which OpenCV's own writer says nothing."""
    write_bytes(path, cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes())
