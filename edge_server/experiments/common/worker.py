"""How worker processes of a long computation begin, and how they end with their parent."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor

import cv2

from edge_server.fields.common.threads.thread_pool import MOST_USEFUL, THREADS_VARIABLE


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
    for process in list((pool._processes or {}).values()):
        process.terminate()
    pool.shutdown(wait=False, cancel_futures=True)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # at once: nobody waits for half a result
