"""The thread pool: every task once, errors reach the caller, several callers at a time."""

from __future__ import annotations

import os
import signal
import threading
import time
import weakref
from collections.abc import Callable

import numpy as np
import pytest
from numba import njit

from edge_server.fields.common.kernels.jit import FAST, SOURCES
from edge_server.fields.common.kernels.mlp import forward
from edge_server.fields.common.kernels.simd import COUNTER, draw, exp32, fetch_add, log32, uniform
from edge_server.fields.common.threads.thread_pool import MOST_USEFUL, THREADS_VARIABLE, CallerPool, Pool, shared_pool
from edge_server.fields.common.threads.work_queue import WAKE_CALLER, poll_for_job


@njit(nogil=True)
def _count(counter, worker, done):
    while True:
        task = fetch_add(counter, 1)
        if task >= done.size:
            return
        done[task] += 1


# With a nice of 0 the caller is a worker itself.
@pytest.mark.parametrize("nice", [0, 5])
@pytest.mark.parametrize("threads", [1, 3])
def test_every_task_is_done_once(threads: int, nice: int) -> None:
    pool, done = Pool(threads, nice), np.zeros(10_000, np.int64)
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


def test_more_threads_than_are_useful_are_for_those_who_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge_server.fields.common.threads.thread_pool._own_cores", lambda: 12)
    monkeypatch.delenv(THREADS_VARIABLE, raising=False)
    assert Pool().threads == MOST_USEFUL < 12 == Pool(12).threads
    monkeypatch.setenv(THREADS_VARIABLE, "10")
    assert Pool().threads == 10


@pytest.mark.parametrize("nice", [0, 5])
@pytest.mark.parametrize("threads", [1, 2, 4])
def test_several_python_threads_may_run_kernels_at_once(threads: int, nice: int) -> None:
    """Whether they work along or not: no more compute than the pool has threads."""
    pool, arrays = Pool(threads, nice), [np.zeros(2000, np.int64) for _ in range(8)]
    now, most = set(), [0]

    def noted(counter, worker, done):
        now.add(threading.get_ident())
        most[0] = max(most[0], len(now))
        time.sleep(0.002)
        _count(counter, worker, done)
        now.discard(threading.get_ident())

    def call(done):
        for _ in range(5):
            pool.run(noted, done)

    callers = [threading.Thread(target=call, args=(a,)) for a in arrays]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(30)
    assert all((a == 5).all() for a in arrays)
    assert most[0] == threads


@pytest.mark.skipif(os.uname().sysname != "Linux", reason="priorities of single threads: Linux only")
def test_workers_lower_their_own_priority_and_nobody_elses() -> None:
    seen = []

    def look(counter, worker):
        seen.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))

    mine = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    Pool(1, nice=5).run(look)
    assert seen == [max(mine, 5)]
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == mine


@pytest.mark.parametrize("nice", [0, 5])
@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_all_workers_compute_at_once_and_each_once(threads: int, nice: int) -> None:
    """They wait for each other here: who computed first and woke the others then would wait for ever."""
    pool, together, seen = Pool(threads, nice), threading.Barrier(threads), []

    def meet(counter, worker):
        together.wait(10)
        seen.append(worker)

    for _ in range(3):
        pool.run(meet)
    pool.close()
    assert sorted(seen) == sorted(3 * list(range(threads)))


@pytest.mark.parametrize("nice, works", [(0, True), (4, False)])
def test_a_caller_works_along_unless_it_is_to_go_first(nice: int, works: bool) -> None:
    pool, seen = Pool(2, nice), {}

    def who(counter, worker):
        seen[worker] = threading.get_ident()

    pool.run(who)
    assert seen.keys() == {0, 1} and len(set(seen.values())) == 2
    assert (seen[0] == threading.get_ident()) is works and seen[1] != threading.get_ident()


def test_an_error_of_a_caller_that_works_along_waits_for_the_others() -> None:
    pool, done = Pool(2, nice=0), []

    def fails_first(counter, worker):
        if worker == 0:
            raise RuntimeError("worker 0")
        time.sleep(0.05)
        done.append(worker)

    with pytest.raises(RuntimeError, match="worker 0"):
        pool.run(fails_first)
    assert done == [1]


