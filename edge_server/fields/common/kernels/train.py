"""One training step's first half: chunks of rays through sampling, field, rendering, loss and back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.radiance_model import query_back, query_color, query_density
from edge_server.fields.common.kernels.rays import interval, march, pixel_direction
from edge_server.fields.common.kernels.simd import fetch_add, uniform
from edge_server.fields.common.kernels.volume_rendering import (
    OPAQUE_DEPTH,
    activate_color,
    activate_density,
    add_harmonics,
    ray_loss,
    spread_harmonics,
)

CHUNK = 2048  # samples a chunk has room for; its activations stay in the second-level cache
CHUNK_RAYS = 512

DRAWN = 32  # rays drawn at a time
# Rounds of a chunk begin fresh rays up to so many samples, and with no more than an eighth of the room that
# is left of those: a ray that is begun needs more of it in the rounds to come, several times as much where
# the grid's densities are too high, and one that is not finished is lost: next to none where they are eight
# times too high; with a quarter, one in six.
FRESH, LEAST = CHUNK - CHUNK // 8, 32

# Optical depth of the grid's densities that a ray is followed by before it is asked whether it is opaque:
# less than that takes, so that few samples behind a surface are evaluated; but each asking costs a round.
ASKED = 5.0

_F0, _F1, _BYTE = np.float32(0.0), np.float32(1.0), np.float32(1.0 / 255.0)


class Batch(NamedTuple):
    """What the chunks of a step leave behind, C of them.

    x: float32 (C, 3, CHUNK), unit cube. d_features: float32 (C, rows, CHUNK). d_params: float32 (C, P).
    columns, samples, rays, dropped: int64 (C,): the first so many columns are in use, not all by samples of
    whole rays.
    loss: float64 (C,), squared error summed over rays and channels. exposure: float64 (C, V, 3, 5),
    see ``compare``; V = 0 where exposures are not asked for.
    """

    x: NDArray[np.float32]
    d_features: NDArray[np.float32]
    d_params: NDArray[np.float32]
    columns: NDArray[np.int64]
    samples: NDArray[np.int64]
    rays: NDArray[np.int64]
    dropped: NDArray[np.int64]
    loss: NDArray[np.float64]
    exposure: NDArray[np.float64]


class Scratch(NamedTuple):
    """Memory of each worker, W of them, R = CHUNK_RAYS.

    acts, d_acts: float32 (W, units, CHUNK) and line: float32 (W, 2, CHUNK), distance and length, have a
    sample a column, in the order in which they were found. laid: float32 (W, 11, CHUNK), ray after ray:
    density and colour, their gradient, distance, length and weight of each sample; column: int64 (W, CHUNK),
    where it was found, and behind the last of them the columns of what is not used. ray_first: int64
    (W, R + 1), of ``laid``. ray: float32 (W, R, 12): direction, target, background, view, weight, guide; the
    last two only where ``Views`` has them. way: float32 (W, R, 3): distance reached, distance of leaving, and
    optical depth so far. piece: int64 (W, CHUNK, 4): ray (-1: none) and first column of samples that were
    found together, where the seen ones end, and where they end.
    """

    acts: NDArray[np.float32]
    d_acts: NDArray[np.float32]
    line: NDArray[np.float32]
    laid: NDArray[np.float32]
    column: NDArray[np.int64]
    ray_first: NDArray[np.int64]
    ray: NDArray[np.float32]
    way: NDArray[np.float32]
    piece: NDArray[np.int64]


class Recipe(NamedTuple):
    """How rays are drawn. key: uint64, this step's random stream. chunk_rays: at most so many a chunk.
    levels: switched on. harmonics: 1, 4 or 9. changed_share: rays drawn from ``Views.changed``.
    background: float32 (3,); random_background: a new one for every ray instead."""

    key: np.uint64
    chunk_rays: int
    levels: int
    harmonics: int
    changed_share: np.float32
    background: NDArray[np.float32]
    random_background: bool


@part
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


@part
def draw(views, recipe, n, ray):
    """Choose the n-th ray of the step: fills ray (12,), returns its view's number."""
    key, k = recipe.key, np.uint64(n) * np.uint64(8)
    total = views.pixels.shape[0]
    # 53 bits, because float32 cannot count the pixels of a hundred pictures.
    choice = np.float64(uniform(key, k)) + np.float64(uniform(key, k + np.uint64(1))) * 5.9604644775390625e-08
    if views.changed.size > 0 and uniform(key, k + np.uint64(2)) < recipe.changed_share:
        pixel = views.changed[min(np.int64(choice * views.changed.size), views.changed.size - 1)]
    elif views.drawn.size > 0:
        pixel = views.drawn[min(np.int64(choice * views.drawn.size), views.drawn.size - 1)]
    else:
        pixel = min(np.int64(choice * total), total - 1)
    return take_pixel(views, recipe, pixel, n, ray)


