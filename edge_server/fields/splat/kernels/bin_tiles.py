"""Which Gaussians a tile sees, front to back: sorted by depth, then binned out to tiles, in bands of them side
by side."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.simd import count_bits, draw, lowest_bit
from edge_server.fields.splat.kernels.project import DEPTH_BITS, DEPTH_KEY, TILE_BITS

# Two raster sort.
RADIX_BITS = DEPTH_BITS // 2
RADIX = 1 << RADIX_BITS


class TileLists(NamedTuple):
    """A pair is a Gaussian and a tile it touches; those of one Gaussian follow each other. B cameras,
    T tiles at most, N Gaussians, P pairs, W bands at most.

    wanted: uint8 (B, T), tiles that are looked at. first: int32 (B, T + 1) into ``pair``: int32 (B, P),
    the tile's pairs front to back. owner: int32 (B, P), a pair's Gaussian. own_first, own_count: int32
    (B, N), a Gaussian's pairs. needed: int64 (B,), pairs there are (more than P: Gaussians that did not fit
    in any more, in the order of their numbers, were left out with all their pairs). longest: int64 (B, W),
    the longest list of a tile of each band. Scratch of each worker, which costs more to get and give back
    than to use: keys: uint32 (workers, 2, N + 1), order: int32 (workers, 2, N + 1), begins: int32
    (workers, N), binned: int32 (workers, 2, P).
    """

    wanted: NDArray[np.uint8]
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


@part
def _sort(keys, order, n):
    """Stable radix sort of order[0, :n] by keys[0, :n] in two raster; ends in row 0."""
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


@part
def _tile_bits(tiles, b, i):
    """The columns TILE_BITS of a Gaussian, as one number."""
    low, high = np.uint64(np.uint32(tiles[b, i, TILE_BITS])), np.uint64(np.uint32(tiles[b, i, TILE_BITS + 1]))
    return low | (high << np.uint64(32))


@part
def _low_bits(bits, n):
    """The lowest n of 64 bits, 0 <= n; the others are 0."""
    mask = (np.uint64(1) << np.uint64(n & 63)) - np.uint64(1)
    return bits & (mask if n < 64 else ~np.uint64(0))


@part
def _touches_tile(bits, n):
    """1 if a Gaussian reaches the n-th tile of its box, else 0."""
    return np.int64((bits >> np.uint64(min(n, 63))) & np.uint64(1)) if n < 64 else 1


@part
def _count_tiles(bits, n, x0, x1, begin, end, across, wanted):
    """How many tiles of rows begin, ..., end - 1 a Gaussian reaches that are wanted, one by one. n: the
    number in its box of the first tile there."""
    hits = 0
    for ty in range(begin, end):
        for tx in range(x0, x1):
            hits += np.int64(wanted[ty * across + tx]) * _touches_tile(bits, n)
            n += 1
    return hits


@kernel
def bin_tiles(counter, worker, columns, rows, bands, count, tiles, lists):
    """Tasks are bands: each camera's rows of tiles, columns and rows int64 (B,) tiles across and down, are
    divided among ``bands`` tasks. Each goes through all Gaussians, so that it knows without being told where
    its lists begin, and sorts and deals out what reaches its own tiles. The lists do not depend on how many
    bands there are. See ``TileLists``."""
    while True:
        task = draw(counter, worker, columns.size * bands)
        b, band = task // bands, task % bands
        if b >= columns.size:
            return
        across, down = columns[b], rows[b]
        top, bottom = down * band // bands, down * (band + 1) // bands
        wanted, first, pair, owner = lists.wanted[b], lists.first[b], lists.pair[b], lists.owner[b]
        own_first, own_count, room = lists.own_first[b], lists.own_count[b], lists.pair.shape[1]
        asked = 0
        for t in range(across * down):
            asked += np.int64(wanted[t])
        whole = asked == across * down
        keys, order, begins, binned = (
            lists.keys[worker], lists.order[worker], lists.begins[worker], lists.binned[worker])  # fmt: skip
        # Where each Gaussian's pairs begin every band knows; each writes it down for some.
        low, high = count * band // bands, count * (band + 1) // bands
        n = made = needed = above = mine = 0
        for i in range(count):
            x0, x1, y0, y1 = tiles[b, i, 0], tiles[b, i, 1], tiles[b, i, 2], tiles[b, i, 3]
            bits, width, size = _tile_bits(tiles, b, i), x1 - x0, (x1 - x0) * (y1 - y0)
            begin, end = min(max(y0, top), y1), min(max(y0, bottom), y1)
            if whole & (size <= 64):
                pairs = count_bits(_low_bits(bits, size))
                before = count_bits(_low_bits(bits, (begin - y0) * width))
                here = count_bits(_low_bits(bits, (end - y0) * width)) - before
            else:  # what lies elsewhere need not be sorted
                before = _count_tiles(bits, 0, x0, x1, y0, begin, across, wanted)
                here = _count_tiles(bits, (begin - y0) * width, x0, x1, begin, end, across, wanted)
                pairs = (
                    before + here + _count_tiles(bits, (end - y0) * width, x0, x1, end, y1, across, wanted)
                )
            needed += pairs
            if made + pairs > room:
                pairs = before = here = 0
            begins[i] = made
            if (i >= low) & (i < high):
                own_first[i], own_count[i] = made, pairs
            made += pairs
            above += before
            mine += here
            # Written in any case: a branch here would be guessed wrong too often.
            keys[0, n], order[0, n] = tiles[b, i, DEPTH_KEY], i
            n += np.int64(here > 0)
        _sort(keys, order, n)
        end = begins[high] if high < count else made
        for i in range(low, high):
            p, pairs = begins[i], own_count[i]
            if p + 4 <= end:  # written in any case, and again by the next one
                owner[p] = owner[p + 1] = owner[p + 2] = owner[p + 3] = i
                p += 4
            for q in range(p, begins[i] + pairs):
                owner[q] = i
        t0, own_tiles = top * across, (bottom - top) * across
        cursor = np.zeros(own_tiles + 1, np.int64)
        made = 0
        for k in range(n):
            i = order[0, k]
            x0, x1, y0, y1 = tiles[b, i, 0], tiles[b, i, 1], tiles[b, i, 2], tiles[b, i, 3]
            bits, width, size = _tile_bits(tiles, b, i), x1 - x0, (x1 - x0) * (y1 - y0)
            begin, end, p = min(max(y0, top), y1), min(max(y0, bottom), y1), np.int64(begins[i])
            if whole & (size <= 64):
                skipped = (begin - y0) * width
                left = _low_bits(bits, (end - y0) * width)
                p += count_bits(_low_bits(bits, skipped))
                left = (left >> np.uint64(skipped)) if skipped < 64 else np.uint64(0)
                corner, over, scale = begin * across + x0 - t0, across - width, 4096 // width + 1
                while left != np.uint64(0):
                    bit = lowest_bit(left)
                    left &= left - np.uint64(1)
                    t = corner + bit + ((bit * scale) >> 12) * over
                    binned[0, made], binned[1, made] = p, t
                    cursor[t + 1] += 1
                    made += 1
                    p += 1
            else:
                p += _count_tiles(bits, 0, x0, x1, y0, begin, across, wanted)
                bit = (begin - y0) * width
                for ty in range(begin, end):
                    for tx in range(x0, x1):
                        t = ty * across + tx
                        if wanted[t] * _touches_tile(bits, bit) > 0:
                            binned[0, made], binned[1, made] = p, t - t0
                            cursor[t - t0 + 1] += 1
                            made += 1
                            p += 1
                        bit += 1
        longest = 0
        if band == 0:
            first[0] = lists.longest[b, bands:] = 0
            lists.needed[b] = needed
        for t in range(own_tiles):
            longest = max(longest, cursor[t + 1])
            cursor[t + 1] += cursor[t]
            first[t0 + t + 1] = above + cursor[t + 1]
        lists.longest[b, band] = longest
        for k in range(mine):
            t = binned[1, k]
            pair[above + cursor[t]] = binned[0, k]
            cursor[t] += 1
