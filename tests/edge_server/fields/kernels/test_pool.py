"""The thread pool: every task once, errors reach the caller, several callers at a time."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest
from numba import njit

from edge_server.fields.kernels.intrinsics import exp32, fetch_add, log32, uniform
from edge_server.fields.kernels.jit import FAST, SOURCES
from edge_server.fields.kernels.mlp import forward
from edge_server.fields.kernels.pool import THREADS_VARIABLE, CallerPool, Pool, shared_pool


@njit(nogil=True)
def _count(counter, worker, done):
    while True:
        task = fetch_add(counter, 1)
        if task >= done.size:
            return
        done[task] += 1


@pytest.mark.parametrize("threads", [1, 3])
def test_every_task_is_done_once(threads: int) -> None:
    pool, done = Pool(threads), np.zeros(10_000, np.int64)
    pool.run(_count, done)
    pool.close()
    assert (done == 1).all()


def test_an_error_reaches_the_caller_and_the_pool_lives_on() -> None:
    def fails(counter, worker):
        raise RuntimeError(f"worker {worker}")

    pool, done = Pool(2), np.zeros(8, np.int64)
    with pytest.raises(RuntimeError, match="worker"):
        pool.run(fails)
    pool.run(_count, done)
    assert (done == 1).all()


def test_no_threads_are_not_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="at least one thread, not 0"):
        Pool(0)
    monkeypatch.setenv(THREADS_VARIABLE, "0")
    with pytest.raises(ValueError, match="at least one thread, not 0"):
        Pool()


def test_several_python_threads_may_run_kernels_at_once() -> None:
    pool, arrays = Pool(2), [np.zeros(2000, np.int64) for _ in range(8)]
    callers = [threading.Thread(target=pool.run, args=(_count, a)) for a in arrays]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(30)
    assert all((a == 1).all() for a in arrays)


@pytest.mark.skipif(os.uname().sysname != "Linux", reason="priorities of single threads: Linux only")
def test_workers_lower_their_own_priority_and_nobody_elses() -> None:
    seen = []

    def look(counter, worker):
        seen.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    mine = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    Pool(1, nice=5).run(look)
    assert seen == [min(mine + 5, 19)]
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == mine


def test_a_pool_is_shared_by_equal_settings() -> None:
    assert shared_pool(1, 3) is shared_pool(1, 3) and shared_pool(1, 3) is not shared_pool(1, 4)


def test_a_caller_pool_stays_in_the_calling_thread() -> None:
    seen = []
    CallerPool().run(lambda counter, worker: seen.append((threading.get_ident(), worker, int(counter[0]))))
    assert seen == [(threading.get_ident(), 0, 0)]


def test_cached_kernels_depend_on_all_kernel_sources() -> None:
    """Or an edit to one file would leave yesterday's code running where it is inlined into another."""
    assert SOURCES in forward._cache._cache_file._source_stamp


def test_no_threads_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one"):
        Pool(-1)


def _of_each(function):
    @njit(fastmath=FAST)
    def values(x):
        out = np.empty_like(x)
        for k in range(x.size):
            out[k] = function(x[k])
        return out

    return values


_exp, _log = _of_each(exp32), _of_each(log32)


def test_exp32_is_exp() -> None:
    x = np.linspace(-86.9, 87.9, 100_001).astype(np.float32)
    np.testing.assert_allclose(_exp(x), np.exp(x.astype(np.float64)), rtol=3e-7)
    edge = _exp(np.array([-1e30, 1e30, np.nan], np.float32))
    assert 0 < edge[0] < 1e-37 and 1e38 < edge[1] < np.inf and np.isnan(edge[2])


def test_log32_is_log() -> None:
    x = np.exp(np.linspace(-87.0, 88.0, 100_001)).astype(np.float32)
    np.testing.assert_allclose(_log(x), np.log(x.astype(np.float64)), rtol=2e-7, atol=1e-8)
    near = np.linspace(0.99, 1.01, 10_001).astype(np.float32)
    np.testing.assert_allclose(_log(near), np.log(near.astype(np.float64)), rtol=2e-7, atol=1e-8)


@njit
def _draw(key, count):
    return np.array([uniform(key, np.uint64(k)) for k in range(count)])


def test_uniform_is_uniform_and_streams_differ() -> None:
    a, b = _draw(np.uint64(1), 20_000), _draw(np.uint64(2), 20_000)
    assert a.min() >= 0.0 and a.max() < 1.0 and abs(a.mean() - 0.5) < 0.01
    assert abs(np.corrcoef(a[:-1], a[1:])[0, 1]) < 0.03 and abs(np.corrcoef(a, b)[0, 1]) < 0.03
