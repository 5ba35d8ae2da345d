"""Rasterization of tiles (gsplat's ``rasterize_to_pixels``), the losses of their pixels, and the gradients.

A tile is 8 x 8 pixels. Every loop runs over its 64 pixels at once, on one piece of memory with constant
offsets, which lets LLVM vectorize it without tests for overlap. ``composite`` adds the Gaussians strip by
strip (thesis 3.20 with alphas in place of densities).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import draw, fetch_add, is_finite
from edge_server.fields.splat.kernels.bin_tiles import TileLists
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
_ER, _BEHIND = 5 * PIXELS, 8 * PIXELS
ROWS = 9
EXPOSURE = 7  # numbers of ``Target.exposure``
# Columns of a tile's losses: the loss, whether it was not finite, and, where an exposure is given, for each
# channel the sums over pixels of their weights w, and of w r, w r r, w t and w r t: r is what is rendered, t the
# image at the field's exposure.
LOSSES, MOMENTS = 2, 5

_F0, _F1, _F2 = np.float32(0.0), np.float32(1.0), np.float32(2.0)
_BYTE = np.float32(1.0 / 255.0)
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)  # of SSIM (Wang et al. 2004), for colors in [0, 1]


class Target(NamedTuple):
    """The image that a step compares with.

    image: uint8 (H, W, 3 or 4).
    weight: float32 (H, W), how much each pixel counts; (0, 0) where all count in full.
    background: float32 (3,), in [0, 1].
    behind: float32 (H, W, 3), steps of 255, what is behind the Gaussians in each pixel; (0, 0, 3): ``background``.
    exposure: float32 (EXPOSURE,), the three gains and the three biases by which a rendering becomes the image, and a
        factor on its loss; (0,): it is as rendered.
    dissimilarity: weight in the loss of (1 - SSIM) / 2, of each channel of a tile and times its pixels. 0: none.
    """

    image: NDArray[np.uint8]
    weight: NDArray[np.float32]
    background: NDArray[np.float32]
    behind: NDArray[np.float32] = np.zeros((0, 0, 3), np.float32)
    exposure: NDArray[np.float32] = np.zeros(0, np.float32)
    dissimilarity: np.float32 = np.float32(0.0)


class Raster(NamedTuple):
    """The Gaussians that a camera sees, and the memory in which W workers rasterize them.

    columns, rows: tiles across and down.
    projected: float32 (N, PROJECTED), see ``project``. lists: by tile.
    memory: float32 (W, ROWS * PIXELS), a tile. saved: float32 (W, longest * STRIPS * SAVED), what compositing saves;
        (W, SAVED) where nothing is differentiated.
    """

    columns: int
    rows: int
    projected: NDArray[np.float32]
    lists: TileLists
    memory: NDArray[np.float32]
    saved: NDArray[np.float32]


@device_function
def clear_tile(s):
    """Reset the tile memory ``s``: full light, no color."""
    for k in range(PIXELS):
        s[_T + k] = _F1
        s[_R + k] = s[_G + k] = s[_B + k] = s[_Z + k] = _F0


@device_function
def strip_scratch(lists):
    """Arrays for ``bin_strips`` that fit the longest tile list: strip_pairs and count."""
    longest = np.int64(1)
    for band in range(lists.longest.size):
        longest = max(longest, lists.longest[band])
    return np.empty((STRIPS, longest), np.int32), np.empty(STRIPS, np.int64)


@device_function
def begin_tile(raster, t, s, strip_pairs, count):
    """Reset the tile memory ``s`` and list the Gaussians of each strip of tile t. Returns the tile's first pixel, x and
    y, and where its list begins and ends."""
    x0, y0 = TILE * (t % raster.columns), TILE * (t // raster.columns)
    begin, end = np.int64(raster.lists.first[t]), np.int64(raster.lists.first[t + 1])
    clear_tile(s)
    bin_strips(raster.lists, begin, end, raster.projected, y0, strip_pairs, count)
    return x0, y0, begin, end


@device_function
def composite_strips(raster, strip_pairs, count, x0, y0, s, store, size, step, composited):
    """``composite`` all strips of a tile whose first pixel is (x0, y0). s: the tile's memory. store: float32, of which
    each strip gets ``size``, and each of its Gaussians ``step``. composited: int64 (STRIPS,), written."""
    for n in range(STRIPS):
        composited[n] = composite(
            strip_pairs[n],
            count[n],
            raster.lists.owner,
            raster.projected,
            np.float32(x0),
            np.float32(y0 + 2 * n),
            s,
            n * STRIP,
            store[n * size :],
            step,
        )


@device_function
def _composite_strips_backward(raster, begin, end, strip_pairs, composited, x0, y0, s, store, size, sums):
    """``composite_backward`` all strips of a tile, whose list goes from ``begin`` to ``end``: writes the rows of its
    pairs in ``sums``, float32 (P, SUMS). s: the tile's memory, from ER on the slopes."""
    for j in range(begin, end):
        rest = sums[raster.lists.pair[j]]
        for k in range(SUMS):
            rest[k] = _F0
    for n in range(STRIPS):
        composite_backward(
            strip_pairs[n],
            composited[n],
            raster.lists.owner,
            raster.projected,
            np.float32(x0),
            np.float32(y0 + 2 * n),
            s,
            _ER + n * STRIP,
            store[n * size : (n + 1) * size],
            sums,
        )


