"""The first half of a training step: sample, query, render and differentiate chunks of rays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.mlp import PADDING
from edge_server.fields.common.kernels.radiance_model import (
    fill_chunk,
    implements,
    learn_sampling,
    query_backward,
    query_color,
    query_density,
)
from edge_server.fields.common.kernels.rays import interval, march, origin_of, pixel_direction
from edge_server.fields.common.kernels.simd import fetch_add, uniform
from edge_server.fields.common.kernels.volume_rendering import (
    activate_color,
    activate_density,
    add_harmonics,
    add_harmonics_backward,
    ray_loss,
)
from edge_server.fields.field_constants import ASKED_DEPTH, OPAQUE_DEPTH

CHUNK = 2048  # samples a chunk has room for; its activations stay in the second-level cache
ROW = CHUNK + PADDING  # of which CHUNK are used
CHUNK_RAYS = 512

DRAWN = 32  # rays drawn at a time
# A chunk begins new rays until it holds FRESH samples, and a round fills at most an eighth of what is left of
# these: a begun ray needs more room in later rounds, several times as much where the grid's densities are too
# high, and an unfinished ray is lost. Where densities are eight times too high, that loses next to no rays;
# rounds of a quarter would lose one in six.
FRESH, LEAST = CHUNK - CHUNK // 8, 32

_F0, _F1, _BYTE = np.float32(0.0), np.float32(1.0), np.float32(1.0 / 255.0)


class Batch(NamedTuple):
    """The results of a step's chunks, C of them.

    x: float32 (C, 3, ROW), unit cube. d_features: float32 (C, rows, ROW). d_params: float32 (C, P).
    columns: int64 (C,), how many columns are in use, not all of them by samples of whole rays.
    samples, rays, dropped: int64 (C,). loss: float64 (C,), squared error summed over rays and channels.
    d_embeddings: float32 (C, V, A), dLoss / dembedding of each view.
    """

    x: NDArray[np.float32]
    d_features: NDArray[np.float32]
    d_params: NDArray[np.float32]
    columns: NDArray[np.int64]
    samples: NDArray[np.int64]
    rays: NDArray[np.int64]
    dropped: NDArray[np.int64]
    loss: NDArray[np.float64]
    d_embeddings: NDArray[np.float32]


class Scratch(NamedTuple):
    """Memory of each worker, W of them; R = CHUNK_RAYS.

    A column of these is a sample, in the order in which samples were found:
    acts, d_acts: float32 (W, units, ROW). line: float32 (W, 3, ROW), distance, length, and a
        representation's own number.
    span: int64 (W, CHUNK, 4), samples of a ray that were found together: ray (-1: none), first column, end of
        those before it is opaque, end.

    A column of these is a sample, ray after ray:
    by_ray: float32 (W, 11, ROW), density and color, their gradient, distance, length, weight.
    column: int64 (W, CHUNK), where it was found; behind the last one, the columns that are not used.
    ray_first: int64 (W, R + 1), the first sample of each ray.

    ray: float32 (W, R, 12), direction, target, background, view, weight, guide; the last two only if
        ``Views`` has them.
    travel: float32 (W, R, 3), distance reached, distance of leaving, optical depth so far.
    """

    acts: NDArray[np.float32]
    d_acts: NDArray[np.float32]
    line: NDArray[np.float32]
    by_ray: NDArray[np.float32]
    column: NDArray[np.int64]
    ray_first: NDArray[np.int64]
    ray: NDArray[np.float32]
    travel: NDArray[np.float32]
    span: NDArray[np.int64]


class RaySampling(NamedTuple):
    """How a step samples rays.

    key: uint64, its random stream. chunk_rays: largest number of rays of a chunk.
    levels: number of levels that are switched on. sh_degree: of colors, 0 or 1.
    changed_share: share of the rays that are drawn from ``Views.changed``.
    background: float32 (3,).
    embeddings: float32 (V, A), appearance of each view; A = 0: none.
    """

    key: np.uint64
    chunk_rays: int
    levels: int
    sh_degree: int
    changed_share: np.float32
    background: NDArray[np.float32]
    embeddings: NDArray[np.float32]


@device_function
def _view_of(first, pixel):
    """The last k with first[k] <= pixel. (np.searchsorted would compile seconds of string handling.)"""
    low, high = 0, first.size - 1
    while high - low > 1:
        middle = (low + high) >> 1
        if first[middle] <= pixel:
            low = middle
        else:
            high = middle
    return low


@device_function
def draw_ray(views, ray_sampling, n, ray):
    """Draw the n-th ray of the step: fills ray (12,), returns its view's number."""
    key, k = ray_sampling.key, np.uint64(n) * np.uint64(8)
    total = views.pixels.shape[0]
    # 53 bits, because float32 cannot count the pixels of a hundred pictures.
    choice = np.float64(uniform(key, k)) + np.float64(uniform(key, k + np.uint64(1))) * 5.9604644775390625e-08
    if views.changed.size > 0 and uniform(key, k + np.uint64(2)) < ray_sampling.changed_share:
        pixel = views.changed[min(np.int64(choice * views.changed.size), views.changed.size - 1)]
    elif views.drawn.size > 0:
        pixel = views.drawn[min(np.int64(choice * views.drawn.size), views.drawn.size - 1)]
    else:
        pixel = min(np.int64(choice * total), total - 1)
    return take_pixel(views, ray_sampling.background, pixel, ray)


