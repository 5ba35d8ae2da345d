"""What numba lacks on CPUs: atomic counters, bits of numbers, vectorizable exp and log, counter-based RNG."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from edge_server.fields.common.kernels.jit import device_function


@intrinsic
def fetch_add_at(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """Add ``value`` to ``array[index]`` (int64) atomically; returns what was there before."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", builder.gep(data, [args[1]]), args[2], "seq_cst")

    return types.int64(array, types.int64, types.int64), codegen


@device_function
def fetch_add(array, value):
    """``fetch_add_at`` the first element."""
    return fetch_add_at(array, 0, value)


# Elements of a counter for each worker: a cache line.
COUNTER = 8


@device_function
def draw(counter, worker, tasks):
    """The number of a task that no worker has drawn yet; ``tasks`` or more if none is left.

    Each worker begins with a range of its own, the same in every kernel, so that its core's cache still has
    what it wrote there the last time; then it helps the others.
    """
    workers = max(counter.size // COUNTER, 1)
    for k in range(workers):
        of = (worker + k) % workers
        task = tasks * of // workers + fetch_add_at(counter, of * COUNTER, 1)
        if task < tasks * (of + 1) // workers:
            return task
    return tasks


@intrinsic
def count_bits(typingctx: Any, value: Any) -> Any:
    """How many bits of a uint64 are set, int64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.int64(types.uint64), codegen


@intrinsic
def lowest_bit(typingctx: Any, value: Any) -> Any:
    """The number of the lowest bit of a uint64 that is set, int64; 64 if none is."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(0))

    return types.int64(types.uint64), codegen


_F = np.float32
_LOG2_E, _LN2_HIGH, _LN2_LOW = _F(1.44269504), _F(0.693359375), _F(-2.12194440e-4)
_P0, _P1, _P2 = _F(1.9875691500e-4), _F(1.3981999507e-3), _F(8.3334519073e-3)
_P3, _P4, _P5 = _F(4.1665795894e-2), _F(1.6666665459e-1), _F(5.0000001201e-1)
_HALF, _ONE, _LOWEST, _HIGHEST = _F(0.5), _F(1.0), _F(-87.0), _F(88.0)


@device_function
def exp32(x):
    """exp in float32, argument clamped to [-87, 88], relative error below 2e-7; NaN stays NaN.

    The Cephes polynomial, because a call into libm would keep LLVM from vectorizing the loop around it.
    """
    clamped = min(max(x if x == x else _ONE, _LOWEST), _HIGHEST)  # a NaN has no integer part
    n = np.floor(clamped * _LOG2_E + _HALF)
    r = clamped - n * _LN2_HIGH - n * _LN2_LOW
    p = ((((_P0 * r + _P1) * r + _P2) * r + _P3) * r + _P4) * r + _P5
    p = p * r * r + r + _ONE
    power = np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)
    return p * power if x == x else x


_ROOT = np.int32(0x3F3504F3)  # the bits of sqrt(1/2)
_L0, _L1, _L2 = _F(7.0376836292e-2), _F(-1.1514610310e-1), _F(1.1676998740e-1)
_L3, _L4, _L5 = _F(-1.2420140846e-1), _F(1.4249322787e-1), _F(-1.6668057665e-1)
_L6, _L7, _L8 = _F(2.0000714765e-1), _F(-2.4999993993e-1), _F(3.3333331174e-1)


@device_function
def log32(x):
    """The natural logarithm of a normal positive float32, relative error below 2e-7 but for arguments within
    .001 of 1 (absolute error below 1e-8 there). For other arguments the result is undefined, maybe NaN.

    The Cephes polynomial, for the same reason as ``exp32``.
    """
    n = (np.float32(x).view(np.int32) - _ROOT) >> np.int32(23)
    m = np.int32(np.float32(x).view(np.int32) - (n << np.int32(23))).view(np.float32) - _ONE
    square = m * m
    p = (((((((_L0 * m + _L1) * m + _L2) * m + _L3) * m + _L4) * m + _L5) * m + _L6) * m + _L7) * m + _L8
    e = np.float32(n)
    return m + (p * m * square + e * _LN2_LOW - _HALF * square) + e * _LN2_HIGH


@device_function
def is_finite(x):
    """Whether float x is a number. np.isfinite subtracts x from itself, which fast mathematics folds to 0."""
    return abs(x) <= np.float32(3.4e38)


@device_function
def random_bits(key, n):
    """64 random bits: the n-th output (uint64) of the splitmix64 stream ``key`` (uint64)."""
    z = np.uint64(key + np.uint64(n) * np.uint64(0x9E3779B97F4A7C15))
    z = np.uint64((z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9))
    z = np.uint64((z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB))
    return np.uint64(z ^ (z >> np.uint64(31)))


@device_function
def uniform(key, n):
    """A float32 in [0, 1): the n-th number of stream ``key``."""
    return np.float32(random_bits(key, n) >> np.uint64(40)) * np.float32(5.9604645e-08)
