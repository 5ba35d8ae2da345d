"""The least squares of motion: sums of views, and conjugate gradients for the free knots.

Unknowns are float32 (T, n) of T knots, n = 3K, ordered by axis, then anchor: the loops run over anchors side
by side. A view at one instant bears on four knots in a row, so that the matrix has a band of four blocks. The
preconditioner is each anchor's own block over all free knots and axes, factorized for all anchors at once:
the prior in time, which makes the system stiff, is exact in it.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.splat.layers.layer_constants import MOST_ITERATIONS, TOLERANCE

BAND = 4  # knots that one view bears on
PAIRS = 10  # pairs i <= j of these knots
MOST = 1e30  # bound of a view's numbers: their sums fit float32
_F0, _F1 = np.float32(0.0), np.float32(1.0)


@kernel
def add_row(matrix, vector, around, weights, blocks, right, used):
    """Add one view to the sums of views between the same two knots.

    matrix, vector, around: see ``motion.ViewRow``. weights: float64 (BAND,), of the knots at its instant.
    blocks: float32 (PAIRS, n, n), normal matrix of each pair of knots. right: float64 (BAND, n).
    used: int64 (1,), 1 is added; nothing is added for a view with numbers that are not finite.
    """
    n, anchors = vector.size, vector.size // 3
    turned, totals, good = np.empty((n, n), np.float32), np.empty(n), True
    for a in range(anchors):
        for d in range(3):
            total = vector[3 * a + d]
            for b in range(anchors):
                for e in range(3):
                    h = matrix[3 * a + d, 3 * b + e]
                    total += h * around[3 * b + e]
                    turned[d * anchors + a, e * anchors + b] = h
                    good &= abs(h) < MOST
            totals[d * anchors + a] = total
            good &= abs(total) < MOST
    if not good:
        return
    used[0] += 1
    for i in range(BAND):
        for p in range(n):
            right[i, p] += weights[i] * totals[p]
    pair = 0
    for i in range(BAND):
        for j in range(i, BAND):
            w = np.float32(weights[i] * weights[j])
            if w != _F0:
                for p in range(n):
                    for q in range(n):
                        blocks[pair, p, q] += w * turned[p, q]
            pair += 1


@kernel
def add_span(base, blocks, right, band, total):
    """Add the sums of a span of time, whose first knot is ``base``, to the band (T, BAND, n, n) of blocks
    (k, k + q), and to the right side ``total``, float64 (T, n)."""
    n, pair = total.shape[1], 0
    for i in range(BAND):
        for p in range(n):
            total[base + i, p] += right[i, p]
        for j in range(i, BAND):
            for p in range(n):
                for q in range(n):
                    band[base + i, j - i, p, q] += blocks[pair, p, q]
            pair += 1


@device_function
def _multiply_band(band, x, y, first):
    """y += band times x; knots before ``first`` are 0 in x and not wanted in y."""
    knots, n = x.shape
    for k in range(first, knots):
        for q in range(min(BAND, knots - k)):
            for i in range(n):
                total, own = x[k, i] * _F0, x[k, i]
                for j in range(n):
                    total += band[k, q, i, j] * x[k + q, j]
                y[k, i] += total
                if q > 0:
                    for j in range(n):
                        y[k + q, j] += band[k, q, i, j] * own


@device_function
def _multiply_prior(x, y, differences, steady, alike, laplacian):
    """y += prior times x, from differences of x: they cancel what is large."""
    knots, n = x.shape
    anchors = laplacian.shape[0]
    for k in range(BAND - 1, knots):
        for i in range(n):
            v = x[k, i] * differences[3] + x[k - 1, i] * differences[2]
            v = (v + x[k - 2, i] * differences[1] + x[k - 3, i] * differences[0]) * steady
            for q in range(BAND):
                y[k - 3 + q, i] += differences[q] * v
    for k in range(1, knots):
        for d in range(3):
            for a in range(anchors):
                step = alike * (x[k, d * anchors + a] - x[k - 1, d * anchors + a])
                for b in range(anchors):
                    v = laplacian[a, b] * step
                    y[k, d * anchors + b] += v
                    y[k - 1, d * anchors + b] -= v


@device_function
def _factorize(band, fixed, differences, steady, alike, laplacian):
    """Cholesky factors (m, m, K) of each anchor's own block, m = 3 free knots; 1 / the diagonal on it."""
    knots, n = band.shape[0], band.shape[2]
    anchors, free = n // 3, knots - fixed
    m = 3 * free
    time, c = np.zeros((knots, knots)), np.zeros((m, m, anchors), np.float32)
    for k in range(BAND - 1, knots):
        for i in range(BAND):
            for j in range(BAND):
                time[k - 3 + i, k - 3 + j] += differences[i] * differences[j] * steady
    for d in range(3):
        for k in range(free):
            for q in range(max(k - BAND + 1, 0), k + 1):
                if q == k:
                    joined = 1.0 if fixed + k == knots - 1 else 2.0
                else:
                    joined = -1.0 if q == k - 1 else 0.0
                for a in range(anchors):
                    prior = time[fixed + k, fixed + q] + joined * alike * laplacian[a, a]
                    c[d * free + k, d * free + q, a] = prior
    for d in range(3):
        for e in range(d + 1):
            for k in range(free):
                for q in range(max(k - BAND + 1, 0), min(k + BAND, free)):
                    if d == e and q > k:
                        continue
                    low, high = min(k, q), max(k, q)
                    for a in range(anchors):
                        i, j = d * anchors + a, e * anchors + a
                        if q > k:
                            i, j = j, i
                        # Block (low, high): its rows are those of the earlier knot.
                        c[d * free + k, e * free + q, a] += band[fixed + low, high - low, j, i]
    for i in range(m):
        for j in range(i):
            for q in range(j):
                for a in range(anchors):
                    c[i, j, a] -= c[i, q, a] * c[j, q, a]
            for a in range(anchors):
                c[i, j, a] *= c[j, j, a]
                c[i, i, a] -= c[i, j, a] * c[i, j, a]
        for a in range(anchors):
            c[i, i, a] = _F1 / np.sqrt(max(c[i, i, a], np.float32(1e-3)))
    return c


