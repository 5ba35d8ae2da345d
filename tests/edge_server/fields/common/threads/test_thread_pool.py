"""The thread pool: every task once, errors reach the caller, several callers at a time."""

import os
import signal
import threading
import time
import weakref

import numpy as np
import pytest
from numba import njit

from edge_server.fields.common.kernels.simd import draw
from edge_server.fields.common.threads import thread_pool
from edge_server.fields.common.threads.thread_pool import THREADS_VARIABLE, CallerPool, Pool, shared_pool
from tests.support import refused

# With a nice of 0 the caller is a worker itself.
either_priority = pytest.mark.parametrize("nice", [0, 5])


@njit(nogil=True)
def _share(counter, worker, done):
    while True:
        task = draw(counter, worker, done.size)
        if task >= done.size:
            return
        done[task] += 1


def _engaged(pool: Pool) -> list[int]:
    """The workers that a job engages."""
    seen: list[int] = []
    pool.run(lambda counter, worker: seen.append(worker))
    return sorted(seen)


@either_priority
@pytest.mark.parametrize("threads", [1, 7])
def test_all_workers_compute_at_once_each_task_once_until_the_pool_is_closed(threads: int, nice: int) -> None:
    """They wait for each other here: who computed first and woke the others then would wait for ever."""
    before, pool, together, seen = set(threading.enumerate()), Pool(threads, nice), threading.Barrier(threads), []
    own = set(threading.enumerate()) - before

    def meet(counter, worker):
        together.wait(10)
        seen.append(worker)

    pool.run(meet)
    assert sorted(seen) == list(range(threads))
    done = [np.zeros(2_000, np.int64) for _ in range(4)]  # several callers at a time
    callers = [threading.Thread(target=lambda each=each: [pool.run(_share, each) for _ in range(5)]) for each in done]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(30)
    assert all((each == 5).all() for each in done)
    pool.close()
    for thread in own:
        thread.join(10)
    assert not any(thread.is_alive() for thread in own)


@either_priority
def test_workers_that_are_spared_stay_idle_and_a_closed_pool_computes_nothing(nice: int) -> None:
    pool, done, callers = Pool(3, nice), np.zeros(1000, np.int64), set[int | None]()
    for spared, engaged in ((1, [0, 1]), (0, [0, 1, 2]), (9, [0])):
        pool.spare(spared)
        assert _engaged(pool) == engaged
        pool.run(_share, done)
    assert (done == 3).all()
    pool.run(lambda counter, worker: callers.add(threading.get_ident()))
    assert callers == {threading.get_ident()}, "where one worker is left, callers compute themselves"
    pool.close()
    refused(RuntimeError, "closed", pool.run, _share, done)


@either_priority
def test_an_error_reaches_the_caller_after_all_are_done_and_the_pool_lives_on(nice: int) -> None:
    pool, done = Pool(2, nice), []

    def fails_first(counter, worker):
        if worker == 0:
            raise RuntimeError("worker 0")
        time.sleep(0.05)
        done.append(worker)

    refused(RuntimeError, "worker 0", pool.run, fails_first)
    assert done == [1] and _engaged(pool) == [0, 1]
    pool.close()


def test_the_number_of_threads_is_that_of_the_cores_the_environment_or_the_caller(monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(12), raising=False)
    monkeypatch.delenv(THREADS_VARIABLE, raising=False)
    assert (Pool().threads, Pool(12).threads) == (8, 12)
    monkeypatch.setenv("FRESHFIELD_THREADS", "10")
    assert Pool().threads == 10
    for given, says in (("0", "at least one thread, not 0"), ("two", "expected a number of threads")):
        monkeypatch.setenv("FRESHFIELD_THREADS", given)
        refused(ValueError, says, Pool)
    assert shared_pool(1, 3) is shared_pool(1, 3) and shared_pool(1, 3) is not shared_pool(1, 4)


@pytest.mark.skipif(os.uname().sysname != "Linux", reason="priorities of single threads: Linux only")
def test_a_caller_works_along_unless_it_is_to_go_first() -> None:
    def look(counter, worker):
        seen[worker] = threading.get_ident(), os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    mine = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    for nice in (0, 4):
        pool, seen = Pool(2, nice), {}
        pool.run(look)
        pool.close()
        assert (seen[0][0] == threading.get_ident()) is (nice == 0) and seen[1][0] != seen[0][0]
        assert [seen[worker][1] for worker in (0, 1)] == [max(mine, nice)] * 2
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == mine
    seen = {}
    CallerPool().run(look)
    assert seen == {0: (threading.get_ident(), mine)}


@either_priority
def test_an_interrupted_caller_waits_for_what_it_has_begun_and_no_task_is_lost_afterwards(nice: int) -> None:
    """Else others would write to arrays that are the caller's. A worker has drawn tasks of a job that is over then."""
    pool, slow, done, ended = Pool(3, nice), np.zeros(40, np.int64), np.zeros(1000, np.int64), []

    def interrupted(counter, worker, done):
        _share(counter, worker, done)
        if worker == 1:
            time.sleep(0.1)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.2)
            ended.append(worker)

    with pytest.raises(KeyboardInterrupt):
        pool.run(interrupted, slow)
    assert ended == [1]
    pool.run(_share, done)
    assert (done == 1).all() and (slow == 1).all()
    assert _engaged(pool) == [0, 1, 2]
    pool.close()


def test_a_worker_outlives_a_wait_that_fails(monkeypatch) -> None:
    def full(*_) -> None:
        raise OSError("no space left on the device")

    monkeypatch.setattr(thread_pool, "await_next_job", full)
    pool, done = Pool(3), np.zeros(30, np.int64)
    for _ in range(3):
        pool.run(_share, done)
    assert (done == 3).all()
    pool.close()


def test_a_caller_interrupted_before_it_has_woken_all_workers_loses_no_task(monkeypatch) -> None:
    pool, done = Pool(3), np.zeros(1000, np.int64)
    wake = pool._wake_others

    def interrupted(worker, job):
        monkeypatch.setattr(pool, "_wake_others", wake)
        raise KeyboardInterrupt

    monkeypatch.setattr(pool, "_wake_others", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pool.run(_share, done)
    assert (done == 1).all() and _engaged(pool) == [0, 1, 2]
    pool.close()


@either_priority
def test_a_pool_that_rests_keeps_no_arrays_and_sleeps(nice: int) -> None:
    """Not those of a worker either that was done long before the others."""
    pool, array = Pool(3, nice), np.zeros(8)
    alive = weakref.ref(array)
    pool.run(lambda counter, worker, array: time.sleep(0.05 * (worker == 0)), array)
    del array
    deadline = time.monotonic() + 5.0
    while alive() is not None and time.monotonic() < deadline:
        time.sleep(0.005)
    assert alive() is None
    time.sleep(0.05)
    before_s = time.process_time()
    time.sleep(0.2)
    assert time.process_time() - before_s < 0.1  # two that went on looking: 0.4
    pool.close()
