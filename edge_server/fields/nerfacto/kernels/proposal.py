"""Proposal sampling: a learned density grid decides where along a ray the samples go.

These are the proposal networks of mip-NeRF 360 (Barron et al. 2022, section 3) as nerfacto (Tancik et al.
2023) uses them, for CPUs: the proposal is a dense grid of one number a cell without a network, so a lookup
is one load. A ray is divided into bins of equal length in contracted space, and samples are allocated to bins
by weight. Every sample lies in one bin or a group of whole bins, so the bound of the paper's eq. 12 is the
weight of that group.

The grid follows the hash levels in the same table: one optimizer, one state, one snapshot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function
from edge_server.fields.common.kernels.mlp import PADDING
from edge_server.fields.common.kernels.radiance_model import implements, sample_rays
from edge_server.fields.common.kernels.rays import interval, slab, unit_cube
from edge_server.fields.common.kernels.simd import exp32, is_finite
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW
from edge_server.fields.field_constants import (
    NERFACTO_CUTOFF_DEPTH,
    NERFACTO_DARK_SHARE,
    NERFACTO_RAW_GAIN,
    NERFACTO_RAW_START,
)

_F0, _F1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


class ProposalSampling(NamedTuple):
    """How a ray is sampled and the proposal trained.

    bins: number of bins along the whole ray. samples: number of samples allocated to them.
    uniform_share: share of the samples that is allocated uniformly.
    interlevel: weight of the proposal's loss. decay: weight of the pull of raw densities to NERFACTO_RAW_START.
    """

    bins: int
    samples: int
    uniform_share: np.float32
    interlevel: np.float32
    decay: np.float32


class ProposalGrid(NamedTuple):
    """A hash grid (``hash_grid.Grid``) and, in its table from row first[-1] on, the proposal.

    The proposal is cells^3 float32, x fastest; raw density is NERFACTO_RAW_GAIN times a number, plus
    NERFACTO_RAW_START.
    """

    resolution: NDArray[np.int32]
    first: NDArray[np.int64]
    dense: NDArray[np.bool_]
    table: NDArray[np.float32]
    cells: int
    sampling: ProposalSampling


@device_function
def proposal_cells_of(encoding):
    """The proposal's cells as a flat array."""
    return encoding.table[encoding.first[encoding.first.size - 1] :].reshape(-1)


@device_function
def _cell(cells, ux, uy, uz):
    f, n = np.float32(cells), np.int32(cells)
    return np.int32(np.int32(ux * f) + n * np.int32(np.int32(uy * f) + n * np.int32(uz * f)))


@device_function
def warp(contracted, o, d, enter, leave):
    """Spacing of bins: linear in distance up to the end of the box of interest, then linear in disparity.

    Returns (knee, slope, end). Warped distance u is t up to the knee, then knee + (1 - 1 / (1 + (t - knee)
    slope)) / slope; end is the warped ``leave``. Equal steps in u are about equal in contracted space.
    """
    if not contracted:
        return leave, _F1, leave
    (ox, oy, oz), (dx, dy, dz) = o, d
    near, far = slab(ox, dx, _F1, enter, leave)
    near, far = slab(oy, dy, _F1, near, far)
    near, far = slab(oz, dz, _F1, near, far)
    knee = far if far > near else enter
    m = max(abs(ox + knee * dx), max(abs(oy + knee * dy), abs(oz + knee * dz)))
    slope = max(abs(dx), max(abs(dy), abs(dz))) / max(m, _F1)
    return knee, slope, knee + (_F1 - _F1 / (_F1 + (leave - knee) * slope)) / slope


@device_function
def unwarp(u, knee, slope):
    """Distance along the ray at warped distance u, the inverse of ``warp``."""
    return u if u <= knee else knee + (_F1 / (_F1 - (u - knee) * slope) - _F1) / slope


@device_function
def make_bins(space, encoding, bins, o, d, enter, leave, shift, first, cell, depth, edges, at):
    """Divide a ray into bins and keep those in occupied cells, up to optical depth NERFACTO_CUTOFF_DEPTH.

    shift: in [0, 1), moves the raster of bins. Written from ``first`` on: cell, int32 (N,), proposal cell of
    each kept bin; depth, float32 (N,), its optical depth. edges: float32 (2, bins + 1), receives start and
    end of the k-th kept bin. at: int32 (2, bins), scratch. Returns (bins kept, whether densities are finite).
    """
    (ox, oy, oz), (dx, dy, dz) = o, d
    knee, slope, end = warp(space.contracted, o, d, enter, leave)
    step = (end - enter) / np.float32(bins - 1)
    raw_of = proposal_cells_of(encoding)
    # Separate loops, so that LLVM vectorizes all but the one that reads the grids.
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
        raw = np.float32(NERFACTO_RAW_GAIN) * own[k] + np.float32(NERFACTO_RAW_START)
        sigma = exp32(min(max(raw, np.float32(RAW_LOW)), np.float32(RAW_HIGH)))
        own[k] = sigma * (finish[k] - begin[k])
    total = _F0
    for k in range(count):
        total += own[k]
        if total > np.float32(NERFACTO_CUTOFF_DEPTH):
            return np.int64(k + 1), finite
    return count, finite


