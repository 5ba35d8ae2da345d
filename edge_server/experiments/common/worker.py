"""Starts worker processes of a long computation, and ends them with their parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

import cv2

from edge_server.fields.common.threads.thread_pool import MOST_USEFUL, THREADS_VARIABLE


class _Process(SpawnProcess):
    def start(self) -> None:
        """Start with SIGINT blocked, which the new process inherits; otherwise Ctrl-C ends it during
        imports."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class WorkerContext(SpawnContext):
    """Context of worker processes that ``init_worker`` initializes: spawned, and never reached by Ctrl-C."""

    Process = _Process


def init_worker(threads: int) -> None:
    """Initializer of a worker process: give it its share of threads, leave Ctrl-C to the parent, and end it
    when the parent ends, however that happens.

    threads: of OpenCV and, up to ``MOST_USEFUL``, of our kernels.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ[THREADS_VARIABLE] = str(min(threads, MOST_USEFUL))
    cv2.setNumThreads(threads)
    if multiprocessing.parent_process() is not None:
        threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()


def end_at_once(pool: ProcessPoolExecutor) -> None:
    """Shut a pool down without waiting for what its processes are doing."""
    processes = list((pool._processes or {}).values())
    manager: Any = pool._executor_manager_thread  # a thread; typeshed declares another type
    # Shut down first: a pool that finds its processes dead fails its futures, and a cancelled one then
    # raises.
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
    if manager is not None:
        manager.join()  # a second shutdown, as at the end of a ``with``, would undo the cancelling


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # at once: nobody waits for half a result