@part
def take_pixel(views, recipe, pixel, n, ray):
    """Fill ray (12,), the step's n-th, from a pixel: direction, target, background, view, weight, guide (the
    last two only where ``Views`` has them). Returns the view's number."""
    key, k = recipe.key, np.uint64(n) * np.uint64(8)
    view = _view_of(views.first, pixel)
    local = pixel - views.first[view]
    width = views.size[view, 0]
    u, v = np.float64(local % width) + 0.5, np.float64(local // width) + 0.5
    ray[0], ray[1], ray[2] = pixel_direction(views.lens[view], views.rotation[view], u, v)
    alpha = np.float32(1.0)
    if views.pixels.shape[1] == 4:
        alpha = np.float32(views.pixels[pixel, 3]) * _BYTE
    for c in range(3):
        back = recipe.background[c]
        if recipe.random_background:
            back = uniform(key, k + np.uint64(3 + c))
        ray[6 + c] = back
        ray[3 + c] = np.float32(views.pixels[pixel, c]) * np.float32(1.0 / 255.0) * alpha + back * (
            _F1 - alpha
        )
    ray[9] = np.float32(view)
    if views.exposure.shape[0] > 0:
        for c in range(3):
            ray[3 + c] = views.exposure[view, c, 0] * ray[3 + c] + views.exposure[view, c, 1]
    if views.weight.size > 0:
        ray[10] = views.weight[pixel]
    if views.guide.size > 0:
        ray[11] = views.guide[pixel]
    return view


_AT, _LEAVE, _DEPTH = 0, 1, 2  # columns of ``Scratch.way``


@part
def begin_rays(views, recipe, space, chunk, first, end, ray, way):
    """Draw the chunk's rays first to end: fills ray and way (``Scratch``)."""
    for r in range(first, end):
        index = chunk * CHUNK_RAYS + r
        view = draw(views, recipe, index, ray[r])
        o = views.origin[view]
        enter, leave = interval(space, np.float32(o[0]), np.float32(o[1]), np.float32(o[2]),
                                ray[r, 0], ray[r, 1], ray[r, 2])  # fmt: skip
        enter += uniform(recipe.key, np.uint64(index) * np.uint64(8) + np.uint64(6)) * space.step
        way[r, _AT], way[r, _LEAVE], way[r, _DEPTH] = enter, leave, _F0


@part
def fill_chunk(views, recipe, space, encoding, net, chunk, x, line, acts, ray, way, piece):
    """Fill a chunk with rays, their samples and what ``query_density`` says of them.
    Returns (rays drawn, columns, pieces); of the rays, those whose way does not end are not to be used.

    What lies behind an opaque sample would cost room for a gradient of nothing. So rays are followed in
    rounds, by the occupancy grid's densities, until they are opaque, and their samples come in pieces. The
    chunk is filled with as many rays as it has room for: every step costs about the same.
    """
    ts, dts = line[0], line[1]
    sigma = acts[acts.shape[0] - net.widths[-1]]
    limit = min(recipe.chunk_rays, ray.shape[0])
    # The rays of one round: first those under way, then fresh ones; and where the samples of each end.
    turn, stops = np.empty(limit, np.int64), np.empty(limit, np.int64)
    # Typed, since numba would compile the callees once more for every literal.
    n, room = np.int64(0), np.int64(CHUNK)
    under_way = fresh = ready = pieces = 0
    while (under_way > 0 and n < room) or (fresh < limit and n < FRESH):
        end, marched = n, 0
        until = n + max((FRESH - n) // 8, LEAST) if n < FRESH else n
        while end < room and (marched < under_way or (fresh < limit and end < until)):
            if marched == under_way:
                if fresh == ready:
                    ready = min(ready + DRAWN, limit)
                    begin_rays(views, recipe, space, chunk, fresh, ready, ray, way)
                turn[marched] = fresh
                fresh += 1
                under_way += 1
            r = turn[marched]
            o = views.origin[np.int64(ray[r, 9])]
            end, way[r, _AT], _ = march(
                space, np.float32(o[0]), np.float32(o[1]), np.float32(o[2]), ray[r, 0], ray[r, 1], ray[r, 2],
                way[r, _AT], way[r, _LEAVE], x, ts, dts, end, room, np.float32(ASKED),
            )  # fmt: skip
            stops[marched] = end
            marched += 1
        query_density(encoding, recipe.levels, net, x, n, end, acts)
        activate_density(acts[acts.shape[0] - net.widths[-1] :], n, end)
        begin, left = n, 0
        for k in range(marched):
            r, stop, depth = turn[k], stops[k], way[turn[k], _DEPTH]
            last = begin
            while last < stop and depth <= np.float32(OPAQUE_DEPTH):
                depth += sigma[last] * dts[last]
                last += 1
            way[r, _DEPTH] = depth
            if depth > np.float32(OPAQUE_DEPTH):
                way[r, _AT] = way[r, _LEAVE]
            elif way[r, _AT] < way[r, _LEAVE]:
                turn[left] = r
                left += 1
            if stop > begin:
                piece[pieces, 0], piece[pieces, 1], piece[pieces, 2] = r, begin, last
                piece[pieces, 3] = stop
                pieces += 1
            begin = stop
        n, under_way = end, left  # those that were not followed had no room, and will have none
    return fresh, n, pieces


@part
def lay_out(drawn, pieces, piece, ray, way, column, ray_first):
    """Number the rays whose way has ended anew, and say which column each of their samples, ray after ray,
    stands in, and behind these the columns of what is not used; returns how many rays there are. Their rows
    of ``ray`` move up; pieces of the others get ray -1.
    """
    number, at = np.empty(drawn, np.int64), np.zeros(drawn, np.int64)
    for k in range(pieces):
        at[piece[k, 0]] += piece[k, 2] - piece[k, 1]
    rays, first = 0, 0
    for r in range(drawn):
        number[r] = -1
        if not way[r, _AT] < way[r, _LEAVE]:
            number[r], ray_first[rays] = rays, first
            at[r], first = first, first + at[r]
            if rays < r:
                for k in range(ray.shape[1]):
                    ray[rays, k] = ray[r, k]
            rays += 1
    ray_first[rays] = end = first
    for k in range(pieces):
        r, begin = piece[k, 0], piece[k, 1]
        piece[k, 0] = number[r]
        if number[r] >= 0:
            begin = piece[k, 2]
            for s in range(piece[k, 1], begin):
                column[at[r]] = s
                at[r] += 1
        for s in range(begin, piece[k, 3]):
            column[end] = s
            end += 1
    return rays


@part
def clear_columns(rows, column, first, end):
    """Set to zero what stands in the columns that ``column`` names from first to end."""
    for k in range(rows.shape[0]):
        for p in range(first, end):
            rows[k, column[p]] = _F0


@part
def gather(out, line, column, n, laid):
    """Density, colour, distance and length of n samples into the order of their rays."""
    for k in range(4):
        for s in range(n):
            laid[k, s] = out[k, column[s]]
    for k in range(2):
        for s in range(n):
            laid[8 + k, s] = line[k, column[s]]


@part
def spread_back(laid, column, n, d_out):
    """The gradients of n samples to the columns in which they were found."""
    for k in range(4):
        for s in range(n):
            d_out[k, column[s]] = laid[4 + k, s]


@part
def compare(out, w, dts, first, end, ray, sums):
    """Add one ray to what ``refinement.Exposures`` learns from: its number, target t, t^2, error e and e t
    per channel; sums: float64 (views, 3, 5). After ``ray_loss``."""
    depth, last = _F0, end
    for s in range(first, end):
        depth += out[0, s] * dts[s]
        if depth > np.float32(OPAQUE_DEPTH):
            last = s + 1
            break
    view = np.int64(ray[9])
    for c in range(3):
        color, left = _F0, _F1
        for s in range(first, last):
            color += w[s] * out[1 + c, s]
            left -= w[s]
        t = np.float64(ray[3 + c])
        e = np.float64(color + left * ray[6 + c]) - t
        sums[view, c, 0] += 1.0
        sums[view, c, 1] += t
        sums[view, c, 2] += t * t
        sums[view, c, 3] += e
        sums[view, c, 4] += e * t


@kernel
def train_chunks(counter, worker, views, recipe, space, encoding, net, weights, batch, scratch):
    """Tasks are chunks: everything but the encoding's own gradient, which its scatter kernel adds up."""
    acts, d_acts, line = scratch.acts[worker], scratch.d_acts[worker], scratch.line[worker]
    laid, column, piece = scratch.laid[worker], scratch.column[worker], scratch.piece[worker]
    ray_first, ray, way = scratch.ray_first[worker], scratch.ray[worker], scratch.way[worker]
    ts, dts, w = laid[8], laid[9], laid[10]
    outputs = net.widths[-1]
    out, d_out = acts[acts.shape[0] - outputs :], d_acts[acts.shape[0] - outputs :]
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= batch.samples.size:
            return
        x = batch.x[chunk]
        drawn, n, pieces = fill_chunk(
            views, recipe, space, encoding, net, chunk, x, line, acts, ray, way, piece
        )
        rays = lay_out(drawn, pieces, piece, ray, way, column, ray_first)
        used = ray_first[rays]
        query_color(encoding, recipe.levels, net, x, np.int64(0), n, acts)
        if recipe.harmonics > 1:
            for k in range(pieces):
                r, a, b = piece[k, 0], piece[k, 1], piece[k, 2]
                if r >= 0:
                    add_harmonics(out, recipe.harmonics, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
        activate_color(out, np.int64(0), n)
        gather(out, line, column, used, laid)
        # Nothing that is not used may reach the others' sums: 0 times NaN is NaN.
        clear_columns(acts, column, used, n)
        clear_columns(d_out, column, used, n)
        d_out[4:, :n] = _F0
        loss, dropped = 0.0, 0
        for r in range(rays):
            a, b = ray_first[r], ray_first[r + 1]
            guide = ray[r, 11] if views.guide.size > 0 else _F0
            error = ray_loss(
                laid[:4], laid[4:8], ts, dts, w, a, b, ray[r, 3:6], ray[r, 6:9], guide, weights
            )  # fmt: skip
            if error < _F0:
                dropped += 1
                clear_columns(acts, column, a, b)
            else:
                if views.weight.size > 0:
                    error *= ray[r, 10]
                    for k in range(4, 8):  # loops: slices compile for seconds
                        for s in range(a, b):
                            laid[k, s] *= ray[r, 10]
                loss += error
                if batch.exposure.shape[1] > 0:
                    compare(laid, w, dts, a, b, ray[r], batch.exposure[chunk])
        spread_back(laid, column, used, d_out)
        if recipe.harmonics > 1:
            for k in range(pieces):
                r, a, b = piece[k, 0], piece[k, 1], piece[k, 2]
                if r >= 0:
                    spread_harmonics(d_out, recipe.harmonics, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
        batch.d_params[chunk] = _F0
        query_back(encoding, net, acts, d_acts, n, batch.d_params[chunk], batch.d_features[chunk])
        batch.columns[chunk], batch.samples[chunk], batch.rays[chunk] = n, used, rays
        batch.dropped[chunk], batch.loss[chunk] = dropped, loss
