"""Exponential, logarithm and random numbers of the kernels against numpy; vectors are tested by what uses them."""

from __future__ import annotations

import numpy as np
from numba import njit

from edge_server.fields.common.kernels.jit import FAST
from edge_server.fields.common.kernels.simd import COUNTER, draw, exp32, log32, uniform


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


@njit
def _drawn(counter, worker, tasks):
    found = np.full(tasks, -1)
    for k in range(tasks):
        found[k] = draw(counter, worker, tasks)
    return found, draw(counter, worker, tasks)


def test_a_worker_draws_its_own_tasks_and_then_those_of_the_others() -> None:
    found, after = _drawn(np.zeros(3 * COUNTER, np.int64), 1, 10)
    assert found.tolist() == [3, 4, 5, 6, 7, 8, 9, 0, 1, 2] and after >= 10
