"""Vector-matrix factors (TensoRF; Chen et al. 2022, eq. 6 and 8): features of points and their gradient.

A group is eight components, each a plane over two axes times a line along the third; groups cycle through the
three orientations. Density is the sum of the components of its groups and needs no network. Color components
feed the network, whose first layer is the paper's basis matrix. Points lie in the unit cube; planes are
interpolated bilinearly, lines linearly, eight channels at a time in one vector register.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from edge_server.fields.common.kernels.hash_grid import corner, flag_segments
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.mlp import backward, forward
from edge_server.fields.common.kernels.radiance_model import implements, query_backward, query_color, query_density
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.common.kernels.simd_vectors import Vector

CHANNELS = 8  # components of a group; one 256-bit register
ROWS = 4  # rows of a table in a segment; a dirty flag stands for one segment
MODES = 3  # orientations: plane xy and line z, plane xz and line y, plane yz and line x
TILE = 16  # samples side by side: a cache line of each row of ``acts`` is written as a whole

_F0, _F1 = np.float32(0.0), np.float32(1.0)


class Planes(NamedTuple):
    """The factors of one field.

    size: vertices a side.
    density_groups, groups: multiples of 3; the first density_groups make up density, the others feed the
        network.
    rows: rows of ``table`` for each group, a multiple of ROWS.
    bias: float32, raw density where all factors are 0.
    table: float32 (groups * rows, 8); per group the plane's size^2 vertices, the first axis fastest, then the
        line's.
    """

    size: int
    density_groups: int
    groups: int
    rows: int
    bias: np.float32
    table: NDArray[np.float32]


class _RowBuilder:
    """Emits what both passes share: rows of a table as vectors, and the factors of a product."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.context, self.builder, self.kinds, self.args = context, builder, signature.args, args
        self.rows = [builder.extract_value(args[1], k) for k in range(6)]
        numbers = [builder.extract_value(args[2], k) for k in range(6)]
        self.weights = [Vector.broadcast(builder, number, CHANNELS) for number in numbers]

    def at(self, n: int, row: Any) -> Any:
        """A pointer to a row of array argument n."""
        data = self.context.make_array(self.kinds[n])(self.context, self.builder, self.args[n]).data
        first = self.builder.mul(self.builder.zext(row, ir.IntType(64)), ir.IntType(64)(CHANNELS))
        return self.builder.gep(data, [first])

    def load(self, n: int, row: Any) -> Vector:
        """A row of array argument n."""
        return Vector.load(self.builder, self.at(n, row), CHANNELS)

    def factors(self) -> tuple[Vector, Vector]:
        """The plane's and the line's values: rows of argument 0 times weights."""
        terms = [self.load(0, row) * weight for row, weight in zip(self.rows, self.weights, strict=True)]
        return terms[0] + terms[1] + terms[2] + terms[3], terms[4] + terms[5]


@intrinsic
def store_products(typingctx: Any, table: Any, rows: Any, weights: Any, out: Any, at: Any) -> Any:
    """``out[at] = (sum_k<4 weights[k] table[rows[k]]) * (sum_k>=4 weights[k] table[rows[k]])``.

    table, out: contiguous float32 (N, 8); rows: 6 uint32, weights: 6 float32 (four vertices of the plane,
    two of the line); at: uint32. As a plain loop over the channels it takes twice as long.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        build = _RowBuilder(context, builder, signature, args)
        plane, line = build.factors()
        (plane * line).store(build.at(3, args[4]))
        return context.get_dummy_value()

    return types.void(table, rows, weights, out, types.uint32), codegen


@intrinsic
def store_products_backward(typingctx: Any, table: Any, rows: Any, weights: Any, d: Any, at: Any, gradient: Any) -> Any:
    """Backward of ``store_products``: d[at] is dLoss / dout[at]; adds to ``gradient``, shaped like table."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        build = _RowBuilder(context, builder, signature, args)
        plane, line = build.factors()
        above = build.load(3, args[4])
        steps = [above * line] * 4 + [above * plane] * 2
        for row, weight, step in zip(build.rows, build.weights, steps, strict=True):
            (build.load(5, row) + step * weight).store(build.at(5, row))
        return context.get_dummy_value()

    return types.void(table, rows, weights, d, types.uint32, gradient), codegen


@device_function
def _neighbors(size, u, v, w):
    """Rows within a group and weights: the plane's four vertices around (u, v), the line's two around w."""
    one = np.uint32(1)
    i, fu = corner(u, size - 1)
    j, fv = corner(v, size - 1)
    k, fw = corner(w, size - 1)
    side = np.uint32(size)
    a = np.uint32(i + np.uint32(j * side))
    b = np.uint32(a + side)
    c = np.uint32(k + np.uint32(side * side))
    gu, gv = _F1 - fu, _F1 - fv
    rows = (a, np.uint32(a + one), b, np.uint32(b + one), c, np.uint32(c + one))
    return rows, (gu * gv, fu * gv, gu * fv, fu * fv, _F1 - fw, fw)