@device_function
def take_pixel(views, background, pixel, ray):
    """Fill ray (12,) from a pixel (see ``Scratch``). Returns the view's number."""
    view = _view_of(views.first, pixel)
    local = pixel - views.first[view]
    width = views.size[view, 0]
    u, v = np.float64(local % width) + 0.5, np.float64(local // width) + 0.5
    ray[0], ray[1], ray[2] = pixel_direction(views.lens[view], views.rotation[view], u, v)
    alpha = np.float32(1.0)
    if views.pixels.shape[1] == 4:
        alpha = np.float32(views.pixels[pixel, 3]) * _BYTE
    for c in range(3):
        back = background[c]
        ray[6 + c] = back
        ray[3 + c] = np.float32(views.pixels[pixel, c]) * np.float32(1.0 / 255.0) * alpha + back * (_F1 - alpha)
    ray[9] = np.float32(view)
    if views.weight.size > 0:
        ray[10] = views.weight[pixel]
    if views.guide.size > 0:
        ray[11] = views.guide[pixel]
    return view


AT, LEAVE, _DEPTH = 0, 1, 2  # columns of ``Scratch.travel``


@device_function
def begin_rays(views, ray_sampling, space, chunk, first, end, ray, travel):
    """Draw the chunk's rays first to end: fills ray and travel (``Scratch``)."""
    for r in range(first, end):
        index = chunk * CHUNK_RAYS + r
        view = draw_ray(views, ray_sampling, index, ray[r])
        enter, leave = interval(space, origin_of(views, view), (ray[r, 0], ray[r, 1], ray[r, 2]))
        enter += uniform(ray_sampling.key, np.uint64(index) * np.uint64(8) + np.uint64(6)) * space.step
        travel[r, AT], travel[r, LEAVE], travel[r, _DEPTH] = enter, leave, _F0


@implements(fill_chunk, "sampling", there=False)
def _march_chunk(encoding, views, ray_sampling, space, net, chunk, worker, x, line, acts, ray, travel, span, bins):
    """See there.

    Samples behind an opaque one would take room for a gradient of zero. So rays are followed in rounds, by
    the occupancy grid's densities, until they are opaque, and their samples come in spans. The chunk gets as
    many rays as it has room for: every step costs about the same.
    """
    ts, dts = line[0], line[1]
    sigma = acts[acts.shape[0] - net.widths[-1]]
    limit = min(ray_sampling.chunk_rays, ray.shape[0])
    # The rays of one round: first those under travel, then fresh ones; and where the samples of each end.
    active, stops = np.empty(limit, np.int64), np.empty(limit, np.int64)
    # Typed, since numba would compile the callees once more for every literal.
    n, room = np.int64(0), np.int64(CHUNK)
    under_way = fresh = ready = spans = 0
    while (under_way > 0 and n < room) or (fresh < limit and n < FRESH):
        end, marched = n, 0
        until = n + max((FRESH - n) // 8, LEAST) if n < FRESH else n
        while end < room and (marched < under_way or (fresh < limit and end < until)):
            if marched == under_way:
                if fresh == ready:
                    ready = min(ready + DRAWN, limit)
                    begin_rays(views, ray_sampling, space, chunk, fresh, ready, ray, travel)
                active[marched] = fresh
                fresh += 1
                under_way += 1
            r = active[marched]
            o, d = origin_of(views, np.int64(ray[r, 9])), (ray[r, 0], ray[r, 1], ray[r, 2])
            at, leave = travel[r, AT], travel[r, LEAVE]
            end, travel[r, AT], _ = march(space, o, d, at, leave, x, ts, dts, end, room, np.float32(ASKED_DEPTH))
            stops[marched] = end
            marched += 1
        query_density(encoding, ray_sampling.levels, net, x, n, end, acts)
        activate_density(acts[acts.shape[0] - net.widths[-1] :], n, end)
        begin, left = n, 0
        for k in range(marched):
            r, stop, depth = active[k], stops[k], travel[active[k], _DEPTH]
            last = begin
            while last < stop and depth <= np.float32(OPAQUE_DEPTH):
                depth += sigma[last] * dts[last]
                last += 1
            travel[r, _DEPTH] = depth
            if depth > np.float32(OPAQUE_DEPTH):
                travel[r, AT] = travel[r, LEAVE]
            elif travel[r, AT] < travel[r, LEAVE]:
                active[left] = r
                left += 1
            if stop > begin:
                span[spans, 0], span[spans, 1], span[spans, 2] = r, begin, last
                span[spans, 3] = stop
                spans += 1
            begin = stop
        n, under_way = end, left  # those that were not followed had no room, and will have none
    return fresh, n, spans, 0


@implements(learn_sampling, "sampling", there=False)
def _learn_sampling(encoding, bins, chunk, worker, r, w, line, a, b, good):
    """Nothing to learn."""


@device_function
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


@device_function
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


@device_function
def sort_by_ray(drawn, spans, span, ray, travel, column, ray_first):
    """Number the rays that have ended anew and sort their samples by ray (``column``, ``ray_first``).
    Returns how many rays there are. Their rows of ``ray`` move up; spans of the others get ray -1.
    """
    number, at = np.empty(drawn, np.int64), np.zeros(drawn, np.int64)
    for k in range(spans):
        at[span[k, 0]] += span[k, 2] - span[k, 1]
    rays, first = 0, 0
    for r in range(drawn):
        number[r] = -1
        if not travel[r, AT] < travel[r, LEAVE]:
            number[r], ray_first[rays] = rays, first
            at[r], first = first, first + at[r]
            if rays < r:
                for k in range(ray.shape[1]):
                    ray[rays, k] = ray[r, k]
            rays += 1
    ray_first[rays] = end = first
    for k in range(spans):
        r, begin = span[k, 0], span[k, 1]
        span[k, 0] = number[r]
        if number[r] >= 0:
            begin = span[k, 2]
            for s in range(span[k, 1], begin):
                column[at[r]] = s
                at[r] += 1
        for s in range(begin, span[k, 3]):
            column[end] = s
            end += 1
    return rays


@device_function
def clear_columns(rows, column, first, end):
    """Set to zero the columns ``column[first:end]`` of ``rows``."""
    for k in range(rows.shape[0]):
        for p in range(first, end):
            rows[k, column[p]] = _F0


@device_function
def gather_by_ray(out, line, column, n, by_ray):
    """Copy density, color, distance and length of n samples into the order of their rays."""
    for k in range(4):
        for s in range(n):
            by_ray[k, s] = out[k, column[s]]
    for k in range(2):
        for s in range(n):
            by_ray[8 + k, s] = line[k, column[s]]


@device_function
def scatter_to_columns(by_ray, column, n, d_out):
    """Copy the gradients of n samples back to the columns in which they were found."""
    for k in range(4):
        for s in range(n):
            d_out[k, column[s]] = by_ray[4 + k, s]


@kernel
def train_chunks(counter, worker, views, ray_sampling, space, encoding, net, weights, batch, scratch, bins):
    """Tasks are chunks. Does everything but the encoding's own gradient, which its scatter kernel adds up. bins: see
    ``fill_chunk``."""
    acts, d_acts, line = scratch.acts[worker], scratch.d_acts[worker], scratch.line[worker]
    by_ray, column, span = scratch.by_ray[worker], scratch.column[worker], scratch.span[worker]
    ray_first, ray, travel = scratch.ray_first[worker], scratch.ray[worker], scratch.travel[worker]
    ts, dts, w = by_ray[8], by_ray[9], by_ray[10]
    outputs, sh_degree, embeddings = net.widths[-1], ray_sampling.sh_degree, ray_sampling.embeddings
    out, d_out = acts[acts.shape[0] - outputs :], d_acts[acts.shape[0] - outputs :]
    by_direction = sh_degree > 0 or embeddings.shape[1] > 0
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= batch.samples.size:
            return
        x = batch.x[chunk]
        drawn, n, spans, dropped = fill_chunk(
            encoding, views, ray_sampling, space, net, chunk, worker, x, line, acts, ray, travel, span, bins
        )
        rays = sort_by_ray(drawn, spans, span, ray, travel, column, ray_first)
        used = ray_first[rays]
        query_color(encoding, ray_sampling.levels, net, x, np.int64(0), n, acts)
        if by_direction:
            for k in range(spans):
                r, a, b = span[k, 0], span[k, 1], span[k, 2]
                if r >= 0:
                    add_harmonics(out, sh_degree, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
                    add_appearance(out, 4 + 9 * sh_degree, embeddings[np.int64(ray[r, 9])], a, b)
        activate_color(out, np.int64(0), n)
        gather_by_ray(out, line, column, used, by_ray)
        # Clear unused columns before sums over columns: 0 times NaN is NaN.
        clear_columns(acts, column, used, n)
        clear_columns(d_out, column, used, n)
        d_out[4:, :n] = _F0
        loss = 0.0
        for r in range(rays):
            a, b = ray_first[r], ray_first[r + 1]
            guide = ray[r, 11] if views.guide.size > 0 else _F0
            error = ray_loss(by_ray[:4], by_ray[4:8], ts, dts, w, a, b, ray[r, 3:6], ray[r, 6:9], guide, weights)
            good = error >= _F0
            learn_sampling(encoding, bins, chunk, worker, r, w, line, a, b, good)
            if good:
                if views.weight.size > 0:
                    error *= ray[r, 10]
                    for k in range(4, 8):  # loops: slices compile for seconds
                        for s in range(a, b):
                            by_ray[k, s] *= ray[r, 10]
                loss += error
            else:
                dropped += 1
                clear_columns(acts, column, a, b)
        scatter_to_columns(by_ray, column, used, d_out)
        batch.d_embeddings[chunk] = _F0
        if by_direction:
            for k in range(spans):
                r, a, b = span[k, 0], span[k, 1], span[k, 2]
                if r >= 0:
                    add_harmonics_backward(d_out, sh_degree, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
                    v = np.int64(ray[r, 9])
                    d_embedding = batch.d_embeddings[chunk, v]
                    add_appearance_backward(out, d_out, 4 + 9 * sh_degree, embeddings[v], a, b, d_embedding)
        batch.d_params[chunk] = _F0
        query_backward(encoding, net, acts, d_acts, n, batch.d_params[chunk], batch.d_features[chunk])
        batch.columns[chunk], batch.samples[chunk], batch.rays[chunk] = n, used, rays
        batch.dropped[chunk], batch.loss[chunk] = dropped, loss
