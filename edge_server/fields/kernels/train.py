"""One training step's first half: chunks of rays through sampling, field, rendering, loss and back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.kernels.composite import (
    OPAQUE_DEPTH,
    activate_color,
    activate_density,
    add_harmonics,
    ray_loss,
    seen_samples,
    spread_harmonics,
)
from edge_server.fields.kernels.intrinsics import fetch_add, uniform
from edge_server.fields.kernels.jit import kernel, part
from edge_server.fields.kernels.model import query_back, query_color, query_density
from edge_server.fields.kernels.rays import NEVER, interval, march, pixel_direction

CHUNK = 2048  # samples a chunk has room for; its activations stay in the second-level cache
CHUNK_RAYS = 512

GUESS = 20.0  # optical depth of the grid's densities at which a ray is taken to be opaque: twice enough
# Where that was too little, so much more of it, up to a depth that no grid is wrong about. (To the ray's end
# at once: in a room, where two guesses of five are wrong, six times as many samples as are kept.)
AGAIN, SURE = np.float32(4.0), np.float32(1000.0)

_F0, _F1, _BYTE = np.float32(0.0), np.float32(1.0), np.float32(1.0 / 255.0)


class Batch(NamedTuple):
    """What the chunks of a step leave behind, C of them.

    x: float32 (C, 3, CHUNK), unit cube. d_features: float32 (C, rows, CHUNK). d_params: float32 (C, P).
    samples, rays, dropped: int64 (C,). loss: float64 (C,), squared error summed over rays and channels.
    exposure: float64 (C, V, 3, 5), see ``compare``; V = 0 where exposures are not asked for.
    """

    x: NDArray[np.float32]
    d_features: NDArray[np.float32]
    d_params: NDArray[np.float32]
    samples: NDArray[np.int64]
    rays: NDArray[np.int64]
    dropped: NDArray[np.int64]
    loss: NDArray[np.float64]
    exposure: NDArray[np.float64]


class Scratch(NamedTuple):
    """Memory of each worker, W of them, R = CHUNK_RAYS.

    acts, d_acts: float32 (W, units, CHUNK). line: float32 (W, 3, CHUNK): distance, length and weight of
    each sample. ray_first: int64 (W, R + 1). ray: float32 (W, R, 11): direction, target,
    background, view, weight; the last two only where ``Views`` has exposures and weights.
    """

    acts: NDArray[np.float32]
    d_acts: NDArray[np.float32]
    line: NDArray[np.float32]
    ray_first: NDArray[np.int64]
    ray: NDArray[np.float32]


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
    """Choose the n-th ray of the step: fills ray (11,), returns its view's number."""
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
    """Fill ray (11,), the step's n-th, from a pixel: direction, target, background, view, weight (the last
    two only where ``Views`` has exposures and weights). Returns the view's number."""
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
    if views.exposure.shape[0] > 0:
        ray[9] = np.float32(view)
        for c in range(3):
            ray[3 + c] = views.exposure[view, c, 0] * ray[3 + c] + views.exposure[view, c, 1]
    if views.weight.size > 0:
        ray[10] = views.weight[pixel]
    return view


@part
def keep(rows, a, b, to):
    """Move columns a to b of every row to ``to`` <= a."""
    for k in range(rows.shape[0]):
        row = rows[k]
        for s in range(b - a):
            row[to + s] = row[a + s]


