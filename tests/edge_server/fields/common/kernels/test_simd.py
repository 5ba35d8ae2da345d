"""Exponential, logarithm and random numbers of the kernels against numpy.

Arithmetic, masks and sums of vectors are those of ``composite`` and ``align``, which have tests of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import FAST
from edge_server.fields.common.kernels.simd import exp32, log32, uniform
from edge_server.fields.common.kernels.simd_vectors import LANES, Vector


def _of_each(function):
    @njit(fastmath=FAST)
    def values(x):
        out = np.empty_like(x)
        for k in range(x.size):
            out[k] = function(x[k])
        return out

    return values


_exp, _log = _of_each(exp32), _of_each(log32)


def test_exponential_and_logarithm_are_numpys() -> None:
    x = np.linspace(-86.9, 87.9, 100_001).astype(np.float32)
    np.testing.assert_allclose(_exp(x), np.exp(x.astype(np.float64)), rtol=3e-7)
    for values in (np.exp(np.linspace(-87.0, 88.0, 100_001)), np.linspace(0.99, 1.01, 10_001)):
        x = values.astype(np.float32)
        np.testing.assert_allclose(_log(x), np.log(x.astype(np.float64)), rtol=2e-7, atol=1e-8)
    edge = _exp(np.array([-1e30, 1e30, np.nan], np.float32))
    assert 0 < edge[0] < 1e-37 and 1e38 < edge[1] < np.inf and np.isnan(edge[2])


@njit
def _draw(key, count):
    return np.array([uniform(key, np.uint64(k)) for k in range(count)])


def test_uniform_is_uniform_and_streams_differ() -> None:
    a, b = _draw(np.uint64(1), 20_000), _draw(np.uint64(2), 20_000)
    assert a.min() >= 0.0 and a.max() < 1.0 and abs(a.mean() - 0.5) < 0.01
    assert abs(np.corrcoef(a[:-1], a[1:])[0, 1]) < 0.03 and abs(np.corrcoef(a, b)[0, 1]) < 0.03


def _run(work: Callable[[Vector, Vector], Vector], a: NDArray[np.float32], b: NDArray[np.float32]) -> Any:
    """What ``work`` makes of two vectors."""

    @intrinsic
    def code(typingctx: Any, x: Any, y: Any, out: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            data = [
                context.make_array(kind)(context, builder, arg).data
                for kind, arg in zip(signature.args, args, strict=True)
            ]
            work(Vector.load(builder, data[0]), Vector.load(builder, data[1])).store(data[2])
            return context.get_dummy_value()

        return types.void(x, y, out), codegen

    @njit(fastmath=FAST)  # as the kernels are
    def run(x, y, out):
        code(x, y, out)

    out = np.full(LANES, -7.0, np.float32)
    run(a, b, out)
    return out


def test_minimum_and_maximum_replace_nan():
    a = np.array([np.nan, np.inf, -np.inf, 0.5] * 4, np.float32)
    np.testing.assert_array_equal(_run(lambda x, y: x.minimum(2.0), a, a), [2.0, 2.0, -np.inf, 0.5] * 4)
    np.testing.assert_array_equal(_run(lambda x, y: x.maximum(-2.0), a, a), [-2.0, np.inf, -2.0, 0.5] * 4)


def test_exp2_is_exact_to_the_last_bits_and_clamps_its_argument():
    for given in np.linspace(-63.99, 0.0, 160).astype(np.float32).reshape(-1, LANES):
        got = _run(lambda x, y: x.exp2(), given, given)
        np.testing.assert_allclose(got, np.exp2(given.astype(np.float64)), rtol=3e-7)
    given = np.array([1.0, 300.0, np.inf, -64.0, -1e3, -3e38, -np.inf, np.nan] * 2, np.float32)
    least = 2.0**-64
    got = _run(lambda x, y: x.exp2(), given, given)
    np.testing.assert_allclose(got, [1, 1, 1, least, least, least, least, least] * 2, rtol=3e-7)
