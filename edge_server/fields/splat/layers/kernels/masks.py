"""Masks cleaned of specks and small holes, a bit a pixel.

OpenCV does the same with labels in several times the time, and takes the GIL for it.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import device_function
from edge_server.fields.common.kernels.simd import count_bits, lowest_bit
from edge_server.fields.splat.layers import settings as tuned

_WORD = 64
_0, _1 = np.uint64(0), np.uint64(1)
_LOWEST_OF_BYTES, _GATHER = np.uint64(0x0101010101010101), np.uint64(0x0102040810204080)


@device_function
def _moved(row, w, left):
    """Word w of a row of bits, moved by one pixel to the left or to the right."""
    if left:
        over = row[w + 1] << np.uint64(_WORD - 1) if w + 1 < row.size else _0
        return (row[w] >> _1) | over
    over = row[w - 1] >> np.uint64(_WORD - 1) if w > 0 else _0
    return (row[w] << _1) | over


@device_function
def _bits_of(eights, flag, width):
    """Bit number ``flag`` of each pixel's flags.

    eights: uint64 (H, ceil(width / 8)), the flags of eight pixels each, a byte a pixel, the first in the lowest.
    Returns uint64 (H, words): pixel (y, x) is bit x of row y.
    """
    bits = np.zeros((eights.shape[0], (width + _WORD - 1) // _WORD), np.uint64)
    for y in range(eights.shape[0]):
        for k in range(eights.shape[1]):
            found = (eights[y, k] >> np.uint64(flag)) & _LOWEST_OF_BYTES
            if found != _0:
                eight = (found * _GATHER) >> np.uint64(_WORD - 8)
                bits[y, 8 * k // _WORD] |= eight << np.uint64(8 * k % _WORD)
    return bits


@device_function
def _inside(width, words):
    """The columns of the image, uint64 (words,)."""
    inside = np.zeros(words, np.uint64)
    for x in range(width):
        inside[x // _WORD] |= _1 << np.uint64(x % _WORD)
    return inside


@device_function
def _root(parents, run):
    while parents[run] != run:
        parents[run] = parents[parents[run]]
        run = parents[run]
    return run


@device_function
def _runs_of(bits):
    """The runs of set pixels in each row, row by row: int32 (runs, 3), first column, last column, row."""
    count = 0
    for y in range(bits.shape[0]):
        for w in range(bits.shape[1]):
            count += count_bits(bits[y, w] & ~_moved(bits[y], w, False))
    runs, begun, ended = np.empty((count, 3), np.int32), 0, 0
    for y in range(bits.shape[0]):
        row = bits[y]
        for w in range(bits.shape[1]):
            starts, ends = row[w] & ~_moved(row, w, False), row[w] & ~_moved(row, w, True)
            while starts != _0:
                runs[begun, 0], runs[begun, 2] = w * _WORD + lowest_bit(starts), y
                starts &= starts - _1
                begun += 1
            while ends != _0:
                runs[ended, 1] = w * _WORD + lowest_bit(ends)
                ends &= ends - _1
                ended += 1
    return runs


@device_function
def _sizes(runs, reach):
    """Pixels in the connected set to which each run belongs, int64 (runs,).

    reach: 1: pixels also touch at their corners. 0: at their sides alone.
    """
    parents, sizes = np.arange(runs.shape[0]), np.zeros(runs.shape[0], np.int64)
    above = 0
    for run in range(runs.shape[0]):
        while runs[above, 2] < runs[run, 2] - 1 or (
            runs[above, 2] == runs[run, 2] - 1 and runs[above, 1] + reach < runs[run, 0]
        ):
            above += 1
        other = above
        while runs[other, 2] == runs[run, 2] - 1 and runs[other, 0] <= runs[run, 1] + reach:
            a, b = _root(parents, other), _root(parents, run)
            parents[max(a, b)] = min(a, b)
            other += 1
    for run in range(runs.shape[0]):
        sizes[_root(parents, run)] += runs[run, 1] - runs[run, 0] + 1
    for run in range(runs.shape[0]):
        sizes[run] = sizes[_root(parents, run)]
    return sizes


@device_function
def _flip(bits, run):
    """Change the pixels of a run."""
    for column in range(run[0], run[1] + 1):
        bits[run[2], column // _WORD] ^= _1 << np.uint64(column % _WORD)


@device_function
def clean_mask(eights, flag, mask):
    """Remove specks of fewer than SPECK pixels, fill holes of up to HOLE of the image.

    eights: uint64 (H, ceil(W / 8)): the pixels' flags, a byte each, the first of eight pixels in the lowest byte.
    flag: which bit of the flags is the mask.
    mask: uint8 (H, W), written: 0 or 1. Returns how many are 1.
    """
    height, width = mask.shape
    bits = _bits_of(eights, flag, width)
    inside = _inside(width, bits.shape[1])
    runs = _runs_of(bits)
    sizes = _sizes(runs, 1)
    for k in range(runs.shape[0]):
        if sizes[k] < tuned.SPECK:
            _flip(bits, runs[k])
    rest = np.zeros_like(bits)
    for y in range(height):
        for w in range(bits.shape[1]):
            rest[y, w] = ~bits[y, w] & inside[w]
    runs = _runs_of(rest)
    sizes = _sizes(runs, 0)
    for k in range(runs.shape[0]):
        if sizes[k] <= tuned.HOLE * mask.size:
            _flip(bits, runs[k])
    count = 0
    mask[:] = 0
    for y in range(height):
        for w in range(bits.shape[1]):
            word = bits[y, w]
            count += count_bits(word)
            while word != _0:
                mask[y, w * _WORD + lowest_bit(word)] = 1
                word &= word - _1
    return count
