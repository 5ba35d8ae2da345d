"""Which Gaussians a tile sees, front to back: sorted by depth once per camera, then dealt out to tiles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.kernels.intrinsics import bits_of_float, fetch_add
from edge_server.fields.kernels.jit import kernel, part
from edge_server.fields.kernels.splat_project import DEPTH, FIRST_64

RADIX_BITS = 10
RADIX = 1 << RADIX_BITS
# The bits of a positive float32 sort as the number does. From .01 to 1e5 scene units the upper 23 of them
# take 380 thousand values, which two passes sort; what is nearer to another than 6e-5 of its depth may come
# before or after it.
_NEAREST, _UPPER = np.int32(0x3C23D70A), np.int32(9)  # the bits of .01; lower bits that are left out


class Lists(NamedTuple):
    """A pair is a Gaussian and a tile it touches; those of one Gaussian follow each other. B cameras,
    T tiles at most, N Gaussians, P pairs.

    wanted: uint8 (B, T), tiles that are looked at. first: int32 (B, T + 1) into ``pair``: int32 (B, P),
    the tile's pairs front to back. owner, tile: int32 (B, P), a pair's Gaussian and its tile. own_first,
    own_count: int32 (B, N), a Gaussian's pairs. needed, longest: int64 (B,), pairs there are (more than P:
    the farthest were left out) and the longest list. order: int32 (B, 2, N), keys: uint32 (B, 2, N), scratch.
    """

    wanted: NDArray[np.uint8]
    first: NDArray[np.int32]
    pair: NDArray[np.int32]
    owner: NDArray[np.int32]
    tile: NDArray[np.int32]
    own_first: NDArray[np.int32]
    own_count: NDArray[np.int32]
    needed: NDArray[np.int64]
    longest: NDArray[np.int64]
    order: NDArray[np.int32]
    keys: NDArray[np.uint32]


@part
def _sort(keys, order, n):
    """Stable radix sort of order[0, :n] by keys[0, :n] in two passes; ends in row 0."""
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
def _bits(tiles, b, i):
    """The columns FIRST_64 of a Gaussian, as one number."""
    low, high = np.uint64(np.uint32(tiles[b, i, FIRST_64])), np.uint64(np.uint32(tiles[b, i, FIRST_64 + 1]))
    return low | (high << np.uint64(32))


@part
def _reaches(bits, n):
    """1 if a Gaussian reaches the n-th tile of its box, else 0."""
    return np.int64((bits >> np.uint64(min(n, 63))) & np.uint64(1)) if n < 64 else 1


@kernel
def deal(counter, worker, columns, rows, count, projected, tiles, lists):
    """Tasks are cameras. columns, rows: int64 (B,), tiles across and down. See ``Lists``."""
    while True:
        b = fetch_add(counter, 1)
        if b >= columns.size:
            return
        keys, order, across = lists.keys[b], lists.order[b], columns[b]
        wanted, first = lists.wanted[b], lists.first[b]
        own_first, own_count, owner, tile, pair = (
            lists.own_first[b], lists.own_count[b], lists.owner[b], lists.tile[b], lists.pair[b])  # fmt: skip
        total = across * rows[b]
        asked = 0
        for t in range(total):
            asked += np.int64(wanted[t])
        n = 0
        for i in range(count):
            own_count[i] = 0
            x0, x1, y0, y1 = tiles[b, i, 0], tiles[b, i, 1], tiles[b, i, 2], tiles[b, i, 3]
            if x1 <= x0:
                continue
            bits, box, touches = _bits(tiles, b, i), 0, 0
            if asked == total:
                touches = 1 if bits != np.uint64(0) or (x1 - x0) * (y1 - y0) > 64 else 0
            else:  # what lies elsewhere need not be sorted
                for ty in range(y0, y1):
                    for tx in range(x0, x1):
                        touches += np.int64(wanted[ty * across + tx]) * _reaches(bits, box)
                        box += 1
            if touches > 0:
                far = (bits_of_float(projected[b, i, DEPTH]) - _NEAREST) >> _UPPER
                keys[0, n] = np.uint32(min(max(far, np.int32(0)), np.int32(RADIX * RADIX - 1)))
                order[0, n] = i
                n += 1
        _sort(keys, order, n)
        for t in range(total + 1):
            first[t] = 0
        made, needed, room = 0, 0, owner.size
        for k in range(n):
            i = order[0, k]
            own_first[i] = made
            bits, box = _bits(tiles, b, i), 0
            for ty in range(tiles[b, i, 2], tiles[b, i, 3]):
                for tx in range(tiles[b, i, 0], tiles[b, i, 1]):
                    t = ty * across + tx
                    hit = np.int64(wanted[t]) * _reaches(bits, box)
                    if made < room:  # written in any case: a branch here would be guessed wrong too often
                        owner[made], tile[made] = i, t
                        first[t + 1] += hit
                        made += hit
                    needed += hit
                    box += 1
            own_count[i] = made - own_first[i]
        longest = 0
        for t in range(total):
            longest = max(longest, first[t + 1])
            first[t + 1] += first[t]
        # first[t] serves as the tile's cursor and ends up where the next tile's list began.
        for p in range(made):
            t = tile[p]
            pair[first[t]] = p
            first[t] += 1
        for t in range(total, 0, -1):
            first[t] = first[t - 1]
        first[0] = 0
        lists.needed[b], lists.longest[b] = needed, longest
