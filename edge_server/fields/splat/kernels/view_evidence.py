"""The views' evidence on each Gaussian: how many see it, see a change there, and contradict its color."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import LENS, NEAR, load_camera
from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.splat.kernels.project import BLOCK, COLOR, camera_point, lens_terms

MAX_ERROR = 0.5  # bound of a view's color error: the Gaussian may be hidden there
_TRANSPARENT = 128  # of 255: a pixel of less alpha shows nothing

_F0, _F1 = np.float32(0.0), np.float32(1.0)
_BYTE = np.float32(1.0 / 255.0)


class Evidence(NamedTuple):
    """Counts of views for each of N Gaussians.

    seen: int32 (N,), views in whose image it lies, at a pixel of positive weight.
    changed: int32 (N,), those of them whose pixel changed.
    contradicted: int32 (N,), those of the changed ones whose pixel differs from its color.
    error: float32 (N,), mean color error over the views that see it.
    """

    seen: NDArray[np.int32]
    changed: NDArray[np.int32]
    contradicted: NDArray[np.int32]
    error: NDArray[np.float32]

    @classmethod
    def zeros(cls, count: int) -> Evidence:
        return cls(*(np.zeros(count, np.int32) for _ in range(3)), np.zeros(count, np.float32))


@kernel
def collect_evidence(counter, worker, cams, views, marks, gaussians, allowed, evidence):
    """Fill ``evidence``. Tasks are blocks of Gaussians.

    cams: float32 (V, CAMERA).
    views: ``rays.Views`` of these cameras.
    marks: uint8 (pixels,), 1 where something changed.
    allowed: float32 (N,), color error of the worst channel, in [0, 1], above which a view contradicts.
    """
    params, count = gaussians.params, gaussians.params.shape[0]
    while True:
        base = fetch_add(counter, 1) * BLOCK
        if base >= count:
            return
        for i in range(base, min(base + BLOCK, count)):
            seen, changed, contradicted, total = 0, 0, 0, _F0
            for v in range(cams.shape[0]):
                cam = load_camera(cams, v)
                x, y, z = camera_point(cam, params, gaussians.velocity, i)
                if not z > cam[NEAR]:
                    continue
                _, _, _, _, a, b, _, _, _, _, _, _, _, _ = lens_terms(cam, x, y, z)
                px = cam[LENS] * a + cam[LENS + 2]
                py = cam[LENS + 1] * b + cam[LENS + 3]
                width, height = views.size[v, 0], views.size[v, 1]
                if not (px >= _F0 and py >= _F0 and px < width and py < height):
                    continue
                pixel = views.first[v] + np.int64(py) * width + np.int64(px)
                if views.weight.size > 0 and not views.weight[pixel] > _F0:
                    continue
                seen += 1
                error = _F0
                for c in range(3):
                    error = max(error, abs(np.float32(views.pixels[pixel, c]) * _BYTE - params[i, COLOR + c]))
                total += min(error, np.float32(MAX_ERROR))
                if marks[pixel]:
                    changed += 1
                    empty = views.pixels.shape[1] == 4 and views.pixels[pixel, 3] < _TRANSPARENT
                    contradicted += 1 if error > allowed[i] or empty else 0
            evidence.seen[i], evidence.changed[i], evidence.contradicted[i] = seen, changed, contradicted
            evidence.error[i] = total / np.float32(max(seen, 1))
