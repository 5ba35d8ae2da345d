"""Where a ray's samples go, learnt: a grid of density alone, sampled along the whole ray, says where to look.

Proposal networks of mip-NeRF 360 (Barron et al. 2022, section 3) as nerfacto (Tancik et al. 2023) uses them,
for CPUs: the proposal is a dense grid of one number a cell and no network, so a look at it is one load.
A ray is cut into bins of equal length in contracted space, which share the ray's samples by their weight.
Every sample lies inside one bin or a few whole ones, so the bound of the paper's eq. 12 is their weight.

The grid stands behind the hash levels in the same table: one optimiser, one state, one snapshot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT, Grid
from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.radiance_model import is_a, query_backward, query_color, query_density
from edge_server.fields.common.kernels.rays import slab
from edge_server.fields.common.kernels.simd import exp32, fetch_add, is_finite
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW

GAIN = 4.0  # raw density per unit of the table: it must rise in tens of steps at the hash levels' rate
START = -1.2  # raw density where the table is 0: the same thin fog the network starts with
DARK = 10.0  # optical depth behind which a proposal needs no bins
SLABS = 8  # tasks that the gradient of the grid is divided into
DIM = 0.1  # of a sample in full light that a dark bin counts when samples are dealt evenly
FLOOR = 1e-3  # of a bin's weight in the interlevel loss's denominator: no weight, no division by it

_F0, _F1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


class Proposed(NamedTuple):
    """A hash grid (``grid.Grid``: resolution, first, dense, table) and, from row first[-1] of its table on,
    the proposal: cells^3 float32, x fastest, raw density / GAIN less START."""

    resolution: NDArray[np.int32]
    first: NDArray[np.int64]
    dense: NDArray[np.bool_]
    table: NDArray[np.float32]
    cells: int


class Plan(NamedTuple):
    """How a ray is sampled. bins: along the whole ray. samples: shared among them. even: float32, the share
    of samples that is dealt evenly. interlevel: float32, weight of the proposal's loss; decay: float32, of
    the pull of its raw densities to the fog they started as."""

    bins: int
    samples: int
    even: np.float32
    interlevel: np.float32
    decay: np.float32


@part
def unit_cube(contracted, px, py, pz):
    """Scene units -> the encoding's unit cube, [0, 1)."""
    scale, top = _HALF, np.float32(0.9999999)
    if contracted:
        scale = np.float32(0.25)
        m = max(abs(px), max(abs(py), abs(pz)))
        if m > _F1:
            s = (np.float32(2.0) - _F1 / m) / m
            px, py, pz = px * s, py * s, pz * s
    return (
        min(max(px * scale + _HALF, _F0), top),
        min(max(py * scale + _HALF, _F0), top),
        min(max(pz * scale + _HALF, _F0), top),
    )


@part
def proposal_of(encoding):
    """The proposal's cells, flat."""
    return encoding.table[encoding.first[encoding.first.size - 1] :].reshape(-1)


@part
def _cell(cells, ux, uy, uz):
    f, n = np.float32(cells), np.int32(cells)
    return np.int32(np.int32(ux * f) + n * np.int32(np.int32(uy * f) + n * np.int32(uz * f)))


@part
def warp(contracted, ox, oy, oz, dx, dy, dz, enter, leave):
    """The spacing of bins: linear in distance as far as the box of interest goes, then in disparity.

    Returns (knee, slope, end): warped distance u is t up to the knee, then knee + (1 - 1 / (1 + (t - knee)
    slope)) / slope; end is that of ``leave``. Equal steps in u are about equal in contracted space.
    """
    if not contracted:
        return leave, _F1, leave
    near, far = slab(ox, dx, _F1, enter, leave)
    near, far = slab(oy, dy, _F1, near, far)
    near, far = slab(oz, dz, _F1, near, far)
    knee = far if far > near else enter
    m = max(abs(ox + knee * dx), max(abs(oy + knee * dy), abs(oz + knee * dz)))
    slope = max(abs(dx), max(abs(dy), abs(dz))) / max(m, _F1)
    return knee, slope, knee + (_F1 - _F1 / (_F1 + (leave - knee) * slope)) / slope


@part
def unwarp(u, knee, slope):
    """Distance along the ray of warped distance u."""
    return u if u <= knee else knee + (_F1 / (_F1 - (u - knee) * slope) - _F1) / slope


