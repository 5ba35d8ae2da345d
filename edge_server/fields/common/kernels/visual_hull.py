"""Which points a view sees, and which lie in its mask: counted over views, a visual hull."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.camera import (
    LENS,
    LIMITS,
    NEAR,
    ORIGIN,
    lens_terms,
    load_camera,
    rotate_to_camera,
)
from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import fetch_add

_POINTS = 256  # a task
_F0 = np.float32(0.0)


@kernel
def count_points(counter, worker, cams, points, mask, seen, marked):
    """Count a view for the points that it sees, and for those in its mask. Tasks are runs of points.

    cams: float32 (1, CAMERA). points: float32 (N, 3), scene units. mask: uint8 (H, W).
    seen, marked: int32 (N,), increased by 1 where the point is in the image, and in the mask.
    """
    cam = load_camera(cams, 0)
    while True:
        base = fetch_add(counter, 1) * _POINTS
        if base >= points.shape[0]:
            return
        for i in range(base, min(base + _POINTS, points.shape[0])):
            x, y, z = rotate_to_camera(
                cam, points[i, 0] - cam[ORIGIN], points[i, 1] - cam[ORIGIN + 1], points[i, 2] - cam[ORIGIN + 2]
            )
            if not z > cam[NEAR]:
                continue
            # Most are far outside the image, which costs no lens to see.
            if not (cam[LIMITS] * z <= x <= cam[LIMITS + 1] * z and cam[LIMITS + 2] * z <= y <= cam[LIMITS + 3] * z):
                continue
            _, _, _, _, u, v, _, _, _, _, _, _, _, _ = lens_terms(cam, x, y, z)
            px = cam[LENS] * u + cam[LENS + 2]
            py = cam[LENS + 1] * v + cam[LENS + 3]
            if px >= _F0 and py >= _F0 and px < mask.shape[1] and py < mask.shape[0]:
                seen[i] += 1
                marked[i] += np.int32(mask[np.int64(py), np.int64(px)] > 0)
