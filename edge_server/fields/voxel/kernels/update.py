"""What happens to a voxel grid between steps: Adam where there was a gradient, diffusion, refinement,
occupancy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.adam import GRADIENT_LIMIT
from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.simd import fetch_add, is_finite
from edge_server.fields.voxel.kernels.cell_quads import cell_value
from edge_server.fields.voxel.kernels.rays import SEGMENT

WIDTH = 4 * SEGMENT  # parameters of a segment
PART = 256  # dirty flags a task
FARTHEST = 100  # what ``clear`` counts up to
DENSEST = 4.0  # optical depth of one step at most: a denser vertex has no gradient left to get clear again

_F0, _F1 = np.float32(0.0), np.float32(1.0)


class VoxelRule(NamedTuple):
    """One step's rule. each: float32 (4 WIDTH,), for every parameter of a segment its rate, then by how
    much that grows with the parameter, then what pulls it towards zero (in rates), then its largest value:
    one array, since LLVM vectorises no loop that has more than a few to tell apart. beta2, epsilon: Adam's;
    correct2: 1 / (1 - beta2^t)."""

    each: NDArray[np.float32]
    beta2: np.float32
    epsilon: np.float32
    correct2: np.float32


def each_of(*pairs: tuple[float, float]) -> NDArray[np.float32]:
    """``VoxelRule.each`` from the rate, growth, pull and largest value of (density, colours)."""
    return np.concatenate([np.tile(np.float32([a, b, b, b]), SEGMENT) for a, b in pairs])


@kernel
def voxel_adam(counter, worker, table, v, gradient, dirty, rule, dropped):
    """Adam (Kingma and Ba 2015) without its first moment on the vertices with a flag; clears gradients and
    flags.

    table, v: float32 (N, 4). gradient: float32 (P, N, 4), summed in the order of P. dirty: uint8
    (P, N / SEGMENT). Parameters are projected to [0, top], not activated: an empty vertex keeps its
    gradient. What got no gradient keeps its moment. dropped: int64 (tasks,), gradients not finite.
    """
    parts, flags = dirty.shape
    each, width, limit = rule.each, WIDTH, np.float32(GRADIENT_LIMIT)
    flat, flat_v, flat_g = table.reshape(-1), v.reshape(-1), gradient.reshape(parts, -1)
    total = np.empty(width, np.float32)
    while True:
        task = fetch_add(counter, 1)
        if task >= dropped.size:
            return
        bad = 0
        for flag in range(task * PART, min((task + 1) * PART, flags)):
            found = 0
            a, b = flag * width, (flag + 1) * width
            for buffer in range(parts):
                if dirty[buffer, flag] != 0:
                    dirty[buffer, flag] = 0
                    g = flat_g[buffer, a:b]
                    if found == 0:
                        for k in range(width):
                            total[k] = g[k]
                            g[k] = _F0
                    else:
                        for k in range(width):
                            total[k] += g[k]
                            g[k] = _F0
                    found += 1
            if found == 0:
                continue
            p, second = flat[a:b], flat_v[a:b]
            for k in range(width):
                raw = total[k]
                finite = is_finite(raw)
                bad += 0 if finite else 1
                use = finite and raw != _F0
                d = min(max(raw, -limit), limit)
                v0 = second[k] if is_finite(second[k]) else _F0
                v1 = rule.beta2 * v0 + (_F1 - rule.beta2) * d * d
                way = d / (np.sqrt(v1 * rule.correct2) + rule.epsilon) + each[2 * WIDTH + k]
                q = p[k] - each[k] * (_F1 + each[WIDTH + k] * p[k]) * way
                second[k] = v1 if use else v0
                q = min(max(q if use else p[k], _F0), each[3 * WIDTH + k])
                p[k] = q if is_finite(p[k]) else _F0
        dropped[task] = bad


class DiffusionRule(NamedTuple):
    """edge: float32 (4,), of the difference between two neighbours in density and each colour so much counts
    at most: what differs by more is an edge, and is drawn together no faster. share: float32, of the sum of a
    vertex's six differences by which it moves; up to 1/6 no pattern between neighbours grows."""

    edge: NDArray[np.float32]
    share: np.float32