@part
def propose(
    space, encoding, bins, ox, oy, oz, dx, dy, dz, enter, leave, shift, first, cell, depth, edges, at
):
    """Cut a ray into bins; keep those in cells worth a sample (``occupancy``), up to where it is dark.

    shift: in [0, 1), moves the raster of bins. From ``first`` on, cell: int32 (N,), proposal cell of each
    bin kept; depth: float32 (N,), its optical depth. edges: float32 (2, bins + 1), where the k-th begins and
    ends. at: int32 (2, bins), scratch. Returns (bins kept, whether all densities met are finite).
    """
    knee, slope, end = warp(space.contracted, ox, oy, oz, dx, dy, dz, enter, leave)
    step = (end - enter) / np.float32(bins - 1)
    raw_of = proposal_of(encoding)
    # Loops of one thing each: all but the one that looks into the grids are vector loops.
    begin, finish = edges[0], edges[1]
    for j in range(bins + 1):
        begin[j] = unwarp(min(enter + max(np.float32(j) - shift, _F0) * step, end), knee, slope)
    here, there = at[0], at[1]
    for j in range(bins):
        mid = _HALF * (begin[j] + begin[j + 1])
        px, py, pz = ox + mid * dx, oy + mid * dy, oz + mid * dz
        ux, uy, uz = unit_cube(space.contracted, px, py, pz)
        here[j] = _cell(space.cells, ux, uy, uz)
        there[j] = _cell(encoding.cells, ux, uy, uz)
    count, finite = np.int64(0), True
    for j in range(bins):
        a, b = begin[j], begin[j + 1]
        if space.occupied[here[j]] != 0 and b > a:
            value = raw_of[there[j]]
            if not is_finite(value):
                finite, value = False, _F0
            cell[first + count], depth[first + count] = there[j], value
            begin[count], finish[count] = a, b
            count += 1
    own = depth[first : first + count]
    for k in range(count):
        raw = np.float32(GAIN) * own[k] + np.float32(START)
        sigma = exp32(min(max(raw, np.float32(RAW_LOW)), np.float32(RAW_HIGH)))
        own[k] = sigma * (finish[k] - begin[k])
    total = _F0
    for k in range(count):
        total += own[k]
        if total > np.float32(DARK):
            return np.int64(k + 1), finite
    return count, finite


@part
def weigh(depth, first, count, weight):
    """Weights of bins in volume rendering (3.21): depth, weight: float32, from ``first`` on."""
    total, before = _F0, _F1
    for k in range(first, first + count):
        total += depth[k]
        after = exp32(-total)
        weight[k] = before - after
        before = after


@part
def deal(weight, first, count, samples, even, shift, group, share):
    """Inverse-CDF sampling: how a ray's bins share its samples.

    A bin that earns a sample or more is a group of its own, and share[g] (int64, one for each bin at least)
    tells how many it gets. Lesser ones are put together until they have earned one, so that samples stand
    for the ray's whole length: what has no sample would be seen through. group: int32, from ``first`` on, the
    group of each bin. Returns the number of groups; there are at most 2 samples + 1 samples.

    A bin counts with its neighbours' weights, too (mip-NeRF's filter: the mean of the larger on either
    side), since a surface may lie just across the edge. even: the share that is dealt by the light that
    arrives, whatever is there. shift: in [0, 1).
    """
    total, light, lights = _F0, _F1, _F0
    for k in range(first, first + count):
        total += _dilated(weight, k, first, first + count)
        lights += light + np.float32(DIM)
        light -= weight[k]
    evenly = even if total > np.float32(1e-12) else _F1
    norm = np.float32(samples) * (_F1 - evenly) / max(total, np.float32(1e-12))
    each = np.float32(samples) * evenly / max(lights, np.float32(DIM))
    light = _F1
    g, pending = np.int64(0), _F0
    for k in range(first, first + count):
        earned = norm * _dilated(weight, k, first, first + count) + each * (light + np.float32(DIM))
        light -= weight[k]
        if pending > _F0 and (earned >= _F1 or pending + earned > np.float32(1.0001)):
            g += 1
            pending = _F0
        group[k], share[g] = g, max(np.int64(earned + shift), np.int64(1))
        if earned >= _F1:
            g += 1
        else:
            share[g] = 1
            pending += earned
    return g + (1 if pending > _F0 else 0)


@part
def _dilated(weight, k, first, end):
    w = weight[k]
    left, right = weight[max(k - 1, first)], weight[min(k + 1, end - 1)]
    return _HALF * (max(left, w) + max(w, right))