@part
def fill_chunk(views, recipe, space, encoding, net, chunk, x, line, acts, ray_first, ray):
    """Fill a chunk with rays, their samples and what ``query_density`` says of them.
    Returns (rays, samples).

    Only samples that can be seen are kept: what lies behind an opaque one would cost a backward pass for
    a gradient of nothing. The room they leave is filled with further rays, so that the number of rays
    follows the number of samples they need and every step costs about the same. Where a ray will be opaque
    is guessed from the occupancy grid's densities; where the guess was wrong, the ray is marched farther in
    the next round.
    """
    ts, dts = line[0], line[1]
    out = acts[acts.shape[0] - net.widths[-1] :]
    limit = min(recipe.chunk_rays, ray.shape[0])
    number, doubtful = np.empty(limit, np.int64), np.empty(limit, np.bool_)  # of the rays of one round
    depths = np.empty(limit, np.float32)  # that they are marched to
    again, deeper = np.empty(limit, np.int64), np.empty(limit, np.float32)
    # Typed, since numba would compile the callees once more for every literal.
    n, rays, room = np.int64(0), np.int64(0), np.int64(CHUNK)
    fresh, waiting = 0, 0
    ray_first[0] = 0
    while rays < limit and CHUNK - n > CHUNK // 8:
        end, drawn, taken = n, rays, 0
        while drawn < limit and (taken < waiting or fresh < limit):
            index, most = chunk * CHUNK_RAYS + fresh, np.float32(GUESS)
            if taken < waiting:
                index, most = again[taken], deeper[taken]
            view = draw(views, recipe, index, ray[drawn])
            o = views.origin[view]
            ox, oy, oz = np.float32(o[0]), np.float32(o[1]), np.float32(o[2])
            dx, dy, dz = ray[drawn, 0], ray[drawn, 1], ray[drawn, 2]
            enter, leave = interval(space, ox, oy, oz, dx, dy, dz)
            enter += uniform(recipe.key, np.uint64(index) * np.uint64(8) + np.uint64(6)) * space.step
            more, t, depth = march(space, ox, oy, oz, dx, dy, dz, enter, leave, x, ts, dts, end, room, most)
            doubtful[drawn] = depth > most
            if t < leave and not doubtful[drawn]:
                break  # no room
            if taken < waiting:
                taken += 1
            else:
                fresh += 1
            number[drawn], depths[drawn] = index, most
            end = more
            drawn += 1
            ray_first[drawn] = end
        if drawn == rays:
            break
        for k in range(taken, waiting):
            again[k - taken], deeper[k - taken] = again[k], deeper[k]
        waiting -= taken
        query_density(encoding, recipe.levels, net, x, n, end, acts)
        activate_density(out, n, end)
        begin, kept_rays = n, rays
        for r in range(rays, drawn):
            stop = ray_first[r + 1]
            kept, opaque = seen_samples(out, dts, begin, stop)
            if doubtful[r] and not opaque:
                again[waiting] = number[r]
                deeper[waiting] = AGAIN * depths[r] if AGAIN * depths[r] < SURE else NEVER
                waiting += 1
            else:
                if n < begin:
                    keep(acts, begin, begin + kept, n)
                    keep(x, begin, begin + kept, n)
                    keep(line[:2], begin, begin + kept, n)
                for k in range(ray.shape[1]):
                    ray[kept_rays, k] = ray[r, k]
                n += kept
                kept_rays += 1
                ray_first[kept_rays] = n
            begin = stop
        rays = kept_rays
    return rays, n


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
    ts, dts, w = line[0], line[1], line[2]
    ray_first, ray = scratch.ray_first[worker], scratch.ray[worker]
    outputs = net.widths[-1]
    out, d_out = acts[acts.shape[0] - outputs :], d_acts[acts.shape[0] - outputs :]
    while True:
        chunk = fetch_add(counter, 1)
        if chunk >= batch.samples.size:
            return
        x = batch.x[chunk]
        rays, n = fill_chunk(views, recipe, space, encoding, net, chunk, x, line, acts, ray_first, ray)
        query_color(encoding, recipe.levels, net, x, np.int64(0), n, acts)
        if recipe.harmonics > 1:
            for r in range(rays):
                a, b = ray_first[r], ray_first[r + 1]
                add_harmonics(out, recipe.harmonics, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
        activate_color(out, np.int64(0), n)
        d_out[4:, :n] = _F0
        loss, dropped = 0.0, 0
        for r in range(rays):
            a, b = ray_first[r], ray_first[r + 1]
            error = ray_loss(out, d_out, ts, dts, w, a, b, ray[r, 3:6], ray[r, 6:9], weights)
            if error < _F0:
                # Nothing of this ray may reach the others' sums: 0 times NaN is NaN.
                dropped += 1
                acts[:, a:b] = _F0
            else:
                if views.weight.size > 0:
                    error *= ray[r, 10]
                    for k in range(4):  # loops: slices compile for seconds
                        for s in range(a, b):
                            d_out[k, s] *= ray[r, 10]
                loss += error
                if batch.exposure.shape[1] > 0:
                    compare(out, w, dts, a, b, ray[r], batch.exposure[chunk])
        if recipe.harmonics > 1:
            for r in range(rays):
                a, b = ray_first[r], ray_first[r + 1]
                spread_harmonics(d_out, recipe.harmonics, a, b, ray[r, 0], ray[r, 1], ray[r, 2])
        batch.d_params[chunk] = _F0
        query_back(encoding, net, acts, d_acts, n, batch.d_params[chunk], batch.d_features[chunk])
        batch.samples[chunk], batch.rays[chunk] = n, rays
        batch.dropped[chunk], batch.loss[chunk] = dropped, loss
