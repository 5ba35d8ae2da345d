"""What every worker process of a long computation does at its beginning."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading

import cv2

from edge_server.fields.common.kernels.thread_pool import THREADS_VARIABLE


def begin(threads: int) -> None:
    """As many threads as are its due; Ctrl-C is the parent's business, and without the parent, however it
    ended, there is nobody to compute for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ[THREADS_VARIABLE] = str(threads)
    cv2.setNumThreads(threads)
    if multiprocessing.parent_process() is not None:
        threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # at once: nobody waits for what is half done
