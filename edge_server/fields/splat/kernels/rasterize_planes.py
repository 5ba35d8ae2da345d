"""Gaussians as small planes: maps of normal and distance, and the mean normal that each Gaussian shows.

After PGSR (Chen et al. 2024): a pixel's depth is where its ray meets the blended plane, not the blend of the
Gaussians' centers, which lies behind or before the surface wherever a flat Gaussian is seen at an angle.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.splat.kernels.composite import PIXELS, STOP, STRIP, STRIPS, composite
from edge_server.fields.splat.kernels.project import TILE
from edge_server.fields.splat.kernels.rasterize import _T, begin_tile, strip_scratch

CHECK_EVERY = 8  # Gaussians composited between two tests whether any light is left
_F0 = np.float32(0.0)


@device_function
def composite_next(raster, s, strip_pairs, n, j, x0, y0, store):
    """Composite the j-th Gaussian of strip n alone; ``store`` then has its alphas and the light before it.
    Returns False, and composites nothing, if no light was left at the last test."""
    first = _T + n * STRIP
    if j % CHECK_EVERY == 0:
        most = _F0
        for k in range(first, first + STRIP):
            most = max(most, s[k])
        if most < np.float32(STOP):
            return False
    composite(
        strip_pairs[n, j : j + 1],
        1,
        raster.lists.owner[0],
        raster.projected[0],
        np.float32(x0),
        np.float32(y0 + 2 * n),
        s,
        first,
        store,
        0,
    )
    return True


@kernel
def render_planes(counter, worker, raster, planes, out):
    """Blend the Gaussians' planes with the weights of their colors. Tasks are tiles.

    planes: float32 (N, 4), unit normal in camera axes, and the plane's distance from the camera along it.
    out: float32 (H, W, 5), written: blended normal, blended distance, opacity.
    """
    s, store, lists = raster.memory[worker], raster.saved[worker], raster.lists
    strip_pairs, count = strip_scratch(lists)
    sums = np.empty((4, PIXELS), np.float32)
    while True:
        t = fetch_add(counter, 1)
        if t >= raster.columns * raster.rows:
            return
        x0, y0, _, _ = begin_tile(raster, t, s, strip_pairs, count)
        sums[:] = _F0
        for n in range(STRIPS):
            for j in range(count[n]):
                if not composite_next(raster, s, strip_pairs, n, j, x0, y0, store):
                    break
                for c in range(4):
                    value = planes[lists.owner[0, strip_pairs[n, j]], c]
                    for k in range(STRIP):
                        sums[c, n * STRIP + k] += store[k] * store[STRIP + k] * value
        for k in range(PIXELS):
            x, y = x0 + k % TILE, y0 + k // TILE
            if x < out.shape[1] and y < out.shape[0]:
                for c in range(4):
                    out[y, x, c] = sums[c, k]
                out[y, x, 4] = np.float32(1.0) - s[_T + k]


@kernel
def accumulate_normals(counter, worker, raster, normals, normal_sums):
    """Sum the pixels' normals over each pair, with the Gaussian's weight in the pixel. Tasks are tiles.

    normals: float32 (H, W, 4), unit vectors in camera axes, and the confidence in each.
    normal_sums: float32 (P, 4), written for every pair of slot 0: weighted normals, and the weights' sum.
    """
    s, store, lists = raster.memory[worker], raster.saved[worker], raster.lists
    strip_pairs, count = strip_scratch(lists)
    while True:
        t = fetch_add(counter, 1)
        if t >= raster.columns * raster.rows:
            return
        x0, y0, begin, end = begin_tile(raster, t, s, strip_pairs, count)
        for j in range(begin, end):
            normal_sums[lists.pair[0, j]] = _F0
        for n in range(STRIPS):
            for j in range(count[n]):
                if not composite_next(raster, s, strip_pairs, n, j, x0, y0, store):
                    break
                nx = ny = nz = total = _F0
                for k in range(STRIP):
                    x, y = x0 + k % TILE, y0 + 2 * n + k // TILE
                    if x < normals.shape[1] and y < normals.shape[0]:
                        w = store[k] * store[STRIP + k] * normals[y, x, 3]
                        nx += w * normals[y, x, 0]
                        ny += w * normals[y, x, 1]
                        nz += w * normals[y, x, 2]
                        total += w
                pair = normal_sums[strip_pairs[n, j]]
                pair[0] += nx
                pair[1] += ny
                pair[2] += nz
                pair[3] += total
