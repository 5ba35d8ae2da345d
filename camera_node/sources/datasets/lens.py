"""Lens models of data sets, and the undistortion of their images.

``Pinhole`` has only OpenCV's k1, k2, p1, p2. Images of a lens that needs more (k3, a fisheye) are undistorted
when they are read: resampled to the widest pinhole camera of the same size in which every pixel lies within
the original image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.sources import source_constants as tuned
from camera_node.sources.datasets.records import DatasetError
from freshfield.geometry import Array, Pinhole, invertible

Pixels = TypeVar("Pixels", NDArray[np.uint8], NDArray[np.uint16])

# Largest side of the image that a lens is described for; smaller copies of it may be read.
_MAX_SIDE_PX = 10**6


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels (corner origin) with a general lens distortion.

    radial: k1, k2, ..., the coefficients of r^2, r^4, ...
    tangential: OpenCV's p1, p2.
    fisheye: equidistant projection, in which r is the angle from the axis; with zero ``tangential`` this is
        OpenCV's and COLMAP's fisheye model.
    Raises DatasetError for sizes, focal lengths or coefficients that are impossible.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False

    def __post_init__(self) -> None:
        sides = (self.width, self.height)
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.radial, *self.tangential)
        if not all(map(math.isfinite, numbers)) or not 1 <= min(sides) <= max(sides) <= _MAX_SIDE_PX:
            raise DatasetError("the camera's numbers are not finite, or it has no pixels or too many")
        if min(self.fx, self.fy) <= 0:
            raise DatasetError(f"the focal lengths are {self.fx:g}, {self.fy:g}: expected positive ones")

    def resized(self, width: int, height: int) -> Lens:
        """The same lens for images of another size."""
        if (width, height) == (self.width, self.height):
            return self
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def project(self, points: NDArray) -> Array:
        """Pixels (..., 2) of points (..., 3) in camera axes, in front of the camera."""
        x, y = self._distort(points[..., 0] / points[..., 2], points[..., 1] / points[..., 2])
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        if self.fisheye:
            r = np.hypot(x, y)
            factor = np.where(r > 1e-9, np.arctan(r) / np.maximum(r, 1e-9), 1.0)
            x, y = x * factor, y * factor
        r2 = x * x + y * y
        factor, power = np.ones_like(r2), r2
        for k in self.radial:
            factor, power = factor + k * power, power * r2
        p1, p2 = self.tangential
        return (
            x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )


def pinhole(lens: Lens) -> Pinhole:
    """The camera of the lens's images after ``undistort``: the lens itself if ``Pinhole`` can express it,
    else an undistorted camera. Raises DatasetError for coefficients that no lens has."""
    return _as_pinhole(lens) or _undistorted(lens)


def exact(lens: Lens) -> bool:
    """Whether ``pinhole(lens)`` is the lens itself, so that ``undistort`` changes nothing."""
    return _as_pinhole(lens) is not None


def undistort(lens: Lens, image: Pixels, nearest: bool = False) -> Pixels:
    """Resample an image (H, W) or (H, W, C) of ``lens`` to the camera ``pinhole(lens)``; unchanged if exact.
    nearest: take the nearest pixel, as for depth, of which no mean may be taken. Raises as ``pinhole``."""
    if exact(lens):
        return image
    between = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    return cast(Pixels, cv2.remap(image, *_maps(lens), between, borderMode=cv2.BORDER_REPLICATE))


@lru_cache(maxsize=256)
def _as_pinhole(lens: Lens) -> Pinhole | None:
    if lens.fisheye or any(lens.radial[2:]):
        return None
    k1, k2 = (*lens.radial, 0.0, 0.0)[:2]
    same = Pinhole(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, (k1, k2, *lens.tangential))
    return same if invertible(same) else None


@lru_cache(maxsize=256)
def _undistorted(lens: Lens) -> Pinhole:
    found: Pinhole | None = None
    for zoom in tuned.ZOOM_FROM * tuned.ZOOM_STEP ** np.arange(tuned.ZOOM_STEPS):
        tried = Pinhole(lens.width, lens.height, zoom * lens.fx, zoom * lens.fy, lens.cx, lens.cy)
        if not _covered(lens, tried):
            break
        found = tried
    if found is None:
        raise DatasetError("the distortion coefficients belong to no lens: not even the middle can be straightened")
    return found


def _covered(lens: Lens, straight: Pinhole) -> bool:
    """Whether every pixel of ``straight`` lies within the lens's image, and none of that is shown twice."""
    count = tuned.BORDER_POINTS
    side = np.linspace(0.0, 1.0, count)
    u = np.concatenate([side, side, np.zeros(count), np.ones(count)]) * straight.width
    v = np.concatenate([np.zeros(count), np.ones(count), side, side]) * straight.height
    x, y = (u - straight.cx) / straight.fx, (v - straight.cy) / straight.fy
    furthest = float(np.hypot(x, y).max())
    if furthest > math.tan(math.radians(tuned.WIDEST_DEG)):
        return False
    along = np.linspace(0.0, furthest, count)
    if np.any(np.diff(replace(lens, tangential=(0.0, 0.0))._distort(along, np.zeros(count))[0]) <= 0):
        return False
    at = lens.project(np.stack([x, y, np.ones_like(x)], axis=-1))
    return bool(np.all((at >= 0.0) & (at <= (lens.width, lens.height))))


# Some 22 MB for a camera of two thousand pixels a side; bounded, because the cameras of a rig take turns.
@lru_cache(maxsize=8)
def _maps(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    straight = _undistorted(lens)
    u, v = np.meshgrid(np.arange(straight.width) + 0.5, np.arange(straight.height) + 0.5)
    x, y = (u - straight.cx) / straight.fx, (v - straight.cy) / straight.fy
    at = lens.project(np.stack([x, y, np.ones_like(x)], axis=-1)) - 0.5  # OpenCV counts pixel centers
    return at[..., 0].astype(np.float32), at[..., 1].astype(np.float32)
