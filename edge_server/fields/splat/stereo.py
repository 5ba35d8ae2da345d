"""Depth of an image from others, see ``kernels.semi_global``: what plates and scans share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import UNIT_BOX
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.kernels.semi_global import aggregate_paths, choose_depths, match_costs
from freshfield.geometry import Pinhole, se3_inverse

Image = NDArray[np.float32]
Pose = NDArray[np.float64]


def match_depths(
    image: Image,
    pose: Pose,
    lens: Pinhole,
    others: Image,
    cameras: Sequence[tuple[Pose, Pinhole]],
    steps: Image,
    pool: Pool,
) -> Image:
    """Inverse depth of one image, float32 (H, W), 1 / m along the optical axis, 0 where none fits best.

    image: float32 (3, H, W), in [0, 1] or ``semi_global.UNKNOWN``. pose, lens: its camera to world (4, 4), and lens.
    others: float32 (J, 3, P), images to compare it with, row by row. cameras: their poses and lenses.
    steps: float32 (D,), inverse depths to try, 1 / m, evenly spaced from 0.
    """
    here, rays = se3_inverse(pose), lens.rays()
    rows = camera_rows([here @ its for its, _ in cameras], [its for _, its in cameras], UNIT_BOX)
    ray_x, ray_y = (np.ascontiguousarray(rays[..., k] / rays[..., 2], dtype=np.float32) for k in (0, 1))
    cost = np.empty((*ray_x.shape, steps.size), np.uint8)
    pool.run(match_costs, image, others, rows, ray_x, ray_y, steps, cost)
    total = np.empty((2, *cost.shape), np.uint16)
    pool.run(aggregate_paths, cost, np.minimum(image.max(axis=0), 1.0), total)
    found = np.empty(ray_x.shape, np.float32)
    pool.run(choose_depths, total, steps, found)
    return np.where((found > 0.5 * steps[1]) & (image[0] <= 1.0), found, 0.0).astype(np.float32)
