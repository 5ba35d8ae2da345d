"""Training with samples from a proposal: which samples a chunk gets, the proposal's loss and its gradient."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.radiance_model import fill_chunk, implements, learn_sampling, query_density
from edge_server.fields.common.kernels.rays import origin_of
from edge_server.fields.common.kernels.simd import exp32, fetch_add, uniform
from edge_server.fields.common.kernels.train import AT, CHUNK, CHUNK_RAYS, LEAVE, draw_ray
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW, activate_density, samples_until_opaque
from edge_server.fields.field_constants import NERFACTO_RAW_GAIN, NERFACTO_RAW_START, NERFACTO_WEIGHT_FLOOR
from edge_server.fields.nerfacto.kernels.proposal import bin_scratch, proposal_cells_of, sample_ray

SCATTER_TASKS = 8  # tasks of the kernel that adds up the gradient of the grid

_F0, _F1 = np.float32(0.0), np.float32(1.0)


class ProposalBins(NamedTuple):
    """The bins of a step's rays, by chunk (C of them) and by worker (W), for R rays.

    cell: int32 (C, N), grad: float32 (C, N), of bins; the first counts[c], int64 (C,), are in use.
    depth, weight: float32, group: int32, all (W, R bins). first: int64 (W, R + 1), a ray's first bin.
    slope: float32 (W, 2, bins), scratch of one ray.
    """

    cell: NDArray[np.int32]
    grad: NDArray[np.float32]
    counts: NDArray[np.int64]
    depth: NDArray[np.float32]
    weight: NDArray[np.float32]
    group: NDArray[np.int32]
    first: NDArray[np.int64]
    slope: NDArray[np.float32]


@device_function
def compact_columns(rows, a, b, to):
    """Move columns a to b of every row to column ``to`` <= a."""
    for k in range(rows.shape[0]):
        row = rows[k]
        for s in range(b - a):
            row[to + s] = row[a + s]


@implements(fill_chunk, "sampling")
def _sample_chunk(encoding, views, ray_sampling, space, net, chunk, worker, x, line, acts, ray, travel, span, bins):
    """Hidden samples are removed, and further rays fill their place."""
    dts, out = line[1], acts[acts.shape[0] - net.widths[-1] :]
    limit, most = min(ray_sampling.chunk_rays, ray.shape[0]), 2 * encoding.sampling.samples + 1
    scratch, bin_first = bin_scratch(encoding.sampling.bins), bins.first[worker]
    memory = bins.cell[chunk], bins.depth[worker], bins.weight[worker], bins.group[worker]
    n, rays = np.int64(0), np.int64(0)
    broken = 0
    bin_first[0] = 0
    while rays < limit and CHUNK - n > CHUNK // 8:
        end, drawn = n, rays
        while drawn < limit and end + most <= CHUNK:
            index = chunk * CHUNK_RAYS + drawn
            o = origin_of(views, draw_ray(views, ray_sampling, index, ray[drawn]))
            d = ray[drawn, 0], ray[drawn, 1], ray[drawn, 2]
            shift = uniform(ray_sampling.key, np.uint64(index) * np.uint64(8) + np.uint64(6))
            within = uniform(ray_sampling.key, np.uint64(index) * np.uint64(8) + np.uint64(7))
            first = bin_first[drawn]
            count, finite, end = sample_ray(space, encoding, o, d, shift, within, memory, first, scratch, end, x, line)
            broken += 0 if finite else 1
            span[drawn, 0], span[drawn, 3] = drawn, end
            travel[drawn, AT] = travel[drawn, LEAVE] = _F0  # it has ended
            drawn += 1
            bin_first[drawn] = first + count
        if drawn == rays:
            break
        query_density(encoding, ray_sampling.levels, net, x, n, end, acts)
        activate_density(out, n, end)
        begin = n
        for r in range(rays, drawn):
            stop = span[r, 3]
            kept = samples_until_opaque(out, dts, begin, stop)
            if n < begin:
                compact_columns(acts, begin, begin + kept, n)
                compact_columns(x, begin, begin + kept, n)
                compact_columns(line, begin, begin + kept, n)
            span[r, 1] = n
            n += kept
            span[r, 2] = span[r, 3] = n
            begin = stop
        rays = drawn
    bins.counts[chunk] = bin_first[rays]
    return rays, n, rays, broken


@device_function
def interlevel_loss(encoding, cell, depth, weight, group, first, count, w, group_of, start, stop, slope, grad):
    """The proposal's loss on one ray (eq. 13) and its gradient: a group of bins must not weigh less than its
    samples.

    The loss is the sum over groups of max(0, W - bound)^2 / (W + NERFACTO_WEIGHT_FLOOR). W sums the weights w of the
    samples start to stop (in groups group_of), constants here; bound sums the weights of the bins.
    cell, depth, weight, group: of bins first to first + count. slope: float32 (2, bins), scratch.
    grad: float32, like depth, receives ``sampling.interlevel`` times dLoss / dcell, plus the gradient of
    sampling.decay / 2 times the squared excess of raw densities over NERFACTO_RAW_START: an upper bound never lowers
    what is too high, and behind an opaque bin no gradient tells that the surface has moved.
    Returns the loss.
    """
    raw_of, sampling = proposal_cells_of(encoding), encoding.sampling
    loss = _F0
    inside, bound = slope[0], slope[1]
    for k in range(count):
        inside[k] = bound[k] = _F0
    for s in range(start, stop):
        inside[np.int64(group_of[s])] += w[s]
    for k in range(first, first + count):
        bound[group[k]] += weight[k]
    for g in range(count):
        lack, norm = max(inside[g] - bound[g], _F0), inside[g] + np.float32(NERFACTO_WEIGHT_FLOOR)
        loss += lack * lack / norm
        inside[g] = np.float32(-2.0) * sampling.interlevel * lack / norm
    total, behind = _F0, _F0
    for k in range(first, first + count):
        total += depth[k]
    after = exp32(-total)  # transmittance behind the last bin
    for k in range(count - 1, -1, -1):
        d_w, own = inside[group[first + k]], weight[first + k]
        d_depth = d_w * after - behind
        behind += own * d_w
        after += own
        raw = np.float32(NERFACTO_RAW_GAIN) * raw_of[cell[first + k]] + np.float32(NERFACTO_RAW_START)
        free = raw > np.float32(RAW_LOW) and raw < np.float32(RAW_HIGH)
        pull = sampling.decay * max(raw - np.float32(NERFACTO_RAW_START), _F0)
        grad[first + k] = np.float32(NERFACTO_RAW_GAIN) * (pull + (d_depth * depth[first + k] if free else _F0))
    return loss


@implements(learn_sampling, "sampling")
def _learn_sampling(encoding, bins, chunk, worker, r, w, line, a, b, good):
    p, q, grad = bins.first[worker, r], bins.first[worker, r + 1], bins.grad[chunk]
    if good:
        cell, depth, weight, group = bins.cell[chunk], bins.depth[worker], bins.weight[worker], bins.group[worker]
        slope = bins.slope[worker]
        interlevel_loss(encoding, cell, depth, weight, group, p, q - p, w, line[2], a, b, slope, grad)
    else:
        for k in range(p, q):
            grad[k] = _F0


@kernel
def scatter_proposal(counter, worker, encoding, cell, grad, counts, gradient, dirty):
    """Add the proposal's gradient to ``gradient`` (float32 like ``encoding.table``).

    A task is a range of cells, so nothing races. cell: int32 (chunks, N), grad: float32 (chunks, N), the
    first counts[c] are in use. dirty: bool (table rows / SEGMENT,), set where a segment received a gradient.
    """
    row = encoding.first[encoding.first.size - 1]
    flat, flags = gradient[row:].reshape(-1), dirty[row // SEGMENT :]
    width = SEGMENT * FEATURES
    size = (flags.size + SCATTER_TASKS - 1) // SCATTER_TASKS * width
    while True:
        task = fetch_add(counter, 1)
        if task >= SCATTER_TASKS:
            return
        low, high = task * size, (task + 1) * size
        for c in range(counts.size):
            for k in range(counts[c]):
                place, g = cell[c, k], grad[c, k]
                if low <= place < high and g != _F0:
                    flat[place] += g
                    flags[place // width] = True
