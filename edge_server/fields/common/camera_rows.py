"""Cameras as rows of numbers in scene units, as the kernels of Gaussians and of the plane sweep read them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import field_constants as tuned
from edge_server.fields.common.kernels.camera import CAMERA, LENS, LIMITS, NEAR, ORIGIN, SIZE
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.supervision import lens_row
from freshfield.geometry import Pinhole

_BORDER = 17  # points on each edge of an image


@lru_cache(maxsize=1024)
def _limits(camera: Pinhole) -> tuple[float, float, float, float]:
    """LENS_FIELD times the field of view: lowest and highest x / z, then y / z, of rays through the image's edge."""
    u, v = np.linspace(0.0, camera.width, _BORDER), np.linspace(0.0, camera.height, _BORDER)
    edge = np.concatenate(
        [np.stack(np.broadcast_arrays(u, y), axis=-1) for y in (0.0, float(camera.height))]
        + [np.stack(np.broadcast_arrays(x, v), axis=-1) for x in (0.0, float(camera.width))]
    )
    rays = camera.rays(edge)
    ratios = rays[:, :2] / np.maximum(rays[:, 2:], 1e-3)
    low, high = ratios.min(axis=0), ratios.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * tuned.LENS_FIELD * (high - low)
    (x0, y0), (x1, y1) = middle - half, middle + half
    return float(x0), float(x1), float(y0), float(y1)


@lru_cache(maxsize=8)
def ray_lengths(camera: Pinhole) -> NDArray[np.float32]:
    """float32 (H, W): length of each pixel's ray per unit of depth along the optical axis (z)."""
    return (1.0 / np.maximum(camera.rays()[..., 2], 1e-6)).astype(np.float32)


def camera_rows(poses: Sequence[NDArray[np.float64]], lenses: Sequence[Pinhole], box: SceneBox) -> NDArray[np.float32]:
    """Cameras in scene units as the kernels read them, float32 (B, CAMERA).

    poses, lenses: camera-to-world (4, 4) in meters, and intrinsics, of each camera.
    """
    rows = np.zeros((len(poses), CAMERA), np.float32)
    for row, pose, lens in zip(rows, poses, lenses):
        pose = np.asarray(pose, dtype=np.float64)
        row[:ORIGIN] = pose[:3, :3].T.ravel()
        row[ORIGIN:LENS] = box.normalise(pose[:3, 3])
        row[LENS:LIMITS] = lens_row(lens)
        row[LIMITS:NEAR] = _limits(lens)
        row[NEAR] = max(tuned.MIN_NEAR, box.near_m / box.radius_m)
        row[SIZE], row[SIZE + 1] = lens.width, lens.height
    return rows