@device_function
def _precondition(c, r, z, fixed):
    """z = preconditioner times r, from the factors ``c``."""
    anchors, free = c.shape[2], r.shape[0] - fixed
    m = 3 * free
    for i in range(m):
        d, k = i // free * anchors, fixed + i % free
        for a in range(anchors):
            z[k, d + a] = r[k, d + a]
        for j in range(i):
            e, q = j // free * anchors, fixed + j % free
            for a in range(anchors):
                z[k, d + a] -= c[i, j, a] * z[q, e + a]
        for a in range(anchors):
            z[k, d + a] *= c[i, i, a]
    for u in range(m):
        i = m - 1 - u
        d, k = i // free * anchors, fixed + i % free
        for a in range(anchors):
            z[k, d + a] *= c[i, i, a]
        for j in range(i):
            e, q = j // free * anchors, fixed + j % free
            for a in range(anchors):
                z[q, e + a] -= c[i, j, a] * z[k, d + a]


@device_function
def _dot(a, b):
    total = 0.0
    for k in range(a.shape[0]):
        for i in range(a.shape[1]):
            total += np.float64(a[k, i]) * np.float64(b[k, i])
    return total


@kernel
def solve_knots(band, right, knots, fixed, differences, steady, alike, laplacian, iterations):
    """Improve the knots after the first ``fixed`` until they solve the least squares.

    band: float32 (T, BAND, n, n), blocks (k, k + q) of the views' normal matrix. right: float64 (T, n).
    knots: float64 (T, n), written.
    differences: float64 (BAND,), of the prior in time; steady, alike: its weight, and that of neighbors.
    laplacian: float64 (K, K), of the neighbors' graph. iterations: int64 (1,), written.
    """
    shape, n = knots.shape, knots.shape[1]
    # The residual in float64: what is left for float32 is a small step.
    y = np.zeros(shape)
    _multiply_band(band, knots, y, 0)
    _multiply_prior(knots, y, differences, steady, alike, laplacian)
    r, z, p, step, product = (
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
    )
    for k in range(fixed, shape[0]):
        for i in range(n):
            r[k, i] = right[k, i] - y[k, i]
    coefficients, graph = differences.astype(np.float32), laplacian.astype(np.float32)
    c = _factorize(band, fixed, differences, steady, alike, laplacian)
    old = 0.0
    iterations[0] = MOST_ITERATIONS
    for n_done in range(MOST_ITERATIONS):
        _precondition(c, r, z, fixed)
        new = _dot(r, z)
        if not new > TOLERANCE * TOLERANCE:
            iterations[0] = n_done
            break
        beta = np.float32(new / old) if n_done > 0 else _F0
        old = new
        for k in range(fixed, shape[0]):
            for i in range(n):
                p[k, i] = z[k, i] + beta * p[k, i]
        product[:] = _F0
        _multiply_band(band, p, product, fixed)
        _multiply_prior(p, product, coefficients, np.float32(steady), np.float32(alike), graph)
        along = 0.0
        for k in range(fixed, shape[0]):
            for i in range(n):
                along += np.float64(p[k, i]) * np.float64(product[k, i])
        if not along > 0.0:
            break
        size = np.float32(old / along)
        for k in range(fixed, shape[0]):
            for i in range(n):
                step[k, i] += size * p[k, i]
                r[k, i] -= size * product[k, i]
    good = True
    for k in range(fixed, shape[0]):
        for i in range(n):
            good &= abs(step[k, i]) <= np.float32(1e6)
    if good:
        for k in range(fixed, shape[0]):
            for i in range(n):
                knots[k, i] += step[k, i]
