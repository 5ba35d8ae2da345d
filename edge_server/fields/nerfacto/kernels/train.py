"""A training step with samples from a proposal: proposal, field, losses and gradients of chunks of rays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.radiance_model import query_backward, query_color, query_density
from edge_server.fields.common.kernels.rays import origin_of
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
from edge_server.fields.nerfacto.kernels.proposal import interlevel_loss, sample_ray

_F0 = np.float32(0.0)


class ProposalGradients(NamedTuple):
    """Gradients of the proposal and of the appearance embeddings, by chunk (C of them).

    cell: int32 (C, N), grad: float32 (C, N), of bins; the first counts[c], int64 (C,), are in use.
    d_embeddings: float32 (C, V, A), dLoss / dembedding of each view.
    """

    cell: NDArray[np.int32]
    grad: NDArray[np.float32]
    counts: NDArray[np.int64]
    d_embeddings: NDArray[np.float32]


class ProposalScratch(NamedTuple):
    """Memory of the W workers, for R rays.

    line: float32 (W, 4, CHUNK), distance, length, group and weight of each sample. depth, weight: float32,
    group: int32, all (W, R bins). first: int64 (W, R + 1), a ray's first bin.
    """

    line: NDArray[np.float32]
    depth: NDArray[np.float32]
    weight: NDArray[np.float32]
    group: NDArray[np.int32]
    first: NDArray[np.int64]


@part
def add_appearance(out, row, embedding, a, b):
    """Add the effect of an appearance embedding to the raw colors of samples a to b, rows 1 to 3 of out.

    Each number of the embedding weighs three outputs of the network, from ``row`` on, as harmonics weigh the
    colors of directions: density cannot depend on it, and rendering at 0 costs nothing.
    """
    for k in range(embedding.size):
        for c in range(3):
            base, share = out[1 + c, a:b], out[row + 3 * k + c, a:b]
            for s in range(base.size):
                base[s] += embedding[k] * share[s]


@part
def add_appearance_backward(out, d_out, row, embedding, a, b, d_embedding):
    """Backward of ``add_appearance``: writes rows ``row`` on of d_out and adds to d_embedding."""
    for k in range(embedding.size):
        total = _F0
        for c in range(3):
            base, share, d = d_out[1 + c, a:b], out[row + 3 * k + c, a:b], d_out[row + 3 * k + c, a:b]
            for s in range(base.size):
                total += base[s] * share[s]
                d[s] = embedding[k] * base[s]
        d_embedding[k] += total


@part
def compact_columns(rows, a, b, to):
    """Move columns a to b of every row to column ``to`` <= a."""
    for k in range(rows.shape[0]):
        row = rows[k]
        for s in range(b - a):
            row[to + s] = row[a + s]


@part
def sample_chunk(
    views, ray_sampling, sampling, space, encoding, net, chunk, x, acts, ray_first, ray, line, bins, bin_first
):
    """Fill a chunk with rays, their bins (see ``sample_ray``), their samples and the result of ``query_density``.

    Hidden samples are removed, and further rays fill their place. Returns (rays, samples, rays whose
    proposal is not finite).
    """
    dts, out = line[1], acts[acts.shape[0] - net.widths[-1] :]
    limit = min(ray_sampling.chunk_rays, ray.shape[0])
    edges, share = np.empty((2, sampling.bins + 1), np.float32), np.empty(sampling.bins, np.int64)
    scratch = edges, np.empty((2, sampling.bins), np.int32), share
    n, rays = np.int64(0), np.int64(0)
    broken = 0
    ray_first[0] = bin_first[0] = 0
    while rays < limit and CHUNK - n > CHUNK // 8:
        end, drawn = n, rays
        while drawn < limit and end + 2 * sampling.samples + 1 <= CHUNK:
            index = chunk * CHUNK_RAYS + drawn
            o = origin_of(views, draw_ray(views, ray_sampling, index, ray[drawn]))
            d = ray[drawn, 0], ray[drawn, 1], ray[drawn, 2]
            shift = uniform(ray_sampling.key, np.uint64(index) * np.uint64(8) + np.uint64(6))
            within = uniform(ray_sampling.key, np.uint64(index) * np.uint64(8) + np.uint64(7))
            first = bin_first[drawn]
            count, finite, end = sample_ray(
                space, encoding, sampling, o, d, shift, within, bins, first, scratch, end, x, line
            )
            broken += 0 if finite else 1
            drawn += 1
            ray_first[drawn], bin_first[drawn] = end, first + count
        if drawn == rays:
            break
        query_density(encoding, ray_sampling.levels, net, x, n, end, acts)
        activate_density(out, n, end)
        begin = n
        for r in range(rays, drawn):
            stop = ray_first[r + 1]
            kept = samples_until_opaque(out, dts, begin, stop)
            if n < begin:
                compact_columns(acts, begin, begin + kept, n)
                compact_columns(x, begin, begin + kept, n)
                compact_columns(line[:3], begin, begin + kept, n)
            n += kept
            ray_first[r + 1] = n
            begin = stop
        rays = drawn
    return rays, n, broken


@kernel
def train_with_proposal(
    counter,
    worker,
    views,
    ray_sampling,
    sampling,
    space,
    encoding,
    net,
    embeddings,
    weights,
    batch,
    bins,
    scratch,
    extra,
):
    """Forward and backward of a step; a task is a chunk. Scatter kernels then add up the gradients of the
    encoding and of the proposal. embeddings: float32 (V, A), one a view; A = 0: none. extra: proposal's scratch."""
    acts, d_acts = scratch.acts[worker], scratch.d_acts[worker]
    line, depth = extra.line[worker], extra.depth[worker]
    weight, group = extra.weight[worker], extra.group[worker]
    ts, dts, group_of, w = line[0], line[1], line[2], line[3]
    bin_first = extra.first[worker]
    ray_first, ray = scratch.ray_first[worker], scratch.ray[worker]
    outputs, row = net.widths[-1], 1 + 3 * ray_sampling.harmonics
    out, d_out = acts[acts.shape[0] - outputs :], d_acts[acts.shape[0] - outputs :]
    slope = np.empty((2, sampling.bins), np.float32)
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= batch.samples.size:
            return
        x, cell, grad = batch.x[chunk], bins.cell[chunk], bins.grad[chunk]
        bins.d_embeddings[chunk] = _F0
        bins_of = cell, depth, weight, group
        rays, n, broken = sample_chunk(
            views,
            ray_sampling,
            sampling,
            space,
            encoding,
            net,
            chunk,
            x,
            acts,
            ray_first,
            ray,
            line,
            bins_of,
            bin_first,
        )
        query_color(encoding, ray_sampling.levels, net, x, np.int64(0), n, acts)
        for r in range(rays):
            a, b = ray_first[r], ray_first[r + 1]
            if ray_sampling.harmonics > 1:
                add_harmonics(out, ray_sampling.harmonics, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
            if embeddings.shape[1] > 0:
                add_appearance(out, row, embeddings[np.int64(ray[r, 9])], a, b)
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
            interlevel_loss(encoding, cell, depth, weight, group, p, q - p, w, group_of, a, b, sampling, slope, grad)
            if batch.exposure.shape[1] > 0:
                add_exposure_sums(out, w, dts, a, b, ray[r], batch.exposure[chunk])
            if ray_sampling.harmonics > 1:
                add_harmonics_backward(d_out, ray_sampling.harmonics, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
            if embeddings.shape[1] > 0:
                view = np.int64(ray[r, 9])
                add_appearance_backward(out, d_out, row, embeddings[view], a, b, bins.d_embeddings[chunk, view])
        batch.d_params[chunk] = _F0
        query_backward(encoding, net, acts, d_acts, n, batch.d_params[chunk], batch.d_features[chunk])
        batch.columns[chunk], batch.samples[chunk], batch.rays[chunk] = n, n, rays
        batch.dropped[chunk], batch.loss[chunk] = dropped, loss
        bins.counts[chunk] = bin_first[rays]