@kernel
def diffuse(counter, worker, turn, turns, voxels, away, cells, rule):
    """Draw vertices together with their six neighbours, in cells where away (see ``Clearing``) is 0: a step
    down the grid's total variation, made smooth where it is small (Huber 1964; diffusion that stops at edges,
    Perona and Malik 1990).

    Only every ``turns``-th layer moves (2 or more): the layers beside it stand still meanwhile, and the
    result is the same however many work at once. After all turns, 0 to turns - 1, each layer has moved once;
    the grid's outermost vertices stay.
    """
    size, share = voxels.size, rule.share
    flat, plane, row = voxels.table.reshape(-1), 4 * size * size, 4 * size
    edges = np.empty(row, np.float32)  # flat, as everything here: LLVM vectorises this alone
    for k in range(row):
        edges[k] = rule.edge[k & 3]
    tops = np.full(row, _F1)
    tops[::4] = DENSEST
    before = np.empty(row, np.float32)
    starts = np.empty(cells + 1, np.int64)  # the first vertex of each cell that may move
    for c in range(cells + 1):
        starts[c] = min(max((c * (size - 1) + cells - 1) // cells, 1), size - 1)
    while True:
        z = turns * fetch_add(counter, 1) + 1 + turn
        if z >= size - 1:
            return
        layer = cells * cells * (z * cells // (size - 1))
        for y in range(1, size - 1):
            cell = layer + cells * (y * cells // (size - 1))
            line = 4 * size * (y + size * z)
            c, copied = 0, False
            while c < cells:
                if away[cell + c] != 0:
                    c += 1
                    continue
                end = c + 1
                while end < cells and away[cell + end] == 0:
                    end += 1
                if not copied:
                    before[:] = flat[line : line + row]
                    copied = True
                x, n = 4 * starts[c], 4 * (starts[end] - starts[c])
                a, c = line + x, end
                old, edge, top = before[x - 4 : x + n + 4], edges[:n], tops[:n]
                p = flat[a : a + n]
                south, north = flat[a - row : a - row + n], flat[a + row : a + row + n]
                below, above = flat[a - plane : a - plane + n], flat[a + plane : a + plane + n]
                for k in range(n):
                    q, e = old[k + 4], edge[k]
                    way = _bounded(old[k] - q, e) + _bounded(old[k + 8] - q, e)
                    way += _bounded(south[k] - q, e) + _bounded(north[k] - q, e)
                    way += _bounded(below[k] - q, e) + _bounded(above[k] - q, e)
                    p[k] = min(max(q + share * way, _F0), top[k])


@part
def _bounded(d, edge):
    """d between -edge and edge; NaN counts as -edge, so that it does not spread."""
    d = d if d > -edge else -edge
    return d if d < edge else edge


@kernel
def refine(counter, worker, old, size, new, new_size):
    """Interpolate old, float32 (size^3, 4), to new (new_size^3, 4).

    Density belongs to a step, and steps get shorter: what is opaque stays so and gets thinner, which is what
    a finer grid is for.
    """
    scale = (size - 1) / (new_size - 1)
    while True:
        k = fetch_add(counter, 1)
        if k >= new_size:
            return
        iz = min(np.int64(k * scale), size - 2)
        fz = np.float32(k * scale - iz)
        for j in range(new_size):
            iy = min(np.int64(j * scale), size - 2)
            fy = np.float32(j * scale - iy)
            for i in range(new_size):
                ix = min(np.int64(i * scale), size - 2)
                fx = np.float32(i * scale - ix)
                first = ix + size * (iy + size * iz)
                at = i + new_size * (j + new_size * k)
                density, r, g, b = cell_value(old, first, size, fx, fy, fz)
                new[at, 0], new[at, 1], new[at, 2], new[at, 3] = density, r, g, b


@kernel
def densest(counter, worker, phase, phases, fade, voxels, per_unit, cells, seen, min_views, density):
    """Refresh every ``phases``-th layer of cells: the larger of the faded old density and the densest vertex
    that reaches into a cell, times per_unit. Cells that fewer than min_views cameras see are 0."""
    size, table = voxels.size, voxels.table
    scale = (size - 1) / cells
    while True:
        k = fetch_add(counter, 1) * phases + phase
        if k >= cells:
            return
        z0, z1 = np.int64(k * scale), min(np.int64((k + 1) * scale) + 2, size)
        for j in range(cells):
            y0, y1 = np.int64(j * scale), min(np.int64((j + 1) * scale) + 2, size)
            for i in range(cells):
                cell = i + cells * (j + cells * k)
                if seen[cell] < min_views:
                    density[cell] = _F0
                    continue
                top = _F0
                for z in range(z0, z1):
                    for y in range(y0, y1):
                        row = size * (y + size * z)
                        for x in range(np.int64(i * scale), min(np.int64((i + 1) * scale) + 2, size)):
                            value = table[row + x, 0]
                            top = max(top, value if is_finite(value) else np.float32(1e3))
                density[cell] = max(density[cell] * fade, top * per_unit)


@kernel
def clear(occupied, cells, away):
    """Fill away, uint8 (cells^3,), from occupied: how many cells it is to the nearest occupied one,
    diagonals counting one; FARTHEST at most. (Rosenfeld and Pfaltz 1966: once forward, once back.)"""
    for cell in range(away.size):
        away[cell] = np.uint8(0) if occupied[cell] != 0 else np.uint8(FARTHEST)
    last, one = cells - 1, np.uint8(1)
    for turn in range(2):
        for n in range(away.size):
            cell = n if turn == 0 else away.size - 1 - n
            best = away[cell]
            if best <= one:
                continue
            i, j, k = cell % cells, (cell // cells) % cells, cell // (cells * cells)
            # The layer before, in the order of this turn, and this one.
            for c in range(max(k - 1 + turn, 0), min(k + turn, last) + 1):
                for b in range(max(j - 1, 0), min(j + 1, last) + 1):
                    row = cells * (b + cells * c)
                    for a in range(max(i - 1, 0), min(i + 1, last) + 1):
                        best = min(best, np.uint8(away[row + a] + one))
            away[cell] = best