@device_function
def _axes(x, group):
    """Coordinates along the two axes of a group's plane and along its line."""
    mode = group % MODES
    u, v, w = x[0], x[1], x[2]
    if mode == 1:
        v, w = x[2], x[1]
    elif mode == 2:
        u, v, w = x[1], x[2], x[0]
    return u, v, w


@device_function
def group_components(table, size, x, group, a, count, tile):
    """Components of one group at samples a to a + count (at most TILE) into tile, float32 (TILE, 8).
    table: the group's rows."""
    u, v, w = _axes(x, group)
    for s in range(count):
        rows, weights = _neighbors(size, u[a + s], v[a + s], w[a + s])
        store_products(table, rows, weights, tile, np.uint32(s))


@device_function
def raw_density(planes, x, start, end, out):
    """Raw density (eq. 6) of samples start to end into ``out``, float32 (N,)."""
    tile = np.empty((TILE, CHANNELS), np.float32)
    for a in range(start, end, TILE):
        count = min(TILE, end - a)
        raw = out[a : a + count]
        for s in range(count):
            raw[s] = planes.bias
        for g in range(planes.density_groups):
            table = planes.table[g * planes.rows : (g + 1) * planes.rows]
            group_components(table, planes.size, x, g, a, count, tile)
            for s in range(count):
                total = _F0
                for c in range(CHANNELS):
                    total += tile[s, c]
                raw[s] += total


@device_function
def color_components(planes, x, start, end, acts):
    """Components of the color groups at samples start to end into the first rows of acts."""
    tile = np.empty((TILE, CHANNELS), np.float32)
    for a in range(start, end, TILE):
        count = min(TILE, end - a)
        for g in range(planes.density_groups, planes.groups):
            table = planes.table[g * planes.rows : (g + 1) * planes.rows]
            group_components(table, planes.size, x, g, a, count, tile)
            first = (g - planes.density_groups) * CHANNELS
            for c in range(CHANNELS):
                row = acts[first + c, a : a + count]
                for s in range(count):
                    row[s] = tile[s, c]


@kernel
def scatter_planes(counter, worker, planes, x, d_features, counts, gradient, dirty):
    """Add the factors' gradient of all samples to ``gradient``; a task is a group, so nothing races.

    x: float32 (chunks, 3, N). d_features: float32 (chunks, 8 color groups + 1, N), dLoss / dcomponent;
    the last row is dLoss / draw density. counts: int64 (chunks,), columns in use. gradient: float32 like
    ``planes.table``. dirty: bool (table rows / ROWS,), set where a segment received anything.
    """
    d = np.empty((TILE, CHANNELS), np.float32)
    last = d_features.shape[1] - 1
    while True:
        task = fetch_add(counter, 1)
        if task >= planes.groups:
            return
        g = np.int64(task)
        a0, b0 = g * planes.rows, (g + 1) * planes.rows
        table, to = planes.table[a0:b0], gradient[a0:b0]
        flags = dirty[a0 // ROWS : b0 // ROWS]
        first = (g - planes.density_groups) * CHANNELS
        for chunk in range(counts.size):
            u, v, w = _axes(x[chunk], g)
            n = counts[chunk]
            for a in range(0, n, TILE):
                count = min(TILE, n - a)
                for c in range(CHANNELS):
                    row = d_features[chunk, last if g < planes.density_groups else first + c, a : a + count]
                    for s in range(count):
                        d[s, c] = row[s]
                for s in range(count):
                    # Samples without weight and dead units of the network have no gradient.
                    some = False
                    for c in range(CHANNELS):
                        some |= d[s, c] != _F0
                    if not some:
                        continue
                    rows, weights = _neighbors(planes.size, u[a + s], v[a + s], w[a + s])
                    store_products_backward(table, rows, weights, d, np.uint32(s), to)
                    for k in range(0, 6, 2):
                        flag_segments(flags, 2, rows[k], rows[k + 1])


@implements(query_density, "density_groups")
def _query_density(encoding, levels, net, x, start, end, acts):
    raw_density(encoding, x, start, end, acts[acts.shape[0] - net.widths[-1]])


@implements(query_color, "density_groups")
def _query_color(encoding, levels, net, x, start, end, acts):
    # The network's output in density's row is meaningless: restore the density.
    sigma = acts[acts.shape[0] - net.widths[-1], start:end]
    kept = sigma.copy()
    color_components(encoding, x, start, end, acts)
    forward(net, acts, start, end)
    for s in range(kept.size):
        sigma[s] = kept[s]


@implements(query_backward, "density_groups")
def _query_backward(encoding, net, acts, d_acts, n, d_params, d_features):
    inputs = net.widths[0]
    d_raw, d_sigma = d_features[inputs], d_acts[d_acts.shape[0] - net.widths[-1]]
    for s in range(n):
        d_raw[s] = d_sigma[s]
        d_sigma[s] = _F0
    backward(net, acts, d_acts, n, d_params)
    for k in range(inputs):
        to, d = d_features[k], d_acts[k]
        for s in range(n):
            to[s] = d[s]
