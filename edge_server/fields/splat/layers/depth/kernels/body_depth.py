"""Measured depth of what moves in one frame, and which Gaussians a frame's depth sees through.

Depth is along the optical axis, 0 where nothing was measured. A stereo sensor's noise is even in inverse depth, so
medians and means are taken of that.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.camera import LENS, NEAR, ORIGIN, lens_terms, load_camera, rotate_to_camera
from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.kernels.depth_plate import insert_sorted, pixel_median

_WINDOW = (2 * tuned.BODY_RADIUS_PX + 1) ** 2
_NEAREST_M, _FARTHEST_M = np.float32(1e-3), np.float32(1e6)  # no sensor measures beyond these: what does is none
_F0, _F1 = np.float32(0.0), np.float32(1.0)


@kernel
def measure_body(depth, foreground, image, plate, samples, count, inverse, body):
    """Depth of the foreground's pixels that measured something in front of the plate, smoothed.

    depth: float32 (H, W), meters. foreground: bool (H, W). image: uint8 (H, W, 3).
    plate: float32 (H, W, 3), of 255. samples, count: of its depth, see ``depth_plate.remember_depths``.
    inverse: float32 (H, W), written: 1 / depth of the pixels used, 0 elsewhere.
    body: float32 (H, W), written: meters, 0 where nothing that moves was measured.
    """
    height, width = depth.shape
    ranked = np.empty(samples.shape[2], np.float32)
    for y in range(height):
        for x in range(width):
            inverse[y, x] = body[y, x] = _F0
            d = depth[y, x]
            if not (foreground[y, x] and d > _NEAREST_M and d < _FARTHEST_M):  # NaN is neither
                continue
            still = pixel_median(samples, count, y, x, ranked)
            if still <= _F0 and count[y, x] >= tuned.LEAST:  # of two surfaces: nothing is nearer for sure
                continue
            still = _F1 / still if still > _F0 else _F0
            margin = max(np.float32(tuned.BODY_NEARER_M), np.float32(tuned.BODY_NEARER) * still)
            off = _F0
            for c in range(3):
                off = max(off, abs(np.float32(image[y, x, c]) - plate[y, x, c]))
            if off > np.float32(tuned.BODY_OFF_PLATE) and (still <= _F0 or d < still - margin):
                inverse[y, x] = _F1 / d
    near = np.empty(_WINDOW, np.float32)
    for y in range(height):
        for x in range(width):
            if inverse[y, x] <= _F0:
                continue
            many = 0
            for j in range(max(y - tuned.BODY_RADIUS_PX, 0), min(y + tuned.BODY_RADIUS_PX + 1, height)):
                for i in range(max(x - tuned.BODY_RADIUS_PX, 0), min(x + tuned.BODY_RADIUS_PX + 1, width)):
                    if inverse[j, i] > _F0:
                        insert_sorted(near, many, inverse[j, i])
                        many += 1
            median = near[many // 2]
            if many < tuned.BODY_LEAST or abs(inverse[y, x] - median) >= np.float32(tuned.BODY_FLYING):
                continue
            total, used = _F0, _F0
            for k in range(many):
                if abs(near[k] - inverse[y, x]) < np.float32(tuned.BODY_FLYING):
                    total += near[k]
                    used += _F1
            body[y, x] = used / total


@kernel
def count_seen_through(cams, points, depth, scale, through):
    """Count a frame for the points behind which it measured.

    cams: float32 (1, CAMERA). points: float32 (N, 3), scene units. depth: float32 (H, W), meters.
    scale: scene units a meter of ``depth``.
    through: int32 (N,), increased by 1 where the 3 x 3 pixels about a point measured, and all of them measured
        something behind it.
    """
    cam = load_camera(cams, 0)
    height, width = depth.shape
    margin, share = np.float32(tuned.BODY_THROUGH_M), np.float32(1.0 + tuned.BODY_THROUGH)
    for i in range(points.shape[0]):
        x, y, z = rotate_to_camera(
            cam, points[i, 0] - cam[ORIGIN], points[i, 1] - cam[ORIGIN + 1], points[i, 2] - cam[ORIGIN + 2]
        )
        if not z > cam[NEAR]:
            continue
        _, _, _, _, u, v, _, _, _, _, _, _, _, _ = lens_terms(cam, x, y, z)
        px, py = cam[LENS] * u + cam[LENS + 2], cam[LENS + 1] * v + cam[LENS + 3]
        if not (px >= _F1 and py >= _F1 and px < width - 1 and py < height - 1):
            continue
        bound, measured, behind = share * z / scale + margin, False, True
        for k in range(9):
            d = depth[np.int64(py) + k // 3 - 1, np.int64(px) + k % 3 - 1]
            if d > _NEAREST_M and d < _FARTHEST_M:
                measured = True
                behind &= d >= bound
        through[i] += np.int32(measured and behind)