@device_function
def _load_tile(target, x0, y0, color, behind, share):
    """Fill color and behind, (3, PIXELS), and share (PIXELS,), the pixels' weights, 0 outside the image. Returns
    whether any pixel counts."""
    height, width, channels = target.image.shape
    own, weighed = target.behind.shape[0] > 0, target.weight.size > 0
    transparent, some = channels == 4, False
    for c in range(3):
        for k in range(PIXELS):
            behind[c, k] = target.background[c]
    for k in range(PIXELS):
        x, y = x0 + k % TILE, y0 + k // TILE
        share[k] = _F0
        if x < width and y < height:
            share[k] = target.weight[y, x] if weighed else _F1
            opaque = np.float32(target.image[y, x, 3]) * _BYTE if transparent else _F1
            for c in range(3):
                if own:
                    behind[c, k] = target.behind[y, x, c] * _BYTE
                color[c, k] = np.float32(target.image[y, x, c]) * _BYTE * opaque + behind[c, k] * (_F1 - opaque)
        else:
            color[0, k] = color[1, k] = color[2, k] = _F0
        some |= share[k] > _F0
    return some


@device_function
def _undo_exposure(exposure, color, share):
    """Change color (3, PIXELS) to the field's exposure, and weigh its pixels, share (PIXELS,), by what an error there
    means in the image. exposure: see ``Target``."""
    for c in range(3):
        inverse, bias = _F1 / exposure[c], exposure[3 + c]
        for k in range(PIXELS):
            color[c, k] = (color[c, k] - bias) * inverse
    for k in range(PIXELS):
        share[k] *= exposure[6]


@device_function
def _add_moments(s, behind, color, share, losses):
    """Write the columns of ``losses`` from LOSSES on. s: the tile's memory."""
    for c in range(3):
        w = wr = wrr = wt = wrt = _F0
        for k in range(PIXELS):
            r = s[_R + c * PIXELS + k] + s[_T + k] * behind[c, k]
            t, share_r = color[c, k], share[k] * r
            w, wr, wrr, wt, wrt = w + share[k], wr + share_r, wrr + share_r * r, wt + share[k] * t, wrt + share_r * t
        for n, total in enumerate((w, wr, wrr, wt, wrt)):
            losses[LOSSES + c * MOMENTS + n] = total


@device_function
def _add_dissimilarity(s, behind, color, share, weight):
    """Add the gradient of ``weight`` (1 - SSIM) / 2, times the tile's pixels, to the rows from ER on, and what the
    background has of it. A tile is the window of SSIM (Wang et al. 2004); windows do not overlap."""
    w = _F0
    for k in range(PIXELS):
        w += share[k]
    over = _F1 / max(w, np.float32(1e-6))
    for c in range(3):
        mr = mt = rr = tt = rt = _F0
        for k in range(PIXELS):
            r, t = s[_R + c * PIXELS + k] + s[_T + k] * behind[c, k], color[c, k]
            mr, mt = mr + share[k] * r, mt + share[k] * t
            rr, tt, rt = rr + share[k] * r * r, tt + share[k] * t * t, rt + share[k] * r * t
        mr, mt = mr * over, mt * over
        rr, tt, rt = max(rr * over - mr * mr, _F0), max(tt * over - mt * mt, _F0), rt * over - mr * mt
        means, spreads = mr * mr + mt * mt + _C1, rr + tt + _C2
        alike, together = (_F2 * mr * mt + _C1) / means, (_F2 * rt + _C2) / spreads
        half = np.float32(-0.5) * weight
        by_mean = half * together * _F2 * (mt - alike * mr) / means
        by_t, by_r = half * alike * _F2 / spreads, -half * alike * _F2 * together / spreads
        for k in range(PIXELS):
            r = s[_R + c * PIXELS + k] + s[_T + k] * behind[c, k]
            slope = share[k] * (by_mean + by_t * (color[c, k] - mt) + by_r * (r - mr))
            s[_ER + c * PIXELS + k] += slope
            s[_BEHIND + k] += s[_T + k] * behind[c, k] * slope


