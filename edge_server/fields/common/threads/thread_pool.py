"""A small pool of threads that run nogil kernels side by side, at a low priority if wanted.

Not numba's own threading layers: those abort or serialize when several Python threads start parallel
kernels, and here a page renders while the field trains.

Linux puts a waking thread on a core that is idle at that moment and seldom moves it afterwards. A caller that
woke one worker a core would itself keep a core busy until it slept, and two workers would share one. So each
thread that computes wakes at most two others first, and the caller computes itself, unless its priority is
higher than the workers'. Of a pool that is to leave all workers but one idle (``Pool.spare``) each caller computes
itself, whatever its priority. Callers may then compute at once, each as worker 0: what kernels index by their worker
belongs to one caller.

Where the caller is worker 0, it and the workers wait for each other without sleeping for some 80 us (``brief_wait``):
a step of training is a row of small kernels, and to wake for each took 5 to 30 % of it. In a server, whose
workers have a low priority, nobody waits so: cameras' frames need the cores.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np

from edge_server.fields.common.kernels.simd import COUNTER
from edge_server.fields.common.threads.brief_wait import await_next_job, await_workers
from edge_server.fields.field_constants import MOST_WORKERS

log = logging.getLogger(__name__)

# Environment variable: threads of a pool, for users who run several processes side by side.
THREADS_VARIABLE = "FRESHFIELD_THREADS"


def cores() -> int:
    """How many threads or processes may compute side by side here. ValueError: FRESHFIELD_THREADS in the
    environment is not a number."""
    given = os.environ.get(THREADS_VARIABLE, "")
    if given:
        if not given.isdigit():
            raise ValueError(f"{THREADS_VARIABLE}: expected a number of threads, got {given!r}")
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def default_threads() -> int:
    """Number of workers by default: ``cores``, at most ``MOST_WORKERS`` unless the environment names it."""
    return cores() if os.environ.get(THREADS_VARIABLE) else min(cores(), MOST_WORKERS)


class _Job:
    """A kernel to be run, the tasks drawn so far (a cache line for each worker), and which workers have finished it."""

    def __init__(self, kernel: Callable[..., Any], args: tuple[Any, ...], counter: np.ndarray) -> None:
        self.kernel, self.args, self.counter = kernel, args, counter
        self.finished = bytearray(len(counter) // COUNTER)
        # A queue, not a semaphore: that is Python code, which an interrupt may leave locked.
        self.over = SimpleQueue[None]()
        self.error: BaseException | None = None

    def wait(self) -> None:
        """Wait for all workers; an interrupted caller does so too, because the arrays are the caller's."""
        try:
            if not all(self.finished):
                self.over.get()
        except BaseException:
            while not all(self.finished):
                time.sleep(1e-3)
            raise


