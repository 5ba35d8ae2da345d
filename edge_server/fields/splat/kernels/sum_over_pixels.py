"""Sums of what pixels say over the Gaussians that they show: as gradients are summed, of numbers that are given."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.splat.kernels.composite import PIXELS, SAVED, STRIPS
from edge_server.fields.splat.kernels.project import TILE
from edge_server.fields.splat.kernels.rasterize import (
    begin_tile,
    composite_strips,
    composite_strips_backward,
    strip_scratch,
)


@kernel
def sum_over_pixels(counter, worker, raster, values, sums):
    """Sum the pixels' values over each pair, with the Gaussian's weight in the pixel. Tasks are tiles.

    values: float32 (H, W, 3).
    sums: float32 (B, P, SUMS), of which the last three columns receive the sums, for every pair of slot 0.
    """
    s, store = raster.memory[worker], raster.saved[worker]
    (strip_pairs, count), composited = strip_scratch(raster.lists), np.empty(STRIPS, np.int64)
    slopes = np.zeros(4 * PIXELS, np.float32)
    while True:
        t = fetch_add(counter, 1)
        if t >= raster.columns * raster.rows:
            return
        x0, y0, begin, end = begin_tile(raster, t, s, strip_pairs, count)
        size = (end - begin) * SAVED
        composite_strips(raster, strip_pairs, count, x0, y0, s, store, size, SAVED, composited)
        for k in range(PIXELS):
            x, y = x0 + k % TILE, y0 + k // TILE
            inside = x < values.shape[1] and y < values.shape[0]
            for c in range(3):
                slopes[c * PIXELS + k] = values[y, x, c] if inside else np.float32(0.0)
        composite_strips_backward(raster, begin, end, strip_pairs, composited, x0, y0, slopes, 0, store, size, sums)
