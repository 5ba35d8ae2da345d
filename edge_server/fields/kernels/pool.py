"""A small pool of threads that run one nogil kernel at a time, side by side, at low priority.

Not numba's own threading layers: those abort or serialise when several Python threads start parallel
kernels, and here a page renders while the field trains.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np

# For who runs several processes side by side.
THREADS_VARIABLE = "FRESHFIELD_THREADS"


def cores() -> int:
    """How many threads or processes may compute side by side here. ValueError where the environment's
    FRESHFIELD_THREADS is no number."""
    given = os.environ.get(THREADS_VARIABLE, "")
    if given:
        if not given.isdigit():
            raise ValueError(f"{THREADS_VARIABLE}: expected a number of threads, got {given!r}")
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Job:
    def __init__(self, kernel: Callable[..., Any], args: tuple[Any, ...]) -> None:
        self.kernel, self.args = kernel, args
        self.counter = np.zeros(1, np.int64)
        self.done = threading.Semaphore(0)
        self.error: BaseException | None = None


class Pool:
    """``threads`` workers. ``run(kernel, *args)`` calls ``kernel(counter, worker, *args)`` on each of them;
    the kernel draws task numbers from ``counter`` until none are left (see ``kernels.intrinsics``).

    Any number of Python threads may call ``run``: jobs are served in the order in which they come.
    threads: default, the environment's FRESHFIELD_THREADS, else the number of cores this process may use.
    Results do not depend on it. nice: added to the workers' own priority
    where the system allows it (Linux counts it per thread), so that who ingests frames goes first.
    """

    def __init__(self, threads: int | None = None, nice: int = 10) -> None:
        self.threads = cores() if threads is None else int(threads)
        if self.threads < 1:
            raise ValueError(f"a pool needs at least one thread, not {self.threads}")
        self.nice = nice
        self._queues: list[SimpleQueue[_Job | None]] = [SimpleQueue() for _ in range(self.threads)]
        self._order = threading.Lock()
        for worker, queue in enumerate(self._queues):
            name = f"field-worker-{worker}"
            threading.Thread(target=self._serve, args=(worker, queue), name=name, daemon=True).start()

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        """Run ``kernel`` on all workers and wait for them; raises what a worker raised."""
        job = _Job(kernel, args)
        with self._order:  # the same order of jobs in every queue
            for queue in self._queues:
                queue.put(job)
        for _ in self._queues:
            job.done.acquire()
        if job.error is not None:
            raise job.error

    def close(self) -> None:
        """End the workers once they have finished what is queued."""
        with self._order:
            for queue in self._queues:
                queue.put(None)

    def _serve(self, worker: int, queue: SimpleQueue[_Job | None]) -> None:
        _lower_priority(self.nice)
        while (job := queue.get()) is not None:
            try:
                job.kernel(job.counter, worker, *job.args)
            except BaseException as error:  # handed to the caller of run()
                job.error = error
            job.done.release()
            del job  # or the last job's arrays would live until the next one comes


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


def shared_pool(threads: int | None = None, nice: int = 10) -> Pool:
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
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)
    except OSError:
        pass  # a sandbox may forbid it: the field then competes on equal terms
