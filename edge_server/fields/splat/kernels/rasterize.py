"""Rasterization of tiles (gsplat's ``rasterize_to_pixels``), the losses of their pixels, and the gradients.

A tile is 8 x 8 pixels. Every loop runs over its 64 pixels at once, on one piece of memory with constant
offsets, which lets LLVM vectorize it without tests for overlap. ``composite`` adds the Gaussians strip by
strip (thesis 3.20 with alphas in place of densities).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.simd import draw, fetch_add, is_finite, uniform
from edge_server.fields.splat.kernels.composite import (
    PIXELS,
    SAVED,
    STRIP,
    STRIPS,
    SUMS,
    bin_strips,
    composite,
    composite_backward,
)
from edge_server.fields.splat.kernels.project import TILE

# Rows of a tile's memory: light, color and depth, in the order of ``composite``; the loss's gradient by each
# color, and the background's term, in the order of ``composite_backward``.
_T, _R, _G, _B, _Z = (n * PIXELS for n in range(5))
_ER, _EG, _EB, _BEHIND = (n * PIXELS for n in range(5, 9))
ROWS = 9

_F0, _F1, _F2 = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_BYTE = np.float32(1.0 / 255.0)


class Background(NamedTuple):
    """The color behind everything.

    color: float32 (3,).
    random: use a random color for each tile, from stream ``key``, instead.
    """

    color: NDArray[np.float32]
    random: bool
    key: np.uint64


@part
def clear_tile(s):
    """Reset the tile memory ``s``: full light, no color."""
    for k in range(PIXELS):
        s[_T + k] = _F1
        s[_R + k] = s[_G + k] = s[_B + k] = s[_Z + k] = _F0


@part
def strip_scratch(lists):
    """Arrays for ``bin_strips`` that fit the longest tile list: strip_pairs and count."""
    longest = np.int64(1)
    for b in range(lists.longest.shape[0]):
        for r in range(lists.longest.shape[1]):
            longest = max(longest, lists.longest[b, r])
    return np.empty((STRIPS, longest), np.int32), np.empty(STRIPS, np.int64)


@part
def composite_tile(s, lists, b, t, x0, y0, projected, strip_pairs, count, store):
    """Composite tile t of camera slot b into the tile memory ``s``, forward only."""
    clear_tile(s)
    bin_strips(lists, b, lists.first[b, t], lists.first[b, t + 1], projected, y0, strip_pairs, count)
    for n in range(STRIPS):
        composite(
            strip_pairs[n],
            count[n],
            lists.owner[b],
            projected[b],
            np.float32(x0),
            np.float32(y0 + 2 * n),
            s,
            _T + n * STRIP,
            store,
            0,
        )


@part
def _load_target(views, view, x0, y0, background, task, target, back):
    """Fill target (3, PIXELS), -1 outside the image, and the background, back (3,). Returns how many pixels
    are inside."""
    width, height, first = views.size[view, 0], views.size[view, 1], views.first[view]
    for c in range(3):
        back[c] = background.color[c]
        if background.random:
            back[c] = uniform(background.key, np.uint64(3 * task + c))
    count = 0
    transparent = views.pixels.shape[1] == 4
    for k in range(PIXELS):
        x, y = x0 + k % TILE, y0 + k // TILE
        if x >= width or y >= height:
            target[0, k] = target[1, k] = target[2, k] = -_F1
            continue
        count += 1
        pixel = first + y * width + x
        opaque = np.float32(views.pixels[pixel, 3]) * _BYTE if transparent else _F1
        for c in range(3):
            target[c, k] = np.float32(views.pixels[pixel, c]) * _BYTE * opaque + back[c] * (_F1 - opaque)
    return count


@part
def _load_weights(views, view, x0, y0, target, share):
    """Fill share (PIXELS,) with the pixels' weights, and treat pixels of weight 0 as outside the image: -1 in
    target. Returns how many pixels are left."""
    width, height, first = views.size[view, 0], views.size[view, 1], views.first[view]
    count = 0
    for k in range(PIXELS):
        x, y = x0 + k % TILE, y0 + k // TILE
        inside = x < width and y < height
        share[k] = views.weight[first + y * width + x] if inside else _F0
        if share[k] > _F0:
            count += 1
        else:
            target[0, k] = target[1, k] = target[2, k] = -_F1
    return count


@part
def _apply_weights(s, target, share):
    """Multiply the error rows of ``s`` by the pixels' weights; returns the weighted squared error."""
    square = _F0
    for c in range(3):
        for k in range(PIXELS):
            e = s[_R + c * PIXELS + k] - target[c, k] if share[k] > _F0 else _F0
            square += share[k] * (e * e)
            s[_ER + c * PIXELS + k] *= share[k]
    return square


