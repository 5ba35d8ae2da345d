"""Tile intersection (gsplat's ``isect_tiles``): each tile's list of Gaussians, sorted front to back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import count_bits, draw, lowest_bit
from edge_server.fields.splat.kernels.project import DEPTH_BITS, DEPTH_KEY, TILE_BITS

RADIX_BITS = DEPTH_BITS // 2  # the sort takes two passes
RADIX = 1 << RADIX_BITS


class TileLists(NamedTuple):
    """Pairs of a Gaussian and a tile that it touches. The pairs of a Gaussian have consecutive numbers.
    At most T tiles, N Gaussians, at most P pairs, W workers.

    first: int32 (T + 1,), where each tile's list begins in ``pair``.
    pair: int32 (P,), pair numbers, tile by tile, front to back.
    owner: int32 (P,), the Gaussian of each pair.
    own_first, own_count: int32 (N,), the first pair of each Gaussian, and how many it has.
    needed: int64 (1,), pairs in total. Where that is more than P, the Gaussians that no longer fit, in the
        order of their numbers, are left out with all their pairs.
    longest: int64 (W,), length of the longest tile list in each band.
    keys, order: uint32 and int32 (W, 2, N + 1); begins: int32 (W, N); binned: int32 (W, 2, P): scratch of each
        worker, kept because allocating it costs more than using it.
    """

    first: NDArray[np.int32]
    pair: NDArray[np.int32]
    owner: NDArray[np.int32]
    own_first: NDArray[np.int32]
    own_count: NDArray[np.int32]
    needed: NDArray[np.int64]
    longest: NDArray[np.int64]
    keys: NDArray[np.uint32]
    order: NDArray[np.int32]
    begins: NDArray[np.int32]
    binned: NDArray[np.int32]


@device_function
def _sort(keys, order, n):
    """Stable radix sort of order[0, :n] by keys[0, :n]; the result is in row 0."""
    counts = np.zeros((2, RADIX + 1), np.int64)
    for k in range(n):
        key = keys[0, k]
        counts[0, np.int64(key & np.uint32(RADIX - 1)) + 1] += 1
        counts[1, np.int64(key >> np.uint32(RADIX_BITS)) + 1] += 1
    for k in range(RADIX):
        counts[0, k + 1] += counts[0, k]
        counts[1, k + 1] += counts[1, k]
    for k in range(n):
        key = keys[0, k]
        digit = np.int64(key & np.uint32(RADIX - 1))
        to = counts[0, digit]
        counts[0, digit] = to + 1
        keys[1, to], order[1, to] = key, order[0, k]
    for k in range(n):
        digit = np.int64(keys[1, k] >> np.uint32(RADIX_BITS))
        to = counts[1, digit]
        counts[1, digit] = to + 1
        order[0, to] = order[1, k]


@device_function
def _tile_bits(tiles, i):
    """The two TILE_BITS columns of a Gaussian as one 64-bit number."""
    low, high = np.uint64(np.uint32(tiles[i, TILE_BITS])), np.uint64(np.uint32(tiles[i, TILE_BITS + 1]))
    return low | (high << np.uint64(32))


@device_function
def _low_bits(bits, n):
    """``bits`` with all but the lowest n (n >= 0) cleared."""
    mask = (np.uint64(1) << np.uint64(n & 63)) - np.uint64(1)
    return bits & (mask if n < 64 else ~np.uint64(0))


@device_function
def _count_tiles(bits, n):
    """How many of the first n tiles of its bounding box a Gaussian touches: it is taken to touch all from the 65th
    on."""
    return count_bits(_low_bits(bits, n)) + max(n - 64, 0)


@kernel
def bin_tiles(counter, worker, columns, rows, count, tiles, lists):
    """Fill ``lists``. A task is a band, one for each worker: some rows of tiles. Each band visits all Gaussians, so
    that it knows where its lists begin, and sorts those that touch its tiles. The lists do not depend on the
    number of bands.

    columns, rows: tiles across and down.
    count: number of Gaussians.
    tiles: int32 (N, FOOTPRINT), see ``project``.
    lists: ``TileLists``, written.
    """
    bands, room = lists.longest.size, lists.pair.size
    first, pair, owner, own_first, own_count = lists.first, lists.pair, lists.owner, lists.own_first, lists.own_count
    keys, order, begins, binned = lists.keys[worker], lists.order[worker], lists.begins[worker], lists.binned[worker]
    while True:
        band = draw(counter, worker, bands)
        if band >= bands:
            return
        top, bottom = rows * band // bands, rows * (band + 1) // bands
        # Every band computes where each Gaussian's pairs begin; each band stores a share of the Gaussians.
        low, high = count * band // bands, count * (band + 1) // bands
        n = made = needed = above = mine = 0
        for i in range(count):
            x0, x1, y0, y1 = tiles[i, 0], tiles[i, 1], tiles[i, 2], tiles[i, 3]
            bits, width, size = _tile_bits(tiles, i), x1 - x0, (x1 - x0) * (y1 - y0)
            begin, end = min(max(y0, top), y1), min(max(y0, bottom), y1)
            before = _count_tiles(bits, (begin - y0) * width)
            here = _count_tiles(bits, (end - y0) * width) - before
            pairs = _count_tiles(bits, size)
            needed += pairs
            if made + pairs > room:
                pairs = before = here = 0
            begins[i] = made
            if (i >= low) & (i < high):
                own_first[i], own_count[i] = made, pairs
            made += pairs
            above += before
            mine += here
            # Written unconditionally: a branch here would be mispredicted too often.
            keys[0, n], order[0, n] = tiles[i, DEPTH_KEY], i
            n += np.int64(here > 0)
        _sort(keys, order, n)
        end = begins[high] if high < count else made
        for i in range(low, high):
            p, pairs = begins[i], own_count[i]
            if p + 4 <= end:  # written unconditionally; the next Gaussian overwrites the excess
                owner[p] = owner[p + 1] = owner[p + 2] = owner[p + 3] = i
                p += 4
            for q in range(p, begins[i] + pairs):
                owner[q] = i
        t0, own_tiles = top * columns, (bottom - top) * columns
        cursor = np.zeros(own_tiles + 1, np.int64)
        made = 0
        for k in range(n):
            i = order[0, k]
            x0, x1, y0, y1 = tiles[i, 0], tiles[i, 1], tiles[i, 2], tiles[i, 3]
            bits, width, size = _tile_bits(tiles, i), x1 - x0, (x1 - x0) * (y1 - y0)
            begin, end, p = min(max(y0, top), y1), min(max(y0, bottom), y1), np.int64(begins[i])
            skipped = (begin - y0) * width
            p += _count_tiles(bits, skipped)
            corner, over = begin * columns + x0 - t0, columns - width
            if size <= 64:
                left = _low_bits(bits, (end - y0) * width)
                left = (left >> np.uint64(skipped)) if skipped < 64 else np.uint64(0)
                scale = 4096 // width + 1
                while left != np.uint64(0):
                    bit = lowest_bit(left)
                    left &= left - np.uint64(1)
                    t = corner + bit + ((bit * scale) >> 12) * over
                    binned[0, made], binned[1, made] = p, t
                    cursor[t + 1] += 1
                    made += 1
                    p += 1
            else:
                for bit in range(skipped, (end - y0) * width):
                    if bit >= 64 or (bits >> np.uint64(bit)) & np.uint64(1):
                        t = corner + bit - skipped + (bit - skipped) // width * over
                        binned[0, made], binned[1, made] = p, t
                        cursor[t + 1] += 1
                        made += 1
                        p += 1
        longest = 0
        if band == 0:
            first[0], lists.needed[0] = 0, needed
        for t in range(own_tiles):
            longest = max(longest, cursor[t + 1])
            cursor[t + 1] += cursor[t]
            first[t0 + t + 1] = above + cursor[t + 1]
        lists.longest[band] = longest
        for k in range(mine):
            t = binned[1, k]
            pair[above + cursor[t]] = binned[0, k]
            cursor[t] += 1
