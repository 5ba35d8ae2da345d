"""A small pool of threads that run nogil kernels side by side, at low priority where others go first.

Not numba's own threading layers: those abort or serialise when several Python threads start parallel
kernels, and here a page renders while the field trains.

A kernel takes milliseconds or less, so where its threads wake up matters. Linux puts a thread that wakes on
a core that is idle at that moment, and seldom moves it afterwards, least of all one of low priority. A
caller that woke one worker a core would itself keep a core busy until it slept: two workers on one core,
the other idle, in four calls of ten on two cores. So whoever computes wakes at most two others first, and
the caller computes itself, unless it is to go before the workers.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np

from edge_server.fields.common.kernels.simd import COUNTER
from edge_server.fields.common.kernels.work_queue import (
    ASLEEP,
    COUNTERS,
    DONE,
    NOTHING,
    NUMBER,
    WORK,
    attend,
    await_others,
    looks,
    make_board,
    offer,
)

# For who runs several processes side by side.
THREADS_VARIABLE = "FRESHFIELD_THREADS"

SERVER_NICE = 5  # of what computes in a server that answers cameras meanwhile


def cores() -> int:
    """How many threads or processes may compute side by side here. ValueError where the environment's
    FRESHFIELD_THREADS is no number."""
    given = os.environ.get(THREADS_VARIABLE, "")
    if given:
        if not given.isdigit():
            raise ValueError(f"{THREADS_VARIABLE}: expected a number of threads, got {given!r}")
        return int(given)
    return _own_cores()


def _own_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Job:
    def __init__(self, kernel: Callable[..., Any], args: tuple[Any, ...], threads: int) -> None:
        self.kernel, self.args = kernel, args
        self.counter = np.zeros(COUNTER * threads, np.int64)
        self.number = 0  # on the board, if it stands there
        # 1 where a worker has it, and is done with it: worker 0 is who waits for the others.
        self.taken, self.finished = bytearray(threads), bytearray(threads)
        # Queues, not semaphores: an interrupt may leave those locked, being Python.
        self.done, self.over = SimpleQueue[None](), SimpleQueue[None]()
        self.ended = False
        self.error: BaseException | None = None


class Pool:
    """``threads`` workers. ``run(kernel, *args)`` calls ``kernel(counter, worker, *args)`` on each of them;
    the kernel draws task numbers from ``counter`` until none are left (see ``kernels.intrinsics``).

    Any number of Python threads may call ``run``: one job is done after the other.
    threads: default, the environment's FRESHFIELD_THREADS, else the number of cores this process may use.
    Results do not depend on it. nice: the workers' priority where the system allows it (Linux counts it per
    thread), so that who ingests frames goes first. With 0, the caller's, a caller is worker 0 itself. Where
    there is a core for each worker, they look for work on a ``board`` for a moment before they sleep.
    """

    def __init__(self, threads: int | None = None, nice: int = 0) -> None:
        self.threads = cores() if threads is None else int(threads)
        if self.threads < 1:
            raise ValueError(f"a pool needs at least one thread, not {self.threads}")
        self.nice = nice
        self._queues: list[SimpleQueue[_Job | None]] = [SimpleQueue() for _ in range(self.threads)]
        self._seat = threading.Lock()  # held by whoever is worker 0
        self._gate, self._closed = threading.Lock(), False
        self._boards = 1 < self.threads <= _own_cores()
        self._board, self._states = make_board(self.threads), np.zeros(COUNTER * self.threads, np.int64)
        self._number = 0
        self._job: _Job | None = None  # that is being done
        for worker in range(self.threads):
            name = f"field-worker-{worker}"
            threading.Thread(target=self._serve, args=(worker,), name=name, daemon=True).start()

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """Run ``kernel`` on all workers and wait for them; raises what a worker raised. RuntimeError if the
        pool is closed."""
        job = _Job(kernel, args, self.threads)
        if self.nice == 0:
            with self._seat:
                self._check_open()
                self._lead(job)
        else:
            with self._gate:
                self._check_open()
                self._queues[0].put(job)
            try:
                job.over.get()
            except BaseException:
                while not job.ended:  # its arrays are the caller's
                    time.sleep(1e-3)
                raise
        if (error := job.error) is not None:
            job.error = None
            try:
                raise error
            finally:
                del error, job  # or its arrays would live in its traceback

    def close(self) -> None:
        """End the workers once they have finished what was begun."""
        with self._gate:
            self._closed = True
            self._queues[0].put(None)

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError("the pool is closed")

    def _lead(self, job: _Job) -> None:
        """What worker 0 does: its share, and see to it that the others do theirs. Who is interrupted waits
        for them all the same, or the next one does: nobody writes to a job's arrays after that."""
        self._finish_abandoned()
        searching = looks() if self._boards else 0
        if searching:
            self._number += 1
            job.number, job.counter = self._number, self._board[COUNTERS:]
        try:
            self._job = job
            if searching:
                offer(self._board, job.number)
            self._work(job, 0)
            if not searching:
                for _ in range(self.threads - 1):
                    job.done.get()
            elif not await_others(self._board, self.threads - 1, searching):
                job.done.get()
        except BaseException:
            self._finish_abandoned()
            raise
        self._job = None

    def _finish_abandoned(self) -> None:
        """Wait for what the others do of a job whose caller was interrupted."""
        job = self._job
        if job is None:
            return
        if not self._boards or self._board[NUMBER] == job.number:  # else nobody was told of it
            self._wake_others(0, job)  # who has it already takes it no more
            while not self._others_are_done(job):
                time.sleep(1e-3)
        self._job = None

    def _others_are_done(self, job: _Job) -> bool:
        if self._boards:
            return bool(self._board[DONE] % ASLEEP == self.threads - 1)
        return all(job.finished[1:])

    def _serve(self, worker: int) -> None:
        _lower_priority(self.nice)
        if worker == 0:
            while (job := self._queues[0].get()) is not None:
                try:
                    with self._seat:
                        self._lead(job)
                except BaseException as error:  # of a kernel's compilation, say
                    job.error = job.error or error
                job.ended = True
                job.over.put(None)
                del job  # or the last job's arrays would live until the next one comes
            with self._seat:  # what a caller has begun goes before the end
                self._wake_others(worker, None)
            return
        last, done = 0, SimpleQueue[None]()
        while (job := self._next(worker, last, done)) is not None:
            self._work(job, worker)
            last, done = job.number, job.done
            job.finished[worker] = 1
            if not self._boards:
                done.put(None)
            del job
        self._wake_others(worker, None)

    def _next(self, worker: int, last: int, done: SimpleQueue[None]) -> _Job | None:
        """What this worker is to do next, None: to end. last: the number of what it has just done, whose
        caller may sleep until there is something in ``done``; 0 at first."""
        others = self.threads - 1
        while self._boards and last > 0:
            found = attend(self._board, self._states, worker, last, others, looks())
            others = 0
            if found == NOTHING:
                break
            if found == WORK:
                job = self._job  # cannot be another one before this worker is done
                assert job is not None
                job.taken[worker] = 1
                return job
            done.put(None)
        return self._woken(worker)

    def _woken(self, worker: int) -> _Job | None:
        """What a sleeping worker is woken for. It holds no job meanwhile, or its arrays would live on."""
        while (job := self._queues[worker].get()) is not None and job.taken[worker]:
            del job  # it stood on the board, too
        if job is not None:
            job.taken[worker] = 1
        return job

    def _work(self, job: _Job, worker: int) -> None:
        self._wake_others(worker, job)
        try:
            job.kernel(job.counter, worker, *job.args)
        except BaseException as error:  # handed to the caller of run()
            job.error = job.error or error

    def _wake_others(self, worker: int, job: _Job | None) -> None:
        for other in (2 * worker + 1, 2 * worker + 2):
            if other >= self.threads:
                return
            if job is None or not (self._states[other * COUNTER] or job.taken[other]):
                self._queues[other].put(job)


class CallerPool(Pool):
    """Runs kernels in the calling thread alone, at its own priority."""

    def __init__(self) -> None:
        super().__init__(threads=1, nice=0)
        self.close()

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """Run ``kernel`` here and now."""
        kernel(np.zeros(1, np.int64), 0, *args)


_shared: dict[tuple[int | None, int], Pool] = {}
_shared_lock = threading.Lock()


def shared_pool(threads: int | None = None, nice: int = 0) -> Pool:
    """The process's pool for these settings, made at the first call. All fields of a process share it."""
    with _shared_lock:
        if (threads, nice) not in _shared:
            _shared[threads, nice] = Pool(threads, nice)
        return _shared[threads, nice]


def _lower_priority(nice: int) -> None:
    if nice <= 0 or not hasattr(os, "setpriority"):
        return
    try:
        # On Linux a thread's priority is its own; elsewhere this would slow the whole process.
        if os.uname().sysname == "Linux":
            mine = threading.get_native_id()
            os.setpriority(os.PRIO_PROCESS, mine, max(nice, os.getpriority(os.PRIO_PROCESS, mine)))
    except OSError:
        pass  # a sandbox may forbid it: the field then competes on equal terms
