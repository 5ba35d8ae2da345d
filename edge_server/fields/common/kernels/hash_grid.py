"""Multiresolution hash encoding (thesis 3.23; Mueller et al. 2022): features of points and their gradient.

A point is given in the unit cube. Level l is a grid of ``resolution[l]`` cells a side; where its vertices
fit into its table they are stored densely, else hashed. Two features a vertex, interpolated trilinearly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.mlp import backward, forward
from edge_server.fields.common.kernels.radiance_model import implements, query_backward, query_color, query_density
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.common.kernels.simd_vectors import Vector, require_contiguous

FEATURES = 2  # a vertex; one 64-bit load
SEGMENT = 16  # vertices a dirty flag stands for

_PRIME_Y, _PRIME_Z = np.uint32(2654435761), np.uint32(805459861)


class Grid(NamedTuple):
    """The levels of one encoding.

    resolution: int32 (L,), cells a side. first: int64 (L + 1,), first vertex of each level in ``table``;
    a multiple of SEGMENT. dense: bool (L,). table: float32 (vertices, 2).
    """

    resolution: NDArray[np.int32]
    first: NDArray[np.int64]
    dense: NDArray[np.bool_]
    table: NDArray[np.float32]


@device_function
def corner(x, res):
    """Lower vertex (uint32) and fraction of coordinate x in [0, 1] on a grid of res cells."""
    scaled = x * np.float32(res)
    i = min(max(np.int32(scaled), np.int32(0)), np.int32(res - 1))
    return np.uint32(i), scaled - np.float32(i)


@device_function
def _corners(level_dense, res, mask, ix, iy, iz):
    """The eight vertices' places in the level's table, x fastest, as uint32."""
    one = np.uint32(1)
    if level_dense:
        sy = np.uint32(res + 1)
        sz = np.uint32(sy * sy)
        a = np.uint32(ix + np.uint32(iy * sy) + np.uint32(iz * sz))
        b, c = np.uint32(a + sy), np.uint32(a + sz)
        d = np.uint32(b + sz)
        return a, np.uint32(a + one), b, np.uint32(b + one), c, np.uint32(c + one), d, np.uint32(d + one)
    x1 = np.uint32(ix + one)
    y0 = np.uint32(iy * _PRIME_Y)
    y1 = np.uint32(y0 + _PRIME_Y)
    z0 = np.uint32(iz * _PRIME_Z)
    z1 = np.uint32(z0 + _PRIME_Z)
    return (
        np.uint32((ix ^ y0 ^ z0) & mask),
        np.uint32((x1 ^ y0 ^ z0) & mask),
        np.uint32((ix ^ y1 ^ z0) & mask),
        np.uint32((x1 ^ y1 ^ z0) & mask),
        np.uint32((ix ^ y0 ^ z1) & mask),
        np.uint32((x1 ^ y0 ^ z1) & mask),
        np.uint32((ix ^ y1 ^ z1) & mask),
        np.uint32((x1 ^ y1 ^ z1) & mask),
    )


@device_function
def _weights(fx, fy, fz):
    one = np.float32(1.0)
    gx, gy, gz = one - fx, one - fy, one - fz
    a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
    return gx * a, fx * a, gx * b, fx * b, gx * c, fx * c, gx * d, fx * d


@device_function
def _interpolate(table, rows, weights):
    """Weighted sum of eight rows of a table, two float32."""
    a, b = np.float32(0.0), np.float32(0.0)
    for k in range(8):
        a += weights[k] * table[rows[k], 0]
        b += weights[k] * table[rows[k], 1]
    return a, b


@intrinsic
def _add_pair(typingctx: Any, table: Any, row: Any, weight: Any, a: Any, b: Any) -> Any:
    """``table[row] += weight * (a, b)``; table contiguous float32 (N, 2), row uint32, the rest float32.

    One load and one store where LLVM makes two of each: ``scatter`` takes a fifth less, 5 % of a step of `nerfacto`.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        require_contiguous(signature.args[0])
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        wide = ir.IntType(64)
        pointer = builder.gep(data, [builder.mul(builder.zext(args[1], wide), wide(FEATURES))])
        step = Vector.pair(builder, args[3], args[4]) * Vector.broadcast(builder, args[2], 2)
        (Vector.load(builder, pointer, 2) + step).store(pointer)
        return context.get_dummy_value()

    return types.void(table, types.uint32, *[types.float32] * 3), codegen


