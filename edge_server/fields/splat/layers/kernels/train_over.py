"""A training pass over a plate: the Gaussians are composited over what the camera sees behind them, so that
the errors of the static field do not reach them."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import draw, is_finite
from edge_server.fields.splat.kernels.composite import (
    PIXELS,
    SAVED,
    STRIP,
    STRIPS,
    SUMS,
    bin_strips,
    composite,
    composite_backward,
)
from edge_server.fields.splat.kernels.project import TILE
from edge_server.fields.splat.kernels.rasterize import _BEHIND, _ER, _R, _T, clear_tile, strip_scratch

_F0, _F2 = np.float32(0.0), np.float32(2.0)
_BYTE = np.float32(1.0 / 255.0)


@kernel
def train_over(counter, worker, image, plate, weight, tasks, columns, projected, lists, memory, saved, sums, losses):
    """Render tiles of camera slot 0 over the plate, compare them with the image, and backpropagate to the
    pairs. The loss is the sum over pixels of weight times the squared color error.

    image: uint8 (H, W, 3). plate: float32 (H, W, 3), steps of 255. weight: float32 (H, W).
    tasks: int32 (M, 2), slot (0) and tile. memory, saved: scratch, as in ``rasterize.train_tiles``.
    sums: float32 (B, P, SUMS), written for the pairs of the tasks' tiles.
    losses: float64 (M,), written: the loss of each tile, 0 where it is not finite.
    """
    s, store = memory[worker], saved[worker]
    target, back = np.empty((3, PIXELS), np.float32), np.empty((3, PIXELS), np.float32)
    share = np.empty(PIXELS, np.float32)
    (strip_pairs, count), composited = strip_scratch(lists), np.empty(STRIPS, np.int64)
    height, width = image.shape[0], image.shape[1]
    while True:
        task = draw(counter, worker, tasks.shape[0])
        if task >= tasks.shape[0]:
            return
        t = np.int64(tasks[task, 1])
        begin, end = np.int64(lists.first[0, t]), np.int64(lists.first[0, t + 1])
        losses[task] = 0.0
        if begin == end:
            continue
        x0, y0 = TILE * (t % columns[0]), TILE * (t // columns[0])
        for k in range(PIXELS):
            x, y = x0 + k % TILE, y0 + k // TILE
            inside = x < width and y < height
            share[k] = weight[y, x] if inside else _F0
            for c in range(3):
                target[c, k] = np.float32(image[y, x, c]) * _BYTE if inside else _F0
                back[c, k] = plate[y, x, c] * _BYTE if inside else _F0
        clear_tile(s)
        size = (end - begin) * SAVED
        bin_strips(lists, 0, begin, end, projected, y0, strip_pairs, count)
        for n in range(STRIPS):
            composited[n] = composite(
                strip_pairs[n],
                count[n],
                lists.owner[0],
                projected[0],
                np.float32(x0),
                np.float32(y0 + 2 * n),
                s,
                _T + n * STRIP,
                store[n * size : (n + 1) * size],
                SAVED,
            )
        total = _F0
        for k in range(PIXELS):
            s[_BEHIND + k] = _F0
        for c in range(3):
            for k in range(PIXELS):
                e = s[_R + c * PIXELS + k] + s[_T + k] * back[c, k] - target[c, k]
                slope = _F2 * share[k] * e
                total += share[k] * (e * e)
                s[_ER + c * PIXELS + k] = slope
                s[_BEHIND + k] += s[_T + k] * back[c, k] * slope
        for j in range(begin, end):
            rest = sums[0, lists.pair[0, j]]
            for k in range(SUMS):
                rest[k] = _F0
        if not is_finite(total):
            continue
        losses[task] = total
        for n in range(STRIPS):
            composite_backward(
                strip_pairs[n],
                composited[n],
                lists.owner[0],
                projected[0],
                np.float32(x0),
                np.float32(y0 + 2 * n),
                s,
                _ER + n * STRIP,
                store[n * size : (n + 1) * size],
                sums[0],
            )