@device_function
def bin_weights(depth, first, count, weight):
    """Volume rendering weights (3.21) of bins from their optical depths, both float32 from ``first`` on."""
    total, before = _F0, _F1
    for k in range(first, first + count):
        total += depth[k]
        after = exp32(-total)
        weight[k] = before - after
        before = after


@device_function
def allocate_samples(weight, first, count, samples, even, shift, group, share):
    """Inverse-CDF sampling: allocate a ray's samples to its bins.

    A bin that earns at least one sample is a group of its own, with share[g] samples (int64, as long as the
    number of bins). Bins that earn less are merged until they earn one, so that samples cover the whole ray:
    a part without a sample would be transparent. group: int32, receives from ``first`` on the group of each
    bin. Returns the number of groups; there are at most 2 samples + 1 samples.

    Weights are dilated (mip-NeRF's filter: the mean of the larger on either side), since a surface may lie
    just across the edge. even: share of samples allocated by the light that arrives, whatever the weights.
    shift: in [0, 1), rounds the number of samples up or down.
    """
    total, light, lights = _F0, _F1, _F0
    for k in range(first, first + count):
        total += _dilated(weight, k, first, first + count)
        lights += light + np.float32(NERFACTO_DARK_SHARE)
        light -= weight[k]
    evenly = even if total > np.float32(1e-12) else _F1
    norm = np.float32(samples) * (_F1 - evenly) / max(total, np.float32(1e-12))
    each = np.float32(samples) * evenly / max(lights, np.float32(NERFACTO_DARK_SHARE))
    light = _F1
    g, pending = np.int64(0), _F0
    for k in range(first, first + count):
        earned = norm * _dilated(weight, k, first, first + count) + each * (light + np.float32(NERFACTO_DARK_SHARE))
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


@device_function
def _dilated(weight, k, first, end):
    w = weight[k]
    left, right = weight[max(k - 1, first)], weight[min(k + 1, end - 1)]
    return _HALF * (max(left, w) + max(w, right))


@device_function
def place_samples(contracted, o, d, edges, group, first, count, share, shift, n, x, line):
    """Append a ray's samples, of equal length within a group, from column n on.

    shift: in [0, 1), position of a sample within its part. x: float32 (3, N), points in the unit cube. line:
    float32 (>= 3, N), distance, length and group. Returns the new number of samples, at most N.
    """
    (ox, oy, oz), (dx, dy, dz) = o, d
    k, limit = np.int64(0), x.shape[1]
    while k < count:
        g, a, length = group[first + k], k, _F0
        while k < count and group[first + k] == g:
            length += edges[1, k] - edges[0, k]
            k += 1
        # A group of several bins may have empty gaps between them: its sample lies in one of the bins.
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


@device_function
def bin_memory(size):
    """Memory for the bins of rays, ``size`` of them: see ``sample_ray``."""
    return (np.empty(size, np.int32), np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.int32))


@device_function
def bin_scratch(size):
    """Scratch of ``sample_ray`` for a ray of ``size`` bins."""
    return np.empty((2, size + 1), np.float32), np.empty((2, size), np.int32), np.empty(size, np.int64)


@device_function
def sample_ray(space, encoding, o, d, shift, within, bins, first, scratch, n, x, line):
    """Bins of the ray from o along d (three float32 each), from ``first`` on, and its samples from column n on.

    shift: of the raster of bins; within: of samples within their part; both in [0, 1).
    bins: (cell, depth, weight, group), see ``make_bins``, ``bin_weights`` and ``allocate_samples``.
    scratch: (edges, at, share), likewise. x, line: see ``place_samples``.
    Returns (bins kept, whether the proposal is finite, the new number of samples).
    """
    cell, depth, weight, group = bins
    (edges, at, share), sampling = scratch, encoding.sampling
    enter, leave = interval(space, o, d)
    if not leave > enter:
        return np.int64(0), True, n
    count, finite = make_bins(space, encoding, sampling.bins, o, d, enter, leave, shift, first, cell, depth, edges, at)
    bin_weights(depth, first, count, weight)
    allocate_samples(weight, first, count, sampling.samples, sampling.uniform_share, within, group, share)
    n = place_samples(space.contracted, o, d, edges, group, first, count, share, within, n, x, line)
    return count, finite, n


@implements(sample_rays, "sampling")
def _sample_rays(encoding, space, o, travel, active, count, x, line, first):
    """All samples of a ray at once, from the middle of the raster's places."""
    size, n, zero = encoding.sampling.bins, np.int64(0), np.int64(0)
    bins, scratch = bin_memory(size), bin_scratch(size)
    for k in range(count):
        if k > 0 and n + 2 * encoding.sampling.samples + 1 > x.shape[1] - PADDING:
            return k
        r = active[k]
        d = travel[r, 0], travel[r, 1], travel[r, 2]
        _, _, n = sample_ray(space, encoding, o, d, _HALF, _HALF, bins, zero, scratch, n, x, line)
        travel[r, 3], first[k + 1] = travel[r, 4], n
    return count