@kernel
def train_tiles(counter, worker, raster, target, sums, losses):
    """Render the raster, compare it with ``target``, and backpropagate to the pairs. Tasks are tiles. The loss is the
    squared color error times the pixel's weight, summed over pixels, and what ``Target.dissimilarity`` adds (its
    gradient only).

    sums: float32 (P, SUMS), written.
    losses: float64 (tiles, LOSSES), written: the loss, and 1 if the tile is left out as not finite. With
        3 MOMENTS more columns: see there.
    """
    lists, tiles = raster.lists, raster.columns * raster.rows
    s, store, share = raster.memory[worker], raster.saved[worker], np.empty(PIXELS, np.float32)
    color, behind = np.empty((3, PIXELS), np.float32), np.empty((3, PIXELS), np.float32)
    (strip_pairs, count), composited = strip_scratch(lists), np.empty(STRIPS, np.int64)
    while True:
        t = draw(counter, worker, tiles)
        if t >= tiles:
            return
        # Nothing to learn, and most tiles are such.
        if (lists.first[t] == lists.first[t + 1]) & (target.behind.shape[0] > 0):
            losses[t, 0] = losses[t, 1] = 0.0
            continue
        x0, y0, begin, end = begin_tile(raster, t, s, strip_pairs, count)
        if not _load_tile(target, x0, y0, color, behind, share):
            count[0] = count[1] = count[2] = count[3] = 0
        if target.exposure.size > 0:
            _undo_exposure(target.exposure, color, share)
        size = (end - begin) * SAVED
        composite_strips(raster, strip_pairs, count, x0, y0, s, store, size, SAVED, composited)
        square = _F0
        for k in range(PIXELS):
            s[_BEHIND + k] = _F0
        for c in range(3):
            for k in range(PIXELS):
                e = s[_R + c * PIXELS + k] + s[_T + k] * behind[c, k] - color[c, k]
                slope = _F2 * (share[k] * e)
                square += share[k] * (e * e)
                s[_ER + c * PIXELS + k] = slope
                s[_BEHIND + k] += s[_T + k] * behind[c, k] * slope
        if target.dissimilarity > _F0:
            _add_dissimilarity(s, behind, color, share, target.dissimilarity)
        if losses.shape[1] > LOSSES:
            _add_moments(s, behind, color, share, losses[t])
        finite = is_finite(square)
        losses[t, 0], losses[t, 1] = square if finite else 0.0, 0.0 if finite else 1.0
        if not finite:
            composited[0] = composited[1] = composited[2] = composited[3] = 0
        _composite_strips_backward(raster, begin, end, strip_pairs, composited, x0, y0, s, store, size, sums)


@kernel
def render_tiles(counter, worker, raster, background, color, depth, opacity):
    """Render the raster. Tasks are tiles. color: float32 (H, W, 3), depth (z): (H, W), opacity: (H, W), all written."""
    s, store, tiles = raster.memory[worker], raster.saved[worker], raster.columns * raster.rows
    (strip_pairs, count), composited = strip_scratch(raster.lists), np.empty(STRIPS, np.int64)
    while True:
        t = fetch_add(counter, 1)
        if t >= tiles:
            return
        x0, y0, _, _ = begin_tile(raster, t, s, strip_pairs, count)
        # What the forward pass saves is of no use: all at the same place.
        composite_strips(raster, strip_pairs, count, x0, y0, s, store, 0, 0, composited)
        for k in range(PIXELS):
            x, y = x0 + k % TILE, y0 + k // TILE
            if x >= color.shape[1] or y >= color.shape[0]:
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
