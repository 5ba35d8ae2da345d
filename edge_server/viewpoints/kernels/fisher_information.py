"""The diagonal of the Fisher information that a view has about the Gaussians it shows.

With noise of variance 1 on every color of every pixel, the information about a parameter is the sum, over
pixels and colors, of the squared derivative of the color by the parameter. A Gaussian's position, scale,
rotation and opacity change a pixel's color only by its power, -1/2 (a dx^2 + 2 b dx dy + c dy^2) + log alpha,
so that derivative is h (m . phi): h is the derivative by the power, phi = (1, dx, dy, dx^2, dx dy, dy^2) of
the pixel, and m has the Gaussian's six factors of these. The sum of squares is therefore m^T S m, where S
holds the sums of h^2 dx^p dy^q up to p + q = 4: fifteen numbers a Gaussian, exact, in one pass over the
pixels. ``project_backward`` gives m. The colors' own derivatives are the weights.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.camera import SIZE, load_camera
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import fetch_add, is_finite
from edge_server.fields.splat.kernels.composite import ALPHA_MAX, SAVED, STRIP, STRIPS, bin_strips, composite
from edge_server.fields.splat.kernels.project import BLOCK, COLOR, MEAN_X, MEAN_Y, RED, TILE
from edge_server.fields.splat.kernels.project_backward import (
    GRADIENT,
    SEEN,
    SUM,
    block_scratch,
    gather_sums,
    load_block,
    project_backward,
)
from edge_server.fields.splat.kernels.rasterize import clear_tile, strip_scratch

# Sums a Gaussian: of h^2 dx^p dy^q in the order 1, x, y, xx, xy, yy, xxx, xxy, xyy, yyy, xxxx, ..., yyyy;
# then of the squared weights.
MOMENTS, WEIGHTS = 16, 15
_PHI = 6
# Number of the moment that is the product of two parts of phi.
_PRODUCT = (
    (0, 1, 2, 3, 4, 5),
    (1, 3, 4, 6, 7, 8),
    (2, 4, 5, 7, 8, 9),
    (3, 6, 7, 10, 11, 12),
    (4, 7, 8, 11, 12, 13),
    (5, 8, 9, 12, 13, 14),
)

_F0, _F1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@device_function
def _add_moments(store, count, pairs, owner, projected, x0, y0, width, height, behind, square, sums):
    """Add a strip's moments to those of its Gaussians, back to front.

    store: what ``composite`` saved of its first ``count`` pairs. x0, y0: the strip's first pixel.
    behind: float32 (3, STRIP), the color that comes from behind; read and written.
    square: float32 (STRIP,), scratch. sums: float64 (N, MOMENTS), added to.
    """
    for n in range(count - 1, -1, -1):
        at, i = n * SAVED, owner[pairs[n]]
        row = projected[i]
        reaches, weights = _F0, _F0
        for k in range(STRIP):
            inside = (x0 + k % TILE < width) & (y0 + k // TILE < height)
            a = store[at + k] if inside else _F0
            light = store[at + STRIP + k]
            weight, free = a * light, a / (_F1 - a)
            total = _F0
            for c in range(3):
                h = weight * row[RED + c] - free * behind[c, k]
                total += h * h
                behind[c, k] += weight * row[RED + c]
            square[k] = total if a < np.float32(ALPHA_MAX) else _F0
            reaches += a
            weights += weight * weight
        if reaches == _F0:
            continue
        into = sums[i]
        left = np.float32(x0) + _HALF - row[MEAN_X]
        for r in range(STRIP // TILE):
            m0 = m1 = m2 = m3 = m4 = _F0
            for k in range(TILE):
                dx, h2 = left + np.float32(k), square[r * TILE + k]
                dx2 = dx * dx
                m0, m1, m2 = m0 + h2, m1 + h2 * dx, m2 + h2 * dx2
                m3, m4 = m3 + h2 * dx2 * dx, m4 + h2 * dx2 * dx2
            dy = np.float32(y0 + r) + _HALF - row[MEAN_Y]
            dy2 = dy * dy
            into[0] += m0
            into[1] += m1
            into[2] += m0 * dy
            into[3] += m2
            into[4] += m1 * dy
            into[5] += m0 * dy2
            into[6] += m3
            into[7] += m2 * dy
            into[8] += m1 * dy2
            into[9] += m0 * dy2 * dy
            into[10] += m4
            into[11] += m3 * dy
            into[12] += m2 * dy2
            into[13] += m1 * dy2 * dy
            into[14] += m0 * dy2 * dy2
        into[WEIGHTS] += weights


@device_function
def _fold(cam, b, base, here, gaussians, ids, projected, lists, pair_sums, sums, s, by_phi, information):
    """Write the information about a block's parameters, information[b, base : base + here], from its moments.
    by_phi: float32 (_PHI, COLOR, BLOCK), scratch."""
    load_block(gaussians, ids, here, s)
    seen = gather_sums(b, ids, here, projected, lists.own_first, lists.own_count, pair_sums, s)
    for j in range(here):
        for k in range(information.shape[2]):
            information[b, base + j, k] = _F0
    if seen == 0:
        return
    for e in range(_PHI):
        for k in range(_PHI + 3):
            for j in range(BLOCK):
                s[SUM + k * BLOCK + j] = _F1 if k == e else _F0
        for k in range(COLOR * BLOCK):
            s[GRADIENT + k] = _F0
        project_backward(cam, s)
        for k in range(COLOR):
            for j in range(BLOCK):
                by_phi[e, k, j] = s[GRADIENT + k * BLOCK + j]
    for j in range(here):
        if s[SEEN + j] == _F0:
            continue
        m = sums[base + j]
        for k in range(COLOR):
            total = 0.0
            for p in range(_PHI):
                left = np.float64(by_phi[p, k, j])
                row = 0.5 * left * m[_PRODUCT[p][p]]
                for q in range(p):
                    row += np.float64(by_phi[q, k, j]) * m[_PRODUCT[p][q]]
                total += 2.0 * left * row
            value = np.float32(max(total, 0.0))  # a sum of squares, but for rounding
            information[b, base + j, k] = value if is_finite(value) else _F0
        for k in range(COLOR, COLOR + 3):
            information[b, base + j, k] = np.float32(m[WEIGHTS])


@kernel
def fisher_information(
    counter,
    worker,
    cams,
    gaussians,
    columns,
    rows,
    projected,
    lists,
    pair_sums,
    background,
    memory,
    saved,
    moments,
    information,
):
    """Write the information that each camera's picture has about each Gaussian. Tasks are cameras.

    cams: float32 (B, CAMERA), the cameras of ``projected`` and ``lists``.
    gaussians: ``Gaussians`` without view dependence.
    pair_sums, memory, saved: see ``RasterBuffers``; pair_sums is read but not used.
    background: float32 (3,).
    moments: float64 (W, N, MOMENTS), scratch of each worker.
    information: float32 (B, N, P), written.
    """
    s, store, sums = memory[worker], saved[worker], moments[worker]
    strip_pairs, count = strip_scratch(lists)
    behind, square = np.empty((3, STRIP), np.float32), np.empty(STRIP, np.float32)
    block, by_phi = block_scratch(gaussians.params.shape[1]), np.empty((_PHI, COLOR, BLOCK), np.float32)
    ids, total = np.empty(BLOCK, np.int64), gaussians.params.shape[0]
    while True:
        b = fetch_add(counter, 1)
        if b >= cams.shape[0]:
            return
        cam = load_camera(cams, b)
        width, height = np.int64(cam[SIZE]), np.int64(cam[SIZE + 1])
        for i in range(total):
            for k in range(MOMENTS):
                sums[i, k] = 0.0
        for t in range(columns[b] * rows[b]):
            x0, y0 = TILE * (t % columns[b]), TILE * (t // columns[b])
            clear_tile(s)
            bin_strips(lists, b, lists.first[b, t], lists.first[b, t + 1], projected, y0, strip_pairs, count)
            for n in range(STRIPS):
                done = composite(
                    strip_pairs[n],
                    count[n],
                    lists.owner[b],
                    projected[b],
                    np.float32(x0),
                    np.float32(y0 + 2 * n),
                    s,
                    n * STRIP,
                    store,
                    SAVED,
                )
                for c in range(3):
                    for k in range(STRIP):
                        behind[c, k] = s[n * STRIP + k] * background[c]
                _add_moments(
                    store,
                    done,
                    strip_pairs[n],
                    lists.owner[b],
                    projected[b],
                    x0,
                    y0 + 2 * n,
                    width,
                    height,
                    behind,
                    square,
                    sums,
                )
        for base in range(0, total, BLOCK):
            here = min(BLOCK, total - base)
            for j in range(here):
                ids[j] = base + j
            _fold(cam, b, base, here, gaussians, ids, projected, lists, pair_sums, sums, block, by_phi, information)
