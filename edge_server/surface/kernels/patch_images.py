"""The images and planes of PatchMatch as its kernels read them, and the projection between images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function
from edge_server.surface.kernels.lens import distort


class Images(NamedTuple):
    """N images with P pixels together.

    lens: float64 (N, 8), fx fy cx cy k1 k2 p1 p2.
    rotation, origin: float64 (N, 3, 3), camera-to-world, and (N, 3), meters.
    first: int64 (N + 1,), each image's first pixel. size: int64 (N, 2), width and height.
    gray, depth: float32 (P,), row by row: gray levels, and meters along the ray (0: unknown).
    """

    lens: NDArray[np.float64]
    rotation: NDArray[np.float64]
    origin: NDArray[np.float64]
    first: NDArray[np.int64]
    size: NDArray[np.int64]
    gray: NDArray[np.float32]
    depth: NDArray[np.float32]


class View(NamedTuple):
    """The image whose planes are sought.

    index: its number in ``Images``. rays: float64 (H, W, 3), world, unit. gray: float32 (H, W).
    chosen: int16 (H, W, SOURCES), images to compare each pixel with, best first; -1: none.
    """

    index: int
    rays: NDArray[np.float64]
    gray: NDArray[np.float32]
    chosen: NDArray[np.int16]


class Planes(NamedTuple):
    """A plane per pixel. depth: float32 (H, W), meters along the ray; 0: none. normal: float32 (H, W, 3),
    unit, world, towards the camera. cost: float32 (H, W)."""

    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    cost: NDArray[np.float32]


class Search(NamedTuple):
    """What one pass over every map tries.

    choose: whether the images to compare with are chosen anew, from the current planes.
    wide: number of planes with random normal. reach: how far their depth is from ``guess``, as a share of it.
    share, turn: largest random changes of depth (as a share of it) and of the normal.
    geometric: weight of the distance, pixels, to where the other image's depth leads back to.
    """

    choose: bool
    wide: int
    reach: float
    share: float
    turn: float
    geometric: float


@device_function
def project(images, s, x, y, z):
    """Project a world point to image s; -1e9 if behind the camera or far outside."""
    x, y, z = x - images.origin[s, 0], y - images.origin[s, 1], z - images.origin[s, 2]
    r, lens = images.rotation, images.lens
    deep = r[s, 0, 2] * x + r[s, 1, 2] * y + r[s, 2, 2] * z
    if not deep > 1e-6:
        return -1e9, -1e9
    a = (r[s, 0, 0] * x + r[s, 1, 0] * y + r[s, 2, 0] * z) / deep
    b = (r[s, 0, 1] * x + r[s, 1, 1] * y + r[s, 2, 1] * z) / deep
    u, v = distort(a, b, lens[s, 4], lens[s, 5], lens[s, 6], lens[s, 7])
    if u != u:  # far outside the lens
        return -1e9, -1e9
    return lens[s, 0] * u + lens[s, 2], lens[s, 1] * v + lens[s, 3]


@device_function
def within(images, s, u, v, margin):
    """Whether (u, v) lies in image s, ``margin`` pixels from its border or more."""
    return u >= margin and v >= margin and u < images.size[s, 0] - margin and v < images.size[s, 1] - margin


@device_function
def depth_shown(images, s, u, v):
    """Depth of image s at the pixel of (u, v)."""
    return np.float64(images.depth[images.first[s] + np.int64(v) * images.size[s, 0] + np.int64(u)])


@device_function
def offset_to(images, s, x, y, z):
    """Direction (not unit) from camera s to a point, and distance."""
    x, y, z = x - images.origin[s, 0], y - images.origin[s, 1], z - images.origin[s, 2]
    return x, y, z, np.sqrt(x * x + y * y + z * z)
