"""What happens to a voxel grid between steps: Adam where there was a gradient, refinement, occupancy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.kernels.adam import GRADIENT_LIMIT
from edge_server.fields.kernels.intrinsics import fetch_add, is_finite
from edge_server.fields.kernels.jit import kernel
from edge_server.fields.kernels.voxel import SEGMENT
from edge_server.fields.kernels.voxel_quads import cell_value

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
            for part in range(parts):
                if dirty[part, flag] != 0:
                    dirty[part, flag] = 0
                    g = flat_g[part, a:b]
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
