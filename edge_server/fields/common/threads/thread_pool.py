"""A small pool of threads that run nogil kernels side by side, at a low priority if wanted.

Not numba's own threading layers: those abort or serialise when several Python threads start parallel
kernels, and here a page renders while the field trains.

A kernel takes milliseconds or less, so it matters on which core its threads wake. Linux puts a waking thread
on a core that is idle at that moment and seldom moves it afterwards, least of all at a low priority. A caller
that woke one worker a core would itself keep a core busy until it slept: in four calls of ten on two cores,
both workers shared one core. So each thread that computes wakes at most two others first, and the caller
computes itself, unless its priority is higher than the workers'.
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
from edge_server.fields.common.threads.work_queue import (
    ASLEEP,
    COUNTERS,
    DONE,
    NOTHING,
    NUMBER,
    WORK,
    await_workers,
    make_queue,
    poll_for_job,
    polls_before_sleep,
    post_job,
)

# Environment variable: threads of a pool, for users who run several processes side by side.
THREADS_VARIABLE = "FRESHFIELD_THREADS"

# More workers gain nothing, or lose: each takes the GIL once a job. That alone takes 0.1 ms with 8 and
# 0.3 ms with 16 (docs/results/gpu/threads.json).
MOST_USEFUL = 8

SERVER_NICE = 5  # of workers in a server that answers cameras meanwhile


def cores() -> int:
    """How many threads or processes may compute side by side here. ValueError: FRESHFIELD_THREADS in the
    environment is not a number."""
    given = os.environ.get(THREADS_VARIABLE, "")
    if given:
        if not given.isdigit():
            raise ValueError(f"{THREADS_VARIABLE}: expected a number of threads, got {given!r}")
        return int(given)
    return _own_cores()


def default_threads() -> int:
    """Number of workers by default: ``cores``, at most ``MOST_USEFUL`` unless the environment names it."""
    return cores() if os.environ.get(THREADS_VARIABLE) else min(_own_cores(), MOST_USEFUL)


def _own_cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Job:
    def __init__(self, kernel: Callable[..., Any], args: tuple[Any, ...], threads: int) -> None:
        self.kernel, self.args = kernel, args
        self.counter = np.zeros(COUNTER * threads, np.int64)
        self.number = 0  # in the queue, if it was posted there
        # 1 for each worker that has taken it, and has finished it. Worker 0 waits for the others.
        self.taken, self.finished = bytearray(threads), bytearray(threads)
        # Queues, not semaphores: those are Python code, which an interrupt may leave locked.
        self.done, self.over = SimpleQueue[None](), SimpleQueue[None]()
        self.ended = False
        self.error: BaseException | None = None


class Pool:
    """``run(kernel, *args)`` calls ``kernel(counter, worker, *args)`` on each worker; the kernel draws task
    numbers from ``counter`` until none are left (see ``simd``).

    Any number of Python threads may call ``run``: one job is done after the other. If there is a core for
    each worker, workers poll for jobs for a moment before they sleep.

    threads: number of workers; results do not depend on it. Default: ``default_threads``.
    nice: the workers' priority where the system allows it (Linux has one per thread), so that threads that
        ingest frames go first. With 0, the caller's priority, the caller itself is worker 0.
    """

    def __init__(self, threads: int | None = None, nice: int = 0) -> None:
        self.threads = default_threads() if threads is None else int(threads)
        if self.threads < 1:
            raise ValueError(f"a pool needs at least one thread, not {self.threads}")
        self.nice = nice
        self._queues: list[SimpleQueue[_Job | None]] = [SimpleQueue() for _ in range(self.threads)]
        self._leading = threading.Lock()  # held by the thread that is worker 0
        self._closing, self._closed = threading.Lock(), False
        self._polls = 1 < self.threads <= _own_cores()
        self._queue, self._states = make_queue(self.threads), np.zeros(COUNTER * self.threads, np.int64)
        self._number = 0
        self._job: _Job | None = None  # the one in progress
        for worker in range(self.threads):
            name = f"field-worker-{worker}"
            threading.Thread(target=self._serve, args=(worker,), name=name, daemon=True).start()

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """Run ``kernel`` on all workers and wait for them; raises what a worker raised. RuntimeError: the
        pool is closed."""
        job = _Job(kernel, args, self.threads)
        if self.nice == 0:
            with self._leading:
                self._check_open()
                self._lead(job)
        else:
            with self._closing:
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
        """End the workers once they have finished the jobs that were begun."""
        with self._closing:
            self._closed = True
            self._queues[0].put(None)

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError("the pool is closed")

    def _lead(self, job: _Job) -> None:
        """Worker 0: do its share and wait for the others. An interrupted caller waits for them as well, or
        the next one does, so that no worker writes to a job's arrays afterwards."""
        self._finish_abandoned()
        polls = polls_before_sleep() if self._polls else 0
        if polls:
            self._number += 1
            job.number, job.counter = self._number, self._queue[COUNTERS:]
        try:
            self._job = job
            if polls:
                post_job(self._queue, job.number)
            self._work(job, 0)
            if not polls:
                for _ in range(self.threads - 1):
                    job.done.get()
            elif not await_workers(self._queue, self.threads - 1, polls):
                job.done.get()
        except BaseException:
            self._finish_abandoned()
            raise
        self._job = None

    def _finish_abandoned(self) -> None:
        """Wait for the workers of a job whose caller was interrupted."""
        job = self._job
        if job is None:
            return
        if not self._polls or self._queue[NUMBER] == job.number:  # otherwise it was never posted
            self._wake_others(0, job)  # a worker that has it does not take it again
            while not self._others_are_done(job):
                time.sleep(1e-3)
        self._job = None

    def _others_are_done(self, job: _Job) -> bool:
        if self._polls:
            return bool(self._queue[DONE] % ASLEEP == self.threads - 1)
        return all(job.finished[1:])

    def _serve(self, worker: int) -> None:
        _lower_priority(self.nice)
        if worker == 0:
            while (job := self._queues[0].get()) is not None:
                try:
                    with self._leading:
                        self._lead(job)
                except BaseException as error:  # of a kernel's compilation, say
                    job.error = job.error or error
                job.ended = True
                job.over.put(None)
                del job  # or the last job's arrays would live until the next one comes
            with self._leading:  # finish what a caller has begun
                self._wake_others(worker, None)
            return
        last, done = 0, SimpleQueue[None]()
        while (job := self._next(worker, last, done)) is not None:
            self._work(job, worker)
            last, done = job.number, job.done
            job.finished[worker] = 1
            if not self._polls:
                done.put(None)
            del job
        self._wake_others(worker, None)

    def _next(self, worker: int, last: int, done: SimpleQueue[None]) -> _Job | None:
        """The next job of this worker; None: end. last: the number of its last job, whose caller may sleep
        until there is something in ``done``; 0 at first."""
        others = self.threads - 1
        while self._polls and last > 0:
            found = poll_for_job(self._queue, self._states, worker, last, others, polls_before_sleep())
            others = 0
            if found == NOTHING:
                break
            if found == WORK:
                job = self._job  # it stays until this worker is done
                assert job is not None
                job.taken[worker] = 1
                return job
            done.put(None)
        return self._woken(worker)

    def _woken(self, worker: int) -> _Job | None:
        """The job a sleeping worker is woken for. It holds no job meanwhile: its arrays would live on."""
        while (job := self._queues[worker].get()) is not None and job.taken[worker]:
            del job  # it was found by polling already
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
    """The pool of this process for these settings, made at the first call and shared by all fields."""
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
