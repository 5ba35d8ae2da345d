"""Reads images, and shrinks them without color fringes: by area averages with premultiplied alpha."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.sources import source_constants as tuned
from camera_node.sources.datasets.records import DatasetError, Image
from freshfield import payload
from freshfield.geometry import Pinhole
from freshfield.untrusted import check_file, read_bytes


def decode_file(path: Path, flags: int) -> NDArray[Any] | None:
    """Like ``cv2.imread``, with its ``flags``, but returns None also for a file that is cut short, of which
    ``cv2.imread`` returns the rest as gray, and for a header that states more pixels than OpenCV's limit."""
    try:
        data = read_bytes(path)
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except (OSError, cv2.error):
        return None


def read_numbers(path: Path) -> NDArray[Any]:
    """The array of a ``.npy`` file, which holds no objects. Raises DatasetError."""
    try:
        check_file(path)
        found = np.load(path, allow_pickle=False)
        return found if isinstance(found, np.ndarray) else np.empty(0)  # several arrays are none here
    except Exception as error:  # numpy reads a damaged header as Python, which raises anything
        why = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(f"{path}: cannot be read as numbers of numpy: {why}; is it complete?") from None


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file as stored; of JPEG and PNG from the header. Raises DatasetError."""
    check_file(path)
    with path.open("rb") as file:
        head = file.read(tuned.HEADER_BYTES)
    if head[:8] == b"\x89PNG\r\n\x1a\n" and len(head) >= 24:
        width, height = struct.unpack(">II", head[16:24])
        return width, height
    size = payload.jpeg_size(head)
    if size is None:
        height, width = read_image(path).shape[:2]
        return width, height
    return size


def read_image(path: Path, upright: bool = False) -> Image:
    """Read an image as uint8 RGB (H, W, 3) or straight-alpha RGBA (H, W, 4); alpha that hides nothing is left out.

    upright: rotate it as its EXIF data say; otherwise its pixels are as stored, to which poses and intrinsics belong
    (``photo.fitted``). Raises DatasetError.
    """
    image = decode_file(path, cv2.IMREAD_COLOR if upright else cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(
            f"{path}: damaged or cut short, not an image that OpenCV can read, or larger than its limit: copy it again"
        )
    if image.dtype == np.uint16:
        image = (image // 256).astype(np.uint8)
    if image.dtype != np.uint8:
        raise DatasetError(f"{path}: expected 8 or 16 bits a channel, got {image.dtype}")
    if image.ndim == 2:
        return as_image(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB))
    if image.shape[2] == 4 and image[..., 3].min() == 255:
        image = image[..., :3]
    return as_image(cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB))


def as_image(array: np.ndarray) -> Image:
    """The same array, cast for type checkers: OpenCV's stubs do not say that uint8 in gives uint8 out."""
    return cast(Image, array)


def resize(image: Image, width: int, height: int) -> Image:
    """Resize by area averages. Colors are weighted with alpha, so that those of transparent pixels do not
    bleed into the edges."""
    if image.shape[:2] == (height, width):
        return image
    if image.shape[2] == 3:
        return as_image(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
    alpha = image[..., 3:].astype(np.float32)
    premultiplied = np.concatenate([image[..., :3] * (alpha / 255.0), alpha], axis=-1)
    small = cv2.resize(premultiplied, (width, height), interpolation=cv2.INTER_AREA)
    weight = small[..., 3:] / 255.0
    color = np.where(weight > 0, small[..., :3] / np.maximum(weight, 1e-6), 0.0)
    out = np.concatenate([color, small[..., 3:]], axis=-1)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


def composite(image: Image, background: str) -> Image:
    """Composite RGBA over a ``white`` or ``black`` background to RGB. With ``keep``, or without alpha, the
    image is returned unchanged."""
    if background == "keep" or image.shape[2] == 3:
        return image
    alpha: NDArray[np.float32] = image[..., 3:].astype(np.float32) / 255.0
    under = 255.0 if background == "white" else 0.0
    out = image[..., :3] * alpha + under * (1.0 - alpha)
    return np.rint(out).astype(np.uint8)


def shrink(camera: Pinhole, scale: float) -> Pinhole:
    """Intrinsics of images resized by 1 / ``scale``. Raises DatasetError for a scale below 1."""
    if scale < 1:
        raise DatasetError(f"scale is {scale:g}: expected 1 or more (2 halves the images)")
    return camera if scale == 1 else camera.scaled(1.0 / scale)