@device_function
def _encode_level(dense, res, mask, x, y, z, table, out0, out1):
    for s in range(out0.size):
        ix, fx = corner(x[s], res)
        iy, fy = corner(y[s], res)
        iz, fz = corner(z[s], res)
        rows = _corners(dense, res, mask, ix, iy, iz)
        out0[s], out1[s] = _interpolate(table, rows, _weights(fx, fy, fz))


@device_function
def encode(grid, levels, x, a, b, features):
    """Features of points a to b: x float32 (3, N) in the unit cube -> features float32 (>= 2 L, N).

    Levels from ``levels`` on are switched off (coarse to fine): their features are 0.
    """
    for l in range(grid.resolution.size):
        out0, out1 = features[2 * l, a:b], features[2 * l + 1, a:b]
        if l >= levels:
            out0[:] = np.float32(0.0)
            out1[:] = np.float32(0.0)
            continue
        res = grid.resolution[l]
        table = grid.table[grid.first[l] : grid.first[l + 1]]
        mask = np.uint32(table.shape[0] - 1)
        if grid.dense[l]:
            _encode_level(True, res, mask, x[0, a:b], x[1, a:b], x[2, a:b], table, out0, out1)
        else:
            _encode_level(False, res, mask, x[0, a:b], x[1, a:b], x[2, a:b], table, out0, out1)


@device_function
def flag_segments(dirty, shift, i, j):
    """Flag the segments, of 2^shift rows, of two vertices that are neighbors, and so mostly share one."""
    a, b = i >> np.uint32(shift), j >> np.uint32(shift)
    dirty[a] = True
    if b != a:
        dirty[b] = True


@device_function
def _scatter_level(dense, res, mask, x, d0, d1, gradient, dirty):
    zero = np.float32(0.0)
    for s in range(d0.size):
        g0, g1 = d0[s], d1[s]
        if g0 == zero and g1 == zero:  # samples behind the first opaque surface
            continue
        ix, fx = corner(x[0, s], res)
        iy, fy = corner(x[1, s], res)
        iz, fz = corner(x[2, s], res)
        rows, weights = _corners(dense, res, mask, ix, iy, iz), _weights(fx, fy, fz)
        for k in range(8):
            _add_pair(gradient, rows[k], weights[k], g0, g1)
        for k in range(0, 8, 2):
            flag_segments(dirty, 4, rows[k], rows[k + 1])


@kernel
def scatter(counter, worker, grid, levels, x, d_features, counts, gradient, dirty):
    """Add the table's gradient of all samples to ``gradient``; a task is a level, so nothing races.

    x: float32 (chunks, 3, N), unit cube. d_features: float32 (chunks, >= 2 L, N), dLoss / dfeatures.
    counts: int64 (chunks,), columns in use. gradient: float32 like ``grid.table``. dirty: bool
    (vertices / SEGMENT,), set where a segment received anything.
    """
    while True:
        task = fetch_add(counter, 1)
        if task >= levels:
            return
        l = levels - 1 - task  # the fine levels take longest: they go first
        a, b = grid.first[l], grid.first[l + 1]
        res, mask = grid.resolution[l], np.uint32(b - a - 1)
        level_gradient, level_dirty = gradient[a:b], dirty[a // SEGMENT : b // SEGMENT]
        for c in range(counts.size):
            n = counts[c]
            d0, d1 = d_features[c, 2 * l, :n], d_features[c, 2 * l + 1, :n]
            if grid.dense[l]:
                _scatter_level(True, res, mask, x[c], d0, d1, level_gradient, level_dirty)
            else:
                _scatter_level(False, res, mask, x[c], d0, d1, level_gradient, level_dirty)


@implements(query_density, "resolution")
def _query_density(encoding, levels, net, x, start, end, acts):
    encode(encoding, levels, x, start, end, acts)
    for k in range(2 * encoding.resolution.size, net.widths[0]):  # loops: slices compile for seconds
        padding = acts[k, start:end]
        for s in range(padding.size):
            padding[s] = np.float32(0.0)
    forward(net, acts, start, end)


@implements(query_color, "resolution")
def _query_color(encoding, levels, net, x, start, end, acts):
    """``query_density`` has done it already."""


@implements(query_backward, "resolution")
def _query_backward(encoding, net, acts, d_acts, n, d_params, d_features):
    backward(net, acts, d_acts, n, d_params)
    for k in range(net.widths[0]):
        to, d = d_features[k], d_acts[k]
        for s in range(n):
            to[s] = d[s]
