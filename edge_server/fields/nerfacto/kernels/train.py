"""``train`` with samples from a proposal: chunks of rays through proposal, field, losses and back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.radiance_model import query_backward, query_color, query_density
from edge_server.fields.common.kernels.rays import interval
from edge_server.fields.common.kernels.simd import fetch_add, uniform
from edge_server.fields.common.kernels.train import CHUNK, CHUNK_RAYS, add_exposure_sums, draw_ray
from edge_server.fields.common.kernels.volume_rendering import (
    activate_color,
    activate_density,
    add_harmonics,
    add_harmonics_backward,
    ray_loss,
    samples_until_opaque,
)
from edge_server.fields.nerfacto.kernels.proposal import deal, interlevel, place, propose, weigh

_F0, _HALF = np.float32(0.0), np.float32(0.5)


class Bins(NamedTuple):
    """What the chunks of a step leave behind for the proposal and the appearances, C of them.

    cell: int32 (C, N), grad: float32 (C, N), the first counts[c] in use: int64 (C,). looks: float32
    (C, V, A), dLoss / dembedding of each view.
    """

    cell: NDArray[np.int32]
    grad: NDArray[np.float32]
    counts: NDArray[np.int64]
    looks: NDArray[np.float32]


class BinScratch(NamedTuple):
    """Memory of each worker, W of them, R rays. line: float32 (W, 4, CHUNK): distance, length, group and
    weight of each sample. depth, weight: float32, group: int32 (W, R bins). first: int64 (W, R + 1), a
    ray's first bin."""

    line: NDArray[np.float32]
    depth: NDArray[np.float32]
    weight: NDArray[np.float32]
    group: NDArray[np.int32]
    first: NDArray[np.int64]


@part
def add_looks(out, row, look, a, b):
    """Add an appearance's share to the raw colours of samples a to b: rows 1 to 3 of out.

    An embedding mixes what the network says from ``row`` on, three rows for each of its numbers, as
    harmonics mix the colours of directions: density cannot depend on it, and zeros cost no rendering.
    """
    for k in range(look.size):
        for c in range(3):
            base, share = out[1 + c, a:b], out[row + 3 * k + c, a:b]
            for s in range(base.size):
                base[s] += look[k] * share[s]


@part
def spread_looks(out, d_out, row, look, a, b, d_look):
    """The gradient of ``add_looks``: rows ``row`` on of d_out, and d_look, added to."""
    for k in range(look.size):
        total = _F0
        for c in range(3):
            base, share, d = d_out[1 + c, a:b], out[row + 3 * k + c, a:b], d_out[row + 3 * k + c, a:b]
            for s in range(base.size):
                total += base[s] * share[s]
                d[s] = look[k] * base[s]
        d_look[k] += total


@part
def keep(rows, a, b, to):
    """Move columns a to b of every row to ``to`` <= a."""
    for k in range(rows.shape[0]):
        row = rows[k]
        for s in range(b - a):
            row[to + s] = row[a + s]


@part
def fill_proposed(views, recipe, plan, space, encoding, net, chunk, x, acts, ray_first, ray, line, cell,
                  depth, weight, group, bin_first):  # fmt: skip
    """Fill a chunk with rays, their bins, their samples and what ``query_density`` says of them. Samples that
    cannot be seen are left out, and their room is filled again.
    Returns (rays, samples, rays whose proposal is not finite)."""
    dts, out = line[1], acts[acts.shape[0] - net.widths[-1] :]
    limit = min(recipe.chunk_rays, ray.shape[0])
    edges, share = np.empty((2, plan.bins + 1), np.float32), np.empty(plan.bins, np.int64)
    at = np.empty((2, plan.bins), np.int32)
    n, rays, room, none = np.int64(0), np.int64(0), np.int64(CHUNK), np.int64(0)
    broken = 0
    ray_first[0] = bin_first[0] = 0
    while rays < limit and CHUNK - n > CHUNK // 8:
        end, drawn = n, rays
        while drawn < limit and end + 2 * plan.samples + 1 <= CHUNK:
            index = chunk * CHUNK_RAYS + drawn
            view = draw_ray(views, recipe, index, ray[drawn])
            ray[drawn, 9] = np.float32(view)
            o = views.origin[view]
            ox, oy, oz = np.float32(o[0]), np.float32(o[1]), np.float32(o[2])
            dx, dy, dz = ray[drawn, 0], ray[drawn, 1], ray[drawn, 2]
            enter, leave = interval(space, ox, oy, oz, dx, dy, dz)
            count, first = none, bin_first[drawn]
            if leave > enter:
                shift = uniform(recipe.key, np.uint64(index) * np.uint64(8) + np.uint64(6))
                within = uniform(recipe.key, np.uint64(index) * np.uint64(8) + np.uint64(7))
                count, finite = propose(
                    space, encoding, plan.bins, ox, oy, oz, dx, dy, dz, enter, leave, shift, first, cell,
                    depth, edges, at,
                )  # fmt: skip
                broken += 0 if finite else 1
                weigh(depth, first, count, weight)
                deal(weight, first, count, plan.samples, plan.even, within, group, share)
                end = place(
                    space.contracted, ox, oy, oz, dx, dy, dz, edges, group, first, count, share, within, end,
                    room, x, line,
                )  # fmt: skip
            drawn += 1
            ray_first[drawn], bin_first[drawn] = end, first + count
        if drawn == rays:
            break
        query_density(encoding, recipe.levels, net, x, n, end, acts)
        activate_density(out, n, end)
        begin = n
        for r in range(rays, drawn):
            stop = ray_first[r + 1]
            kept = samples_until_opaque(out, dts, begin, stop)
            if n < begin:
                keep(acts, begin, begin + kept, n)
                keep(x, begin, begin + kept, n)
                keep(line[:3], begin, begin + kept, n)
            n += kept
            ray_first[r + 1] = n
            begin = stop
        rays = drawn
    return rays, n, broken


