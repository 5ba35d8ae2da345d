"""The random numbers of ``channel_emu.model.counter_rng``, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

_MULTIPLY_0, _MULTIPLY_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_WORD, _HALF, _TWELVE = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(12)


@njit(inline="always")
def _pair(n, again, k0, k1):
    c0, c1, c2, c3 = n & _WORD, n >> _HALF, again, np.uint64(0)
    for _ in range(10):
        p0, p1 = _MULTIPLY_0 * c0, _MULTIPLY_1 * c2
        c0, c1, c2, c3 = (p1 >> _HALF) ^ c1 ^ k0, p1 & _WORD, (p0 >> _HALF) ^ c3 ^ k1, p0 & _WORD
        k0, k1 = (k0 + _WEYL_0) & _WORD, (k1 + _WEYL_1) & _WORD
    u = (float((c1 << _HALF | c0) >> _TWELVE) + 0.5) * 2.0**-52
    v = (float((c3 << _HALF | c2) >> _TWELVE) + 0.5) * 2.0**-52
    return u, v


@njit(cache=True, nogil=True)
def pair(number, again, key):
    """The pair of uniforms in (0, 1) of ``number`` and attempt ``again``. key: uint64 (2,) of 32-bit
    words."""
    return _pair(np.uint64(number), np.uint64(again), key[0], key[1])


@njit(cache=True, nogil=True)
def fill(first, u, v, key):
    """Write the pairs of the numbers first, first + 1, ... into ``u`` and ``v`` (float64, of equal
    length)."""
    n, k0, k1 = np.uint64(first), key[0], key[1]
    for i in range(len(u)):
        u[i], v[i] = _pair(n + np.uint64(i), np.uint64(0), k0, k1)