@part
def place(contracted, ox, oy, oz, dx, dy, dz, edges, group, first, count, share, shift, n, limit, x, line):
    """Append a ray's samples, of equal length in each group; shift: in [0, 1), where in its part each lies.

    x: float32 (3, N), unit cube. line: float32 (>= 3, N): distance, length, number of the group. Returns
    the number of samples, at most ``limit``.
    """
    k = np.int64(0)
    while k < count:
        g, a, length = group[first + k], k, _F0
        while k < count and group[first + k] == g:
            length += edges[1, k] - edges[0, k]
            k += 1
        # A group of several bins may have gaps, where nothing is: its sample lies in one of them.
        chosen, within = a, shift
        if k - a > 1:
            spread = shift * np.float32(k - a)
            chosen = min(a + np.int64(spread), k - 1)
            within = spread - np.float32(chosen - a)
        step = (edges[1, chosen] - edges[0, chosen]) / np.float32(share[g])
        length /= np.float32(share[g])
        for i in range(share[g]):
            if n >= limit:
                return n
            t = edges[0, chosen] + (np.float32(i) + within) * step
            ux, uy, uz = unit_cube(contracted, ox + t * dx, oy + t * dy, oz + t * dz)
            x[0, n], x[1, n], x[2, n] = ux, uy, uz
            line[0, n], line[1, n], line[2, n] = t, length, np.float32(g)
            n += 1
    return n


@part
def interlevel(
    encoding, cell, depth, weight, group, first, count, w, group_of, start, stop, plan, slope, grad
):
    """The proposal's loss on one ray (eq. 13) and its gradient: no group of bins may weigh less than the
    samples in it.

    sum over groups of max(0, W - bound)^2 / (W + FLOOR): W the sum of the samples' weights w (float32,
    samples start to stop, in groups group_of), constants here; bound that of the bins' weights. cell, depth,
    weight, group: of bins first to first + count. slope: float32 (2, bins), scratch. grad: float32, like
    depth, receives ``plan.interlevel`` times dLoss / dcell, and the gradient of plan.decay / 2 times the
    square by which raw densities exceed their first value: a bound holds what is too high for ever, and
    behind an opaque bin no gradient says that the surface has moved. Returns the loss.
    """
    raw_of = proposal_of(encoding)
    loss = _F0
    inside, bound = slope[0], slope[1]
    for k in range(count):
        inside[k] = bound[k] = _F0
    for s in range(start, stop):
        inside[np.int64(group_of[s])] += w[s]
    for k in range(first, first + count):
        bound[group[k]] += weight[k]
    for g in range(count):
        lack, norm = max(inside[g] - bound[g], _F0), inside[g] + np.float32(FLOOR)
        loss += lack * lack / norm
        inside[g] = np.float32(-2.0) * plan.interlevel * lack / norm
    total, behind = _F0, _F0
    for k in range(first, first + count):
        total += depth[k]
    after = exp32(-total)  # transmittance behind the last bin
    for k in range(count - 1, -1, -1):
        d_w, own = inside[group[first + k]], weight[first + k]
        d_depth = d_w * after - behind
        behind += own * d_w
        after += own
        raw = np.float32(GAIN) * raw_of[cell[first + k]] + np.float32(START)
        free = raw > np.float32(RAW_LOW) and raw < np.float32(RAW_HIGH)
        pull = plan.decay * max(raw - np.float32(START), _F0)
        grad[first + k] = np.float32(GAIN) * (pull + (d_depth * depth[first + k] if free else _F0))
    return loss


@kernel
def scatter_proposal(counter, worker, encoding, cell, grad, counts, gradient, dirty):
    """Add the proposal's gradient to ``gradient`` (float32 like ``encoding.table``); a task is a slab of
    cells, so nothing races. cell: int32 (chunks, N), grad: float32 (chunks, N), the first counts[c] in use.
    dirty: bool (table rows / SEGMENT,), set where a segment received anything."""
    row = encoding.first[encoding.first.size - 1]
    flat, flags = gradient[row:].reshape(-1), dirty[row // SEGMENT :]
    width = SEGMENT * FEATURES
    size = (flags.size + SLABS - 1) // SLABS * width
    while True:
        task = fetch_add(counter, 1)
        if task >= SLABS:
            return
        low, high = task * size, (task + 1) * size
        for c in range(counts.size):
            for k in range(counts[c]):
                place, g = cell[c, k], grad[c, k]
                if low <= place < high and g != _F0:
                    flat[place] += g
                    flags[place // width] = True


@part
def _grid(e):
    return Grid(e.resolution, e.first, e.dense, e.table)


@overload(query_density)
def _query_density(encoding, levels, net, x, start, end, acts):
    if not is_a(encoding, Proposed):
        return None

    def run(encoding, levels, net, x, start, end, acts):
        query_density(_grid(encoding), levels, net, x, start, end, acts)

    return run


@overload(query_color)
def _query_color(encoding, levels, net, x, start, end, acts):
    """The network has said it already."""
    return (lambda encoding, levels, net, x, start, end, acts: None) if is_a(encoding, Proposed) else None


@overload(query_backward)
def _query_backward(encoding, net, acts, d_acts, n, d_params, d_features):
    if not is_a(encoding, Proposed):
        return None

    def run(encoding, net, acts, d_acts, n, d_params, d_features):
        query_backward(_grid(encoding), net, acts, d_acts, n, d_params, d_features)

    return run
