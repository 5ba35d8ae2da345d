"""Updates of a voxel grid: sparse Adam, diffusion, upsampling, and the cells that rays skip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.adam import GRADIENT_LIMIT
from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.simd import fetch_add, is_finite
from edge_server.fields.voxel.kernels.cell_quads import cell_value
from edge_server.fields.voxel.kernels.rays import SEGMENT

SEGMENT_VALUES = 4 * SEGMENT  # parameters in a segment
TASK_FLAGS = 256  # dirty flags a task
MAX_CLEARANCE = 100  # largest distance in ``SkipGrid.clearance``
MAX_DENSITY = 4.0  # optical depth of one step: a denser vertex would have no gradient left

_F0, _F1 = np.float32(0.0), np.float32(1.0)


class AdamRule(NamedTuple):
    """Constants of one Adam step.

    constants: float32 (4 SEGMENT_VALUES,), for every parameter of a segment its rate, the growth of the rate
    with the parameter, the L1 pull towards zero (in rates), and its largest value. One array, since LLVM does
    not vectorize loops over more than a few. beta2, epsilon: Adam's. correct2: 1 / (1 - beta2^t).
    """

    constants: NDArray[np.float32]
    beta2: np.float32
    epsilon: np.float32
    correct2: np.float32


def adam_constants(*pairs: tuple[float, float]) -> NDArray[np.float32]:
    """``AdamRule.constants`` from rate, growth, pull and largest value, each a pair (density, colors)."""
    return np.concatenate([np.tile(np.float32([a, b, b, b]), SEGMENT) for a, b in pairs])


@kernel
def voxel_adam(counter, worker, table, v, gradient, dirty, rule, dropped):
    """Adam (Kingma and Ba 2015) without first moment on flagged vertices; clears gradients and flags.

    table, v: float32 (N, 4). gradient: float32 (P, N, 4), summed in the order of P. dirty: uint8
    (P, N / SEGMENT). dropped: int64 (tasks,), receives the number of gradients that are not finite.
    Parameters are projected to [0, largest value] instead of activated, so that an empty vertex keeps its
    gradient. Parameters without a gradient keep their moment.
    """
    parts, flags = dirty.shape
    constants, width, limit = rule.constants, SEGMENT_VALUES, np.float32(GRADIENT_LIMIT)
    flat, flat_v, flat_g = table.reshape(-1), v.reshape(-1), gradient.reshape(parts, -1)
    total = np.empty(width, np.float32)
    while True:
        task = fetch_add(counter, 1)
        if task >= dropped.size:
            return
        bad = 0
        for flag in range(task * TASK_FLAGS, min((task + 1) * TASK_FLAGS, flags)):
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
                way = d / (np.sqrt(v1 * rule.correct2) + rule.epsilon) + constants[2 * SEGMENT_VALUES + k]
                q = p[k] - constants[k] * (_F1 + constants[SEGMENT_VALUES + k] * p[k]) * way
                second[k] = v1 if use else v0
                q = min(max(q if use else p[k], _F0), constants[3 * SEGMENT_VALUES + k])
                p[k] = q if is_finite(p[k]) else _F0
        dropped[task] = bad


class DiffusionRule(NamedTuple):
    """Constants of one diffusion step.

    edge: float32 (4,), bound of the difference to a neighbor, by channel: larger differences are edges and
    diffuse no faster.
    share: how far a vertex moves, as a share of the sum of its six differences; stable up to 1/6.
    """

    edge: NDArray[np.float32]
    share: np.float32


@kernel
def diffuse(counter, worker, phase, phases, voxels, clearance, cells, rule):
    """Diffuse vertices towards their six neighbors, in occupied cells (clearance 0, see ``SkipGrid``).

    This is a descent step on the Huber-smoothed total variation of the grid (Huber 1964; edge-stopping
    diffusion, Perona and Malik 1990). Only every ``phases``-th layer moves (2 or more) while its neighbors
    stand still, so the result does not depend on the number of workers. After all phases, 0 to phases - 1,
    each layer has moved once; the outermost vertices stay.
    """
    size, share = voxels.size, rule.share
    flat, plane, row = voxels.table.reshape(-1), 4 * size * size, 4 * size
    edges = np.empty(row, np.float32)  # flat arrays, since LLVM vectorizes nothing else here
    for k in range(row):
        edges[k] = rule.edge[k & 3]
    tops = np.full(row, _F1)
    tops[::4] = MAX_DENSITY
    before = np.empty(row, np.float32)
    starts = np.empty(cells + 1, np.int64)  # the first vertex of each cell that may move
    for c in range(cells + 1):
        starts[c] = min(max((c * (size - 1) + cells - 1) // cells, 1), size - 1)
    while True:
        z = phases * fetch_add(counter, 1) + 1 + phase
        if z >= size - 1:
            return
        layer = cells * cells * (z * cells // (size - 1))
        for y in range(1, size - 1):
            cell = layer + cells * (y * cells // (size - 1))
            line = 4 * size * (y + size * z)
            c, copied = 0, False
            while c < cells:
                if clearance[cell + c] != 0:
                    c += 1
                    continue
                end = c + 1
                while end < cells and clearance[cell + end] == 0:
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
                    way = _clamp(old[k] - q, e) + _clamp(old[k + 8] - q, e)
                    way += _clamp(south[k] - q, e) + _clamp(north[k] - q, e)
                    way += _clamp(below[k] - q, e) + _clamp(above[k] - q, e)
                    p[k] = min(max(q + share * way, _F0), top[k])


@part
def _clamp(d, edge):
    """Clamp d to [-edge, edge]; NaN becomes -edge, so that it does not spread."""
    d = d if d > -edge else -edge
    return d if d < edge else edge


@kernel
def upsample_grid(counter, worker, old, size, new, new_size):
    """Interpolate old, float32 (size^3, 4), to new (new_size^3, 4).

    Density is optical depth of one step, and steps get shorter: opaque surfaces stay opaque and get thinner.
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
def update_cell_density(counter, worker, phase, phases, fade, voxels, per_unit, cells, seen, min_views, density):
    """Refresh every ``phases``-th layer of cells: the larger of the faded old density and the density of the
    densest vertex that reaches into a cell, times per_unit. Cells seen by fewer than min_views get 0."""
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
def distance_transform(occupied, cells, clearance):
    """Fill clearance, uint8 (cells^3,), with the distance to the nearest occupied cell in cells, diagonals
    counting one, MAX_CLEARANCE at most. A forward and a backward pass (Rosenfeld and Pfaltz 1966)."""
    for cell in range(clearance.size):
        clearance[cell] = np.uint8(0) if occupied[cell] != 0 else np.uint8(MAX_CLEARANCE)
    last, one = cells - 1, np.uint8(1)
    for phase in range(2):
        for n in range(clearance.size):
            cell = n if phase == 0 else clearance.size - 1 - n
            best = clearance[cell]
            if best <= one:
                continue
            i, j, k = cell % cells, (cell // cells) % cells, cell // (cells * cells)
            # The previous layer, in the order of this pass, and this one.
            for c in range(max(k - 1 + phase, 0), min(k + phase, last) + 1):
                for b in range(max(j - 1, 0), min(j + 1, last) + 1):
                    row = cells * (b + cells * c)
                    for a in range(max(i - 1, 0), min(i + 1, last) + 1):
                        best = min(best, np.uint8(clearance[row + a] + one))
            clearance[cell] = best