@kernel
def train_proposed(counter, worker, views, recipe, plan, space, encoding, net, looks, weights, batch, bins,
                   scratch, bin_scratch):  # fmt: skip
    """Tasks are chunks: everything but the gradients of the encoding and of the proposal's cells, which
    their scatter kernels add up. looks: float32 (V, A), an embedding a view; A = 0: none."""
    acts, d_acts = scratch.acts[worker], scratch.d_acts[worker]
    line, depth, weight = bin_scratch.line[worker], bin_scratch.depth[worker], bin_scratch.weight[worker]
    group = bin_scratch.group[worker]
    ts, dts, group_of, w = line[0], line[1], line[2], line[3]
    bin_first = bin_scratch.first[worker]
    ray_first, ray = scratch.ray_first[worker], scratch.ray[worker]
    outputs, row = net.widths[-1], 1 + 3 * recipe.harmonics
    out, d_out = acts[acts.shape[0] - outputs :], d_acts[acts.shape[0] - outputs :]
    slope = np.empty((2, plan.bins), np.float32)
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= batch.samples.size:
            return
        x, cell, grad = batch.x[chunk], bins.cell[chunk], bins.grad[chunk]
        bins.looks[chunk] = _F0
        rays, n, broken = fill_proposed(
            views, recipe, plan, space, encoding, net, chunk, x, acts, ray_first, ray, line, cell, depth,
            weight, group, bin_first,
        )  # fmt: skip
        query_color(encoding, recipe.levels, net, x, np.int64(0), n, acts)
        for r in range(rays):
            a, b = ray_first[r], ray_first[r + 1]
            if recipe.harmonics > 1:
                add_harmonics(out, recipe.harmonics, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
            if looks.shape[1] > 0:
                add_looks(out, row, looks[np.int64(ray[r, 9])], a, b)
        activate_color(out, np.int64(0), n)
        d_out[4:, :n] = _F0
        loss, dropped = 0.0, broken
        for r in range(rays):
            a, b, p, q = ray_first[r], ray_first[r + 1], bin_first[r], bin_first[r + 1]
            guide = ray[r, 11] if views.guide.size > 0 else _F0
            error = ray_loss(out, d_out, ts, dts, w, a, b, ray[r, 3:6], ray[r, 6:9], guide, weights)
            if error < _F0:
                # Nothing of this ray may reach the others' sums: 0 times NaN is NaN.
                dropped += 1
                acts[:, a:b] = _F0
                grad[p:q] = _F0
                continue
            if views.weight.size > 0:
                error *= ray[r, 10]
                for k in range(4):  # loops: slices compile for seconds
                    for s in range(a, b):
                        d_out[k, s] *= ray[r, 10]
            loss += error
            interlevel(encoding, cell, depth, weight, group, p, q - p, w, group_of, a, b, plan, slope,
                       grad)  # fmt: skip
            if batch.exposure.shape[1] > 0:
                add_exposure_sums(out, w, dts, a, b, ray[r], batch.exposure[chunk])
            if recipe.harmonics > 1:
                add_harmonics_backward(d_out, recipe.harmonics, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
            if looks.shape[1] > 0:
                view = np.int64(ray[r, 9])
                spread_looks(out, d_out, row, looks[view], a, b, bins.looks[chunk, view])
        batch.d_params[chunk] = _F0
        query_backward(encoding, net, acts, d_acts, n, batch.d_params[chunk], batch.d_features[chunk])
        batch.columns[chunk], batch.samples[chunk], batch.rays[chunk] = n, n, rays
        batch.dropped[chunk], batch.loss[chunk] = dropped, loss
        bins.counts[chunk] = bin_first[rays]