class Pool:
    """``run(kernel, *args)`` calls ``kernel(counter, worker, *args)`` on each worker; the kernel draws task
    numbers from ``counter`` until none are left (see ``simd``).

    Any number of Python threads may call ``run``: one job is done after the other, but for callers that compute
    themselves while ``spare`` leaves one worker.

    threads: number of workers; results do not depend on it. Default: ``default_threads``.
    nice: the workers' priority where the system allows it (Linux has one per thread), so that threads that
        ingest frames go first. With 0, the caller's priority, the caller itself is worker 0.
    """

    def __init__(self, threads: int | None = None, nice: int = 0) -> None:
        self.threads = default_threads() if threads is None else int(threads)
        if self.threads < 1:
            raise ValueError(f"a pool needs at least one thread, not {self.threads}")
        self.nice, self._engaged = nice, self.threads
        self._inboxes: list[SimpleQueue[_Job | None]] = [SimpleQueue() for _ in range(self.threads)]
        self._turn, self._closed = threading.Lock(), False
        # Of the job that a caller leads: tasks drawn; in its first element, how many workers are done.
        self._drawn, self._done = np.zeros(COUNTER * self.threads, np.int64), np.zeros(COUNTER, np.int64)
        for worker in range(0 if nice else 1, self.threads):
            name = f"field-worker-{worker}"
            threading.Thread(target=self._serve, args=(worker,), name=name, daemon=True).start()

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """Run ``kernel`` on all workers and wait for them; raises what a worker raised. RuntimeError: the
        pool is closed."""
        engaged = self._engaged
        if engaged == 1 < self.threads and not self._closed:
            kernel(np.zeros(COUNTER, np.int64), 0, *args)
            return
        with self._turn:
            if self._closed:
                raise RuntimeError("the pool is closed")
            if self.nice:
                job = _Job(kernel, args, np.zeros(COUNTER * engaged, np.int64))
                self._inboxes[0].put(job)
            else:
                job = _Job(kernel, args, self._drawn[: COUNTER * engaged])
                self._lead(job)
        job.wait()
        if (error := job.error) is not None:
            job.error = None
            try:
                raise error
            finally:
                del error, job  # or its arrays would live in its traceback

    def spare(self, count: int) -> None:
        """Leave so many workers idle in the jobs to come, but for one: others compute beside them, and two threads that
        share a core wait for each other. Where one is left, callers compute themselves, at their own priority and
        without waiting for each other: to wake a worker takes as long as a small kernel, longer beside busy threads.
        """
        self._engaged = max(self.threads - count, 1)

    def close(self) -> None:
        """End the workers once they have finished the jobs that were begun."""
        with self._turn:
            self._closed = True
            if self.nice:
                self._inboxes[0].put(None)
            else:
                self._wake_others(0, None)

    def _lead(self, job: _Job) -> None:
        """For a caller that is worker 0: do its share of a job and wait for the others."""
        self._done[0] = 0
        try:
            try:
                self._work(job, 0)
                await_workers(self._done, len(job.finished) - 1)
            except BaseException:  # of an interrupt: perhaps not all were woken
                self._wake_others(0, job)
                job.finished[0] = 1
                raise
            finally:
                job.wait()
            self._drawn[:] = 0
        except BaseException:  # a worker may still draw, after a second interrupt: it keeps the array that it has
            self._drawn = np.zeros_like(self._drawn)
            raise

    def _serve(self, worker: int) -> None:
        lower_priority(self.nice)
        while (job := self._inboxes[worker].get()) is not None:
            if not job.finished[worker]:
                self._work(job, worker)
            del job  # or the last job's arrays would live until the next one comes
            if not self.nice:
                self._await_next_job()
        self._wake_others(worker, None)

    def _await_next_job(self) -> None:
        """Look for one before sleeping. Nothing depends on it, so that no error of it may end a worker: as of a full
        disk, where numba keeps what it has compiled."""
        try:
            await_next_job(self._done, self._drawn)
        except Exception as error:
            log.debug("workers sleep at once: %s", error)

    def _work(self, job: _Job, worker: int) -> None:
        self._wake_others(worker, job)
        try:
            job.kernel(job.counter, worker, *job.args)
        except BaseException as error:  # handed to the caller of run()
            job.error = job.error or error
        job.finished[worker] = 1
        if all(job.finished):
            job.over.put(None)

    def _wake_others(self, worker: int, job: _Job | None) -> None:
        count = self.threads if job is None else len(job.finished)
        for other in (2 * worker + 1, 2 * worker + 2):
            if other < count:
                self._inboxes[other].put(job)


def compile_kernels(run_kernels: Callable[[Pool], None]) -> float:
    """Compile, or load from numba's cache, the kernels that ``run_kernels`` runs in the pool given to it;
    returns the seconds. In the calling thread: at a worker's low priority, compiling on a busy machine takes
    minutes."""
    start = time.perf_counter()
    run_kernels(CallerPool())
    await_workers(np.zeros(COUNTER, np.int64), 0)
    await_next_job(np.zeros(COUNTER, np.int64), np.zeros(COUNTER, np.int64))
    return time.perf_counter() - start


class CallerPool(Pool):
    """Runs kernels in the calling thread alone, at its own priority. It has nothing to close, and callers do not wait
    for each other: each needs memory of its own."""

    def __init__(self) -> None:
        super().__init__(threads=1)

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        kernel(np.zeros(COUNTER, np.int64), 0, *args)


_shared: dict[tuple[int | None, int], Pool] = {}
_shared_lock = threading.Lock()


def shared_pool(threads: int | None = None, nice: int = 0) -> Pool:
    """The pool of this process for these settings, made at the first call and shared by all fields."""
    with _shared_lock:
        if (threads, nice) not in _shared:
            _shared[threads, nice] = Pool(threads, nice)
        return _shared[threads, nice]


def lower_priority(nice: int) -> None:
    """Lower the calling thread's priority to ``nice``. On Linux a thread's priority is its own; elsewhere this would
    slow the whole process, and nothing is done."""
    if nice <= 0 or os.uname().sysname != "Linux":
        return
    try:
        mine = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, mine, max(nice, os.getpriority(os.PRIO_PROCESS, mine)))
    except OSError:
        pass  # a sandbox may forbid it: the field then competes on equal terms