@pytest.mark.parametrize("nice", [0, 5])
def test_a_closed_pool_ends_its_threads_after_what_was_begun(nice: int) -> None:
    before, pool = set(threading.enumerate()), Pool(5, nice)
    own = set(threading.enumerate()) - before
    go, begun, arrays = threading.Event(), threading.Barrier(6), np.zeros((2, 10_000), np.int64)

    def waits(counter, worker, done):
        begun.wait(10)
        go.wait(10)
        _count(counter, worker, done)

    callers = [threading.Thread(target=pool.run, args=(waits, arrays[0]))]
    callers[0].start()
    begun.wait(10)  # all five compute; what is asked for now has to wait
    if nice:
        callers.append(threading.Thread(target=pool.run, args=(_count, arrays[1])))
        callers[1].start()
        while pool._queues[0].empty():
            time.sleep(0.001)
    pool.close()
    go.set()
    for thread in (*callers, *own):
        thread.join(10)
    assert (arrays[: len(callers)] == 1).all() and not any(thread.is_alive() for thread in own)
    with pytest.raises(RuntimeError, match="closed"):
        pool.run(_count, arrays[0])


@njit(nogil=True)
def _share(counter, worker, done):
    while True:
        task = draw(counter, worker, done.size)
        if task >= done.size:
            return
        done[task] += 1


@njit
def _drawn(counter, worker, tasks):
    return draw(counter, worker, tasks)


