"""Masks cleaned of specks, gaps and small holes, a bit a pixel.

OpenCV does the same with morphology and labels in ten times the time, and takes the GIL a dozen times for it.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import device_function
from edge_server.fields.common.kernels.simd import count_bits, lowest_bit
from edge_server.fields.splat.layers import layer_constants as tuned

# Zeros around the image: dilation grows into them, so that erosion ends where the image does.
_EDGE = 8
_WORD = 64
_0, _1, _ALL = np.uint64(0), np.uint64(1), np.uint64(0xFFFFFFFFFFFFFFFF)
_LOWEST_OF_BYTES, _GATHER = np.uint64(0x0101010101010101), np.uint64(0x0102040810204080)


@device_function
def _moved(row, w, by):
    """Word w of a row of bits, moved by ``by`` pixels to the right (-1: one to the left)."""
    if by < 0:
        over = row[w + 1] << np.uint64(_WORD + by) if w + 1 < row.size else _0
        return (row[w] >> np.uint64(-by)) | over
    over = row[w - 1] >> np.uint64(_WORD - by) if w > 0 else _0
    return (row[w] << np.uint64(by)) | over


@device_function
def _bits_of(eights, flag, width):
    """Bit number ``flag`` of each pixel's flags.

    eights: uint64 (H, ceil(width / 8)), the flags of eight pixels each, a byte a pixel, the first in the lowest.
    Returns uint64 (H + 2 _EDGE, words): pixel (y, x) is bit x + _EDGE of row y + _EDGE.
    """
    rows, words = eights.shape[0] + 2 * _EDGE, (width + 2 * _EDGE + _WORD - 1) // _WORD
    bits = np.zeros((rows, words), np.uint64)
    for y in range(eights.shape[0]):
        for k in range(eights.shape[1]):
            found = (eights[y, k] >> np.uint64(flag)) & _LOWEST_OF_BYTES
            if found != _0:
                column = 8 * k + _EDGE  # a multiple of 8: within one word
                eight = (found * _GATHER) >> np.uint64(_WORD - 8)
                bits[y + _EDGE, column // _WORD] |= eight << np.uint64(column % _WORD)
    return bits


@device_function
def _inside(width, words):
    """The columns of the image, uint64 (words,)."""
    inside = np.zeros(words, np.uint64)
    for x in range(_EDGE, width + _EDGE):
        inside[x // _WORD] |= _1 << np.uint64(x % _WORD)
    return inside


@device_function
def _opened(bits, inside):
    """Eroded and dilated by 2 x 2 pixels, each with the pixels above and to the left. Beyond the image all is set for
    erosion, and nothing for dilation."""
    eroded, opened = np.zeros_like(bits), np.zeros_like(bits)
    words = bits.shape[1]
    beyond = np.full(words, _ALL, np.uint64)
    for y in range(_EDGE, bits.shape[0] - _EDGE):
        above = bits[y - 1] if y > _EDGE else beyond
        for w in range(words):
            first = _1 << np.uint64(_EDGE) if w == 0 else _0
            left, corner = _moved(bits[y], w, 1) | first, _moved(above, w, 1) | first
            eroded[y, w] = bits[y, w] & above[w] & left & corner
    for y in range(_EDGE, bits.shape[0] - _EDGE):
        for w in range(words):
            here, above = eroded[y], eroded[y - 1]
            opened[y, w] = (here[w] | above[w] | _moved(here, w, 1) | _moved(above, w, 1)) & inside[w]
    return opened


@device_function
def _closed(bits, inside):
    """Dilated and eroded by an ellipse of 5 x 5 pixels: five in three rows, one in the rows above and below."""
    rows, words = bits.shape
    wide, grown, closed = np.zeros_like(bits), np.zeros_like(bits), np.zeros_like(bits)
    for y in range(_EDGE, rows - _EDGE):
        for w in range(words):
            row = bits[y]
            wide[y, w] = row[w] | _moved(row, w, 1) | _moved(row, w, 2) | _moved(row, w, -1) | _moved(row, w, -2)
    for y in range(2, rows - 2):
        for w in range(words):
            grown[y, w] = bits[y - 2, w] | wide[y - 1, w] | wide[y, w] | wide[y + 1, w] | bits[y + 2, w]
    for y in range(1, rows - 1):
        for w in range(words):
            row = grown[y]
            wide[y, w] = row[w] & _moved(row, w, 1) & _moved(row, w, 2) & _moved(row, w, -1) & _moved(row, w, -2)
    for y in range(_EDGE, rows - _EDGE):
        for w in range(words):
            narrow = grown[y - 2, w] & grown[y + 2, w]
            closed[y, w] = narrow & wide[y - 1, w] & wide[y, w] & wide[y + 1, w] & inside[w]
    return closed


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
            count += count_bits(bits[y, w] & ~_moved(bits[y], w, 1))
    runs, begun, ended = np.empty((count, 3), np.int32), 0, 0
    for y in range(bits.shape[0]):
        row = bits[y]
        for w in range(bits.shape[1]):
            starts, ends = row[w] & ~_moved(row, w, 1), row[w] & ~_moved(row, w, -1)
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
    """Remove specks of fewer than SPECK pixels, close gaps of up to four pixels, fill holes of up to HOLE of the image.

    eights: uint64 (H, ceil(W / 8)): the pixels' flags, a byte each, the first of eight pixels in the lowest byte.
    flag: which bit of the flags is the mask.
    mask: uint8 (H, W), written: 0 or 1. Returns how many are 1.
    """
    height, width = mask.shape
    bits = _bits_of(eights, flag, width)
    inside = _inside(width, bits.shape[1])
    bits = _opened(bits, inside)
    runs = _runs_of(bits)
    sizes = _sizes(runs, 1)
    for k in range(runs.shape[0]):
        if sizes[k] < tuned.SPECK:
            _flip(bits, runs[k])
    bits = _closed(bits, inside)
    rest = np.zeros_like(bits)
    for y in range(_EDGE, height + _EDGE):
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
            word = bits[y + _EDGE, w]
            count += count_bits(word)
            while word != _0:
                mask[y, w * _WORD + lowest_bit(word) - _EDGE] = 1
                word &= word - _1
    return count
