"""Registers measured depth to the pixels of its image. Imported with the first frame that has depth."""

from __future__ import annotations

import math
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from edge_server.live.live_constants import MAX_DEPTH_POINTS, MAX_DEPTH_RAYS_BYTES, MOST_DEPTH_MOVED
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole, Pose

_Lens = tuple[Pinhole, Pose | None, int]
_kept: dict[_Lens, NDArray[np.float32]] = {}  # rays of lenses, least recently used first
_keeping = Lock()


def depth_in_image(depth: DepthImage, lens: Pinhole, halvings: int) -> NDArray[np.float32]:
    """Depth along the image's optical axis in meters, float32 (H, W), 0 where nothing was measured.

    lens: of the image before it was halved, ``halvings`` times, to H x W.

    Each pixel takes the measurement nearest to its center: a mean over pixels would lie between two surfaces. Depth
    with its own lens is first reprojected into the image, at the coarser of both resolutions, so that no gaps open
    between its pixels; the nearest surface wins. Of depth with more than ``MAX_DEPTH_POINTS`` pixels per image pixel,
    or ``MOST_DEPTH_MOVED`` in all, only every n-th row and column is reprojected.
    """
    image = lens.halved(halvings)
    if depth.intrinsics is None:
        height, width = depth.counts.shape
        return _sampled(depth.meters(), image, 2.0**halvings * width / lens.width, 2.0**halvings * height / lens.height)
    sensor = depth.intrinsics
    step = _step(sensor, image)
    grid = image.scaled(min(1.0, sensor.fx / (step * image.fx), sensor.fy / (step * image.fy)))
    moved = _moved(depth, sensor, grid, step)
    return _sampled(moved, image, grid.width / image.width, grid.height / image.height)


def _sampled(depth: NDArray[np.float32], image: Pinhole, per_column: float, per_row: float) -> NDArray[np.float32]:
    """Depth at the centers of the image's pixels. per_column, per_row: depth pixels per image pixel."""
    if per_column == per_row == 1.0:
        return depth
    rows = np.minimum((np.arange(image.height) + 0.5) * per_row, depth.shape[0] - 1).astype(np.intp)
    columns = np.minimum((np.arange(image.width) + 0.5) * per_column, depth.shape[1] - 1).astype(np.intp)
    return depth[rows[:, None], columns]


def _step(sensor: Pinhole, image: Pinhole) -> int:
    """Stride of the sensor's rows and columns to reproject. A wide sensor's resolution alone would not bound them."""
    most = min(MAX_DEPTH_POINTS * image.width * image.height, MOST_DEPTH_MOVED)
    least = math.ceil(math.sqrt(sensor.width * sensor.height / most))
    return max(least, int(min(sensor.fx / image.fx, sensor.fy / image.fy)))


def _moved(depth: DepthImage, sensor: Pinhole, grid: Pinhole, step: int) -> NDArray[np.float32]:
    """Depth in meters, reprojected into ``grid``, the image's lens at some resolution, from every ``step``-th pixel."""
    z = depth.counts[step // 2 :: step, step // 2 :: step] * np.float32(depth.meters_per_count)
    points = _directions(sensor, depth.to_camera, step) * z[..., None]
    if depth.to_camera is not None:
        points += np.asarray(depth.to_camera.translation_m, np.float32)
    seen = z > 0
    if grid.distorted:  # such a lens may map points far outside its image back into it
        seen &= np.hypot(points[..., 0], points[..., 1]) <= points[..., 2] * _reach(grid)
    column, row = np.moveaxis(np.floor(grid.project(points)), -1, 0)
    seen &= (column >= 0) & (column < grid.width) & (row >= 0) & (row < grid.height)
    out = np.full(grid.height * grid.width, np.inf, np.float32)
    place = (row[seen] * grid.width + column[seen]).astype(np.intp)
    np.minimum.at(out, place, points[..., 2][seen])
    out[np.isinf(out)] = 0.0
    return out.reshape(grid.height, grid.width)


def _directions(sensor: Pinhole, to_camera: Pose | None, step: int) -> NDArray[np.float32]:
    """Every ``step``-th pixel's point at depth 1, rotated into the camera's axes, float32 (H, W, 3).

    Those of the lenses used last are kept, up to ``MAX_DEPTH_RAYS_BYTES`` in all.
    """
    lens = (sensor, to_camera, step)
    with _keeping:
        found = _kept.pop(lens, None)
        if found is None:
            found = _turned_rays(sensor, to_camera, step)
        _kept[lens] = found
        while sum(rays.nbytes for rays in _kept.values()) > MAX_DEPTH_RAYS_BYTES:
            del _kept[next(iter(_kept))]
    return found


def _turned_rays(sensor: Pinhole, to_camera: Pose | None, step: int) -> NDArray[np.float32]:
    """See ``_directions``."""
    u, v = np.meshgrid(np.arange(step // 2, sensor.width, step), np.arange(step // 2, sensor.height, step))
    rays = sensor.rays(np.stack([u, v], -1) + 0.5)
    turned = rays if to_camera is None else rays @ to_camera.matrix()[:3, :3].T
    return (turned / rays[..., 2:]).astype(np.float32)


@lru_cache
def _reach(image: Pinhole) -> float:
    """Tangent of the largest angle between the optical axis and a pixel's corner."""
    u, v = np.meshgrid(np.linspace(0, image.width, 33), np.linspace(0, image.height, 33))
    rays = image.rays(np.stack([u.ravel(), v.ravel()], -1))
    return float((np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]).max())
