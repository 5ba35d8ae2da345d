"""Draws the work of all frames of a link in advance, by the laws of ``service_time``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from channel_emu.model import service_time
from channel_emu.virtual.kernels.philox import fill, pair

LAW_NONE, LAW_EXPONENTIAL, LAW_DETERMINISTIC, LAW_GAMMA, LAW_LOGNORMAL, LAW_TRACE = 0, 1, 2, 3, 4, 5


_normal = njit(service_time.normal, nogil=True)


@njit(cache=True, nogil=True)
def exponentials(first, count, key):
    """Unit-mean exponentials of the numbers first, first + 1, ..., float64 (count,)."""
    u, v = np.empty(count), np.empty(count)
    fill(first, u, v, key)
    for i in range(count):
        u[i] = -math.log(u[i])
    return u


@njit(cache=True, nogil=True)
def _gamma(number, shape, key):
    boosted = shape if shape >= 1.0 else shape + 1.0
    d = boosted - 1.0 / 3.0
    c = 1.0 / math.sqrt(9.0 * d)
    again = 1
    while True:
        a, b = pair(number, again, key)
        x = _normal(a, b)
        v = (1.0 + c * x) ** 3
        u = pair(number, again + 1, key)[0]
        if v > 0.0 and math.log(u) < 0.5 * x * x + d - d * v + d * math.log(v):
            break
        again += 2
    value = d * v
    if shape < 1.0:
        value *= pair(number, 0, key)[0] ** (1.0 / shape)
    return value / shape


@njit(cache=True, nogil=True)
def draw(count, law, parameter, delays_ms, key):
    """Work of frames 0 to count - 1, float64 (count,), with mean one; for trace the delay in ms, for none 0.

    law: index into ``config.LAWS``, like the constants above.
    parameter: shape of gamma, sigma of lognormal; unused by the others.
    delays_ms: of the law trace.
    key: uint64 (2,), of the random stream.
    """
    if law == LAW_EXPONENTIAL:
        return exponentials(0, count, key)
    if law == LAW_LOGNORMAL:
        u, v = np.empty(count), np.empty(count)
        fill(0, u, v, key)
        for i in range(count):
            u[i] = math.exp(parameter * _normal(u[i], v[i]) - parameter * parameter / 2)
        return u
    drawn = np.full(count, 1.0 if law == LAW_DETERMINISTIC else 0.0)
    if law == LAW_TRACE:
        for i in range(count):
            drawn[i] = delays_ms[i % len(delays_ms)]
    elif law == LAW_GAMMA:
        for i in range(count):
            drawn[i] = _gamma(i, parameter, key)
    return drawn
