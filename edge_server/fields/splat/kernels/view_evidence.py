"""What the pictures say of Gaussians: who sees one, who sees change there, who disagrees with it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.splat.kernels.project import (
    BLOCK,
    COLOR,
    LENS,
    NEAR,
    camera_point,
    load_camera,
    projection_terms,
)

MAX_ERROR = 0.5  # no pixel counts more against a colour: it may be hidden there
_CUT_AWAY = 128  # of 255: less alpha shows nothing

_F0, _F1 = np.float32(0.0), np.float32(1.0)
_BYTE = np.float32(1.0 / 255.0)


class Evidence(NamedTuple):
    """Of N Gaussians: sees: views in whose picture it lies, at a pixel of more weight than 0; marked: those
    that see change there; wrong: of these, those whose pixel its colour does not agree with; all int32 (N,).
    off: float32 (N,), the mean over the views that see it of its colour's distance from the pixel."""

    sees: NDArray[np.int32]
    marked: NDArray[np.int32]
    wrong: NDArray[np.int32]
    off: NDArray[np.float32]

    @classmethod
    def zeros(cls, count: int) -> Evidence:
        """For so many Gaussians."""
        return cls(*(np.zeros(count, np.int32) for _ in range(3)), np.zeros(count, np.float32))


@kernel
def collect_evidence(counter, worker, cams, views, marks, gaussians, allowed, verdicts):
    """Tasks are blocks of Gaussians. views: ``rays.Views`` of the cameras; marks: uint8 (pixels,), 1 where
    something changed. allowed: float32 (N,), how far a colour may be off in its worst channel, in [0, 1]."""
    params, count = gaussians.params, gaussians.params.shape[0]
    while True:
        base = fetch_add(counter, 1) * BLOCK
        if base >= count:
            return
        for i in range(base, min(base + BLOCK, count)):
            sees, marked, wrong, total = 0, 0, 0, _F0
            for v in range(cams.shape[0]):
                cam = load_camera(cams, v)
                x, y, z = camera_point(cam, params, gaussians.velocity, i)
                if not z > cam[NEAR]:
                    continue
                _, _, _, _, a, b, _, _, _, _, _, _, _, _ = projection_terms(cam, x, y, z)
                px = cam[LENS] * a + cam[LENS + 2]
                py = cam[LENS + 1] * b + cam[LENS + 3]
                width, height = views.size[v, 0], views.size[v, 1]
                if not (px >= _F0 and py >= _F0 and px < width and py < height):
                    continue
                pixel = views.first[v] + np.int64(py) * width + np.int64(px)
                if views.weight.size > 0 and not views.weight[pixel] > _F0:
                    continue
                sees += 1
                off = _F0
                for c in range(3):
                    off = max(off, abs(np.float32(views.pixels[pixel, c]) * _BYTE - params[i, COLOR + c]))
                total += min(off, np.float32(MAX_ERROR))
                if marks[pixel]:
                    marked += 1
                    nothing = views.pixels.shape[1] == 4 and views.pixels[pixel, 3] < _CUT_AWAY
                    wrong += 1 if off > allowed[i] or nothing else 0
            verdicts.sees[i], verdicts.marked[i], verdicts.wrong[i] = sees, marked, wrong
            verdicts.off[i] = total / np.float32(max(sees, 1))
