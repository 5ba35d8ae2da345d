"""Scale and pad images to the fixed input size of a detector, as YOLO does."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.embed import EmbeddingError

GRAY = 114  # YOLO's padding


def letterbox(image: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """``image`` (H, W, 3) scaled to fit and centered on gray: (height, width, 3). Each side has at least one
    pixel at any aspect ratio."""
    h, w = image.shape[:2]
    if (h, w) == (height, width):
        return image
    scale, size, (left, top) = placed(h, w, height, width)
    # YOLO interpolates linearly both ways; averaging keeps a shrunk image from flickering with aliasing.
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    fitted = cv2.resize(image, size, interpolation=how)
    if size == (width, height):
        return np.asarray(fitted, dtype=np.uint8)
    out = np.full((height, width, 3), GRAY, dtype=np.uint8)
    out[top : top + size[1], left : left + size[0]] = fitted
    return out


def placed(h: int, w: int, height: int, width: int) -> tuple[float, tuple[int, int], tuple[int, int]]:
    """Scale of an image (h, w) within (height, width), its size (width first) and left upper corner there."""
    scale = min(height / h, width / w)
    size = max(1, round(w * scale)), max(1, round(h * scale))
    return scale, size, ((width - size[0]) // 2, (height - size[1]) // 2)


def checked(image: NDArray, number: int) -> NDArray[np.uint8]:
    """``image`` as uint8 (H, W, 3), straight alpha composited over gray. Raises EmbeddingError."""
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] not in (3, 4) or 0 in array.shape:
        raise EmbeddingError(f"image {number}: expected uint8 (height, width, 3 or 4), got {array.dtype} {array.shape}")
    if array.shape[2] == 3:
        return array
    alpha = array[..., 3:].astype(np.float32) / 255.0
    return np.rint(array[..., :3] * alpha + GRAY * (1.0 - alpha)).astype(np.uint8)


def blob(
    images: Sequence[NDArray[np.uint8]], height: int, width: int, dtype: type[np.floating] = np.float32
) -> NDArray[np.floating]:
    """Checked images as the detector's input (n, 3, height, width) in [0, 1]."""
    fitted = [letterbox(image, height, width) for image in images]
    return np.asarray(cv2.dnn.blobFromImages(fitted, 1.0 / 255.0)).astype(dtype, copy=False)
