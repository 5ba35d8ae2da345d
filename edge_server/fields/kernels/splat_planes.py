"""Gaussians as small planes: normal and distance maps, and what each Gaussian is told of the normals it
shows.

After PGSR (Chen et al. 2024): a pixel's depth is where its ray meets the blended plane, not the blend of the
Gaussians' middles, which lies behind or before the surface wherever a flat Gaussian is seen at an angle.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.kernels.intrinsics import fetch_add
from edge_server.fields.kernels.jit import kernel
from edge_server.fields.kernels.splat_project import TILE
from edge_server.fields.kernels.splat_raster import _T, PIXELS, _begin, blend

_F0 = np.float32(0.0)


@kernel
def render_planes(
    counter, worker, slot, columns, rows, width, height, projected, lists, planes, memory, kept, out
):
    """Blended planes of camera slot ``slot``. planes: float32 (N, 4), each Gaussian's unit normal in camera
    axes and its distance from the camera along it. out: float32 (H, W, 5), written: normal and distance, each
    summed with the weights of the colours, and opacity. Tasks are tiles."""
    s, store = memory[worker], kept[worker]
    sums = np.empty((4, PIXELS), np.float32)
    while True:
        t = fetch_add(counter, 1)
        if t >= columns * rows:
            return
        x0, y0 = TILE * (t % columns), TILE * (t // columns)
        _begin(s, x0, y0)
        sums[:] = _F0
        for j in range(lists.first[slot, t], lists.first[slot, t + 1]):
            i = lists.owner[slot, lists.pair[slot, j]]
            left = blend(s, store, np.int64(0), projected[slot, i])
            for c in range(4):
                value = planes[i, c]
                for k in range(PIXELS):
                    sums[c, k] += store[k] * store[PIXELS + k] * value
            if left == _F0:
                break
        for k in range(PIXELS):
            x, y = x0 + k % TILE, y0 + k // TILE
            if x < width and y < height:
                for c in range(4):
                    out[y, x, c] = sums[c, k]
                out[y, x, 4] = np.float32(1.0) - s[_T + k]


@kernel
def tell_normals(
    counter, worker, slot, columns, rows, width, height, projected, lists, normals, memory, kept, told
):
    """What the pixels' normals (float32 (H, W, 4): unit vectors in camera axes, and how sure each is) say to
    the Gaussians: told, float32 (P, 4), written for every pair of the slot: the normals times the weight that
    the Gaussian has in the pixel, and the sum of these weights. Tasks are tiles."""
    s, store = memory[worker], kept[worker]
    while True:
        t = fetch_add(counter, 1)
        if t >= columns * rows:
            return
        x0, y0 = TILE * (t % columns), TILE * (t // columns)
        _begin(s, x0, y0)
        left = np.float32(1.0)
        for j in range(lists.first[slot, t], lists.first[slot, t + 1]):
            pair = lists.pair[slot, j]
            nx = ny = nz = total = _F0
            if left > _F0:
                left = blend(s, store, np.int64(0), projected[slot, lists.owner[slot, pair]])
                for k in range(PIXELS):
                    x, y = x0 + k % TILE, y0 + k // TILE
                    if x < width and y < height:
                        w = store[k] * store[PIXELS + k] * normals[y, x, 3]
                        nx += w * normals[y, x, 0]
                        ny += w * normals[y, x, 1]
                        nz += w * normals[y, x, 2]
                        total += w
            told[pair, 0], told[pair, 1], told[pair, 2], told[pair, 3] = nx, ny, nz, total