@kernel
def train_tiles(
    counter, worker, views, picked, tasks, columns, projected, lists, background, memory, saved, sums, losses
):
    """Render tiles, compare them with the views, and backpropagate to the pairs. The loss is the squared color
    error, times the pixel's weight where there are ``views.weight``, summed over pixels.

    views: ``rays.Views``.
    picked: int64 (B,), the view of each camera slot.
    tasks: int32 (M, 2), slot and tile.
    memory, saved: float32 (W, ROWS * PIXELS) and (W, longest * STRIPS * SAVED), scratch of each worker.
    sums: float32 (B, P, SUMS), written for the pairs of the tasks' tiles.
    background: ``Background``.
    losses: float64 (M, 2), written: the loss, and 1 if the tile is left out as not finite.
    """
    s, store = memory[worker], saved[worker]
    weighed, share = views.weight.size > 0, np.empty(PIXELS, np.float32)
    target, back = np.empty((3, PIXELS), np.float32), np.empty(3, np.float32)
    (strip_pairs, count), composited = strip_scratch(lists), np.empty(STRIPS, np.int64)
    while True:
        task = draw(counter, worker, tasks.shape[0])
        if task >= tasks.shape[0]:
            return
        b, t = np.int64(tasks[task, 0]), np.int64(tasks[task, 1])
        x0, y0 = TILE * (t % columns[b]), TILE * (t // columns[b])
        inside = _load_target(views, picked[b], x0, y0, background, task, target, back)
        if weighed:
            inside = _load_weights(views, picked[b], x0, y0, target, share)
        clear_tile(s)
        begin, end = np.int64(lists.first[b, t]), np.int64(lists.first[b, t + 1])
        size = (end - begin) * SAVED
        bin_strips(lists, b, begin, end if inside > 0 else begin, projected, y0, strip_pairs, count)
        for n in range(STRIPS):
            composited[n] = composite(
                strip_pairs[n],
                count[n],
                lists.owner[b],
                projected[b],
                np.float32(x0),
                np.float32(y0 + 2 * n),
                s,
                _T + n * STRIP,
                store[n * size : (n + 1) * size],
                SAVED,
            )
        square = _F0
        for c in range(3):
            for k in range(PIXELS):
                s[_R + c * PIXELS + k] += s[_T + k] * back[c]
                known = target[c, k] >= _F0
                e = s[_R + c * PIXELS + k] - target[c, k] if known else _F0
                square += e * e
                s[_ER + c * PIXELS + k] = _F2 * e
        if weighed:
            square = _apply_weights(s, target, share)
        finite = is_finite(square)
        losses[task, 0], losses[task, 1] = square if finite else 0.0, 0.0 if finite else 1.0
        for j in range(begin, end):
            rest = sums[b, lists.pair[b, j]]
            for k in range(SUMS):
                rest[k] = _F0
        if not finite:
            continue
        for k in range(PIXELS):
            s[_BEHIND + k] = s[_T + k] * (back[0] * s[_ER + k] + back[1] * s[_EG + k] + back[2] * s[_EB + k])
        for n in range(STRIPS):
            composite_backward(
                strip_pairs[n],
                composited[n],
                lists.owner[b],
                projected[b],
                np.float32(x0),
                np.float32(y0 + 2 * n),
                s,
                _ER + n * STRIP,
                store[n * size : (n + 1) * size],
                sums[b],
            )


@kernel
def render_tiles(
    counter, worker, columns, rows, width, height, projected, lists, background, memory, saved, color, depth, opacity
):
    """Render camera slot 0. Tasks are tiles. color: float32 (H, W, 3), depth (z): (H, W), opacity: (H, W),
    all written."""
    s, store = memory[worker], saved[worker]
    strip_pairs, count = strip_scratch(lists)
    while True:
        t = fetch_add(counter, 1)
        if t >= columns * rows:
            return
        x0, y0 = TILE * (t % columns), TILE * (t // columns)
        composite_tile(s, lists, 0, t, x0, y0, projected, strip_pairs, count, store)
        for k in range(PIXELS):
            x, y = x0 + k % TILE, y0 + k // TILE
            if x >= width or y >= height:
                continue
            left = s[_T + k]
            for c in range(3):
                value = s[_R + c * PIXELS + k] + left * background[c]
                color[y, x, c] = min(max(value, _F0), _F1) if is_finite(value) else background[c]
            seen = _F1 - left
            far = s[_Z + k] / max(seen, np.float32(1e-3))
            healthy = is_finite(far) and is_finite(seen)
            depth[y, x] = far if healthy and seen > np.float32(1e-3) else _F0
            opacity[y, x] = min(max(seen, _F0), _F1) if healthy else _F0