@pytest.mark.parametrize("tasks", [0, 1, 2, 7, 100])
@pytest.mark.parametrize("workers", [1, 3])
def test_each_task_is_drawn_once_each_worker_s_own_ones_first(workers: int, tasks: int) -> None:
    counter, done = np.zeros(COUNTER * workers, np.int64), np.zeros(tasks, np.int64)
    first = [_drawn(counter, worker, tasks) for worker in range(workers)]
    own = [range(tasks * w // workers, tasks * (w + 1) // workers) for w in range(workers)]
    for worker, task in enumerate(first):
        assert tasks < workers or task == own[worker][0]  # fewer: some begin by helping
    rest = [_drawn(counter, workers - 1, tasks) for _ in range(tasks + 1)]
    for task in (*first, *rest):
        if task < tasks:
            done[task] += 1
    assert (done == 1).all() and rest[-1] >= tasks
    alone, done = np.zeros(1, np.int64), np.zeros(tasks, np.int64)
    _share(alone, 0, done)
    assert (done == 1).all()


@pytest.mark.parametrize("nice", [0, 5])
@pytest.mark.parametrize("threads", [2, 3, 7])
def test_no_job_is_lost_however_long_it_lets_the_others_wait(threads, nice, monkeypatch) -> None:
    """Breaks about as long as workers look for work before they sleep, and several who ask at once."""
    monkeypatch.setattr("edge_server.fields.common.threads.thread_pool._own_cores", lambda: 8)
    pool, failed = Pool(threads, nice), []

    def call(seed: int) -> None:
        rng = np.random.default_rng(seed)
        for size in rng.integers(1, 300, 400):
            done = np.zeros(size, np.int64)
            pool.run(_count if size % 2 else _share, done)
            if (done != 1).any():
                failed.append(size)
            until = time.perf_counter() + rng.choice([0.0, 1e-5, 1e-4, 3e-4, 1e-3])
            while time.perf_counter() < until:
                pass

    callers = [threading.Thread(target=call, args=(k,), daemon=True) for k in range(3)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(60)
    assert not failed and not any(caller.is_alive() for caller in callers)
    pool.close()


@pytest.fixture
def many_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge_server.fields.common.threads.thread_pool._own_cores", lambda: 8)


def _interrupted_after(seconds: float, run: Callable[[], None]) -> None:
    """KeyboardInterrupt reaches ``run``, as from Ctrl-C."""

    def stop(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, stop)
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds)
        with pytest.raises(KeyboardInterrupt):
            run()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("cores", [1, 8])
@pytest.mark.parametrize("nice", [0, 5])
def test_a_caller_that_is_interrupted_waits_for_what_it_has_begun(nice, cores, monkeypatch) -> None:
    """With cores for all workers, and without; else others would write to arrays that are the caller's."""
    monkeypatch.setattr("edge_server.fields.common.threads.thread_pool._own_cores", lambda: cores)
    pool, seen = Pool(3, nice), []

    def slow(counter, worker):
        if worker == 1:
            time.sleep(0.3)
            seen.append("slow")

    pool.run(lambda counter, worker: None)  # what is loaded at first must not be interrupted
    for _ in range(2):
        _interrupted_after(0.1, lambda: pool.run(slow))
        assert seen == ["slow"]
        pool.run(lambda counter, worker: seen.append(worker))
        assert sorted(seen[1:]) == [0, 1, 2]
        seen.clear()
    pool.close()


@pytest.mark.parametrize("cores", [1, 8])
def test_who_is_interrupted_twice_leaves_it_to_the_next_job(cores, monkeypatch) -> None:
    monkeypatch.setattr("edge_server.fields.common.threads.thread_pool._own_cores", lambda: cores)
    pool, seen = Pool(2, nice=0), []

    def slow(counter, worker):
        if worker == 1:
            time.sleep(0.3)
            seen.append("slow")

    pool.run(lambda counter, worker: None)
    with monkeypatch.context() as patch:
        patch.setattr(pool, "_finish_abandoned", lambda: None)
        _interrupted_after(0.1, lambda: pool.run(slow))
    assert seen == []
    for _ in range(3):
        pool.run(lambda counter, worker: seen.append(worker))
    assert seen[0] == "slow" and sorted(seen[1:]) == [0, 0, 0, 1, 1, 1]
    pool.close()


def test_a_job_whose_caller_was_interrupted_before_anybody_heard_of_it_is_finished_too(many_cores, monkeypatch) -> None:
    pool, seen = Pool(3, nice=0), []
    work = pool._work

    def interrupted(job, worker):
        if worker == 0:
            raise KeyboardInterrupt
        work(job, worker)

    time.sleep(0.05)  # all sleep
    with monkeypatch.context() as patch:
        patch.setattr(pool, "_work", interrupted)
        with pytest.raises(KeyboardInterrupt):
            pool.run(lambda counter, worker: seen.append("lost"))
    assert seen == ["lost"] * 2
    pool.run(lambda counter, worker: seen.append(worker))
    assert sorted(seen[2:]) == [0, 1, 2]
    pool.close()


def test_a_job_that_was_never_told_of_is_not_done(many_cores, monkeypatch) -> None:
    pool, seen = Pool(2, nice=0), []

    def interrupted(queue, number):
        raise KeyboardInterrupt

    for _ in range(2):  # the first job and a later one
        with monkeypatch.context() as patch:
            patch.setattr("edge_server.fields.common.threads.thread_pool.post_job", interrupted)
            with pytest.raises(KeyboardInterrupt):
                pool.run(lambda counter, worker: seen.append("lost"))
        pool.run(lambda counter, worker: seen.append(worker))
    assert sorted(seen) == [0, 0, 1, 1]
    pool.close()


def test_a_worker_that_wakes_a_caller_late_wakes_no_other(many_cores, monkeypatch) -> None:
    """The caller is gone when the worker, which has told that it is done, comes to wake it."""
    pool, seen, late = Pool(2, nice=0), [], threading.Event()

    def attend_and_wait(*args):
        found = poll_for_job(*args)
        if found == WAKE_CALLER:
            late.set()
            time.sleep(0.1)
        return found

    def slow(counter, worker):
        if worker == 1:
            time.sleep(0.2)

    def both(counter, worker):
        time.sleep(0.3 * worker)
        seen.append(worker)

    pool.run(lambda counter, worker: None)
    with monkeypatch.context() as patch:
        patch.setattr("edge_server.fields.common.threads.thread_pool.poll_for_job", attend_and_wait)
        _interrupted_after(0.1, lambda: pool.run(slow))
        assert late.wait(1.0)
        for k in range(1, 3):
            pool.run(both)
            assert sorted(seen) == sorted(k * [0, 1]), "it was not waited for worker 1"
    pool.close()


@pytest.mark.parametrize("nice", [0, 5])
@pytest.mark.parametrize("cores", [1, 8])
def test_a_pool_that_rests_keeps_no_arrays(nice, cores, monkeypatch) -> None:
    """Not those of a worker either that was done long before the others."""
    monkeypatch.setattr("edge_server.fields.common.threads.thread_pool._own_cores", lambda: cores)
    pool = Pool(3, nice)

    def unequal(counter, worker, array):
        time.sleep(0.05 * (worker == 0))

    for _ in range(3):
        array = np.zeros(8)
        alive = weakref.ref(array)
        pool.run(unequal, array)
        del array
        deadline = time.monotonic() + 5.0
        while alive() is not None and time.monotonic() < deadline:
            time.sleep(0.005)
        assert alive() is None
    pool.close()


def test_what_a_pool_itself_needs_fails_where_it_is_asked_for(many_cores, monkeypatch) -> None:
    def full():
        raise OSError("no space left on device")

    for nice in (0, 5):
        pool, done = Pool(2, nice), np.zeros(8, np.int64)
        with monkeypatch.context() as patch:
            patch.setattr("edge_server.fields.common.threads.thread_pool.polls_before_sleep", full)
            with pytest.raises(OSError, match="no space"):
                pool.run(_count, done)
        pool.run(_count, done)
        assert (done == 1).all()
        pool.close()


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
