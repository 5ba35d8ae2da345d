"""Ctrl-C in a fit is postponed while its results are written."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def postponed(notice: str) -> Iterator[None]:
    """Let the block finish: the first Ctrl-C within it prints ``notice`` to stderr, the next ones interrupt it. Outside
    of the main thread, and where SIGINT is ignored, all stays as it is."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        print(f"\n{notice}", file=sys.stderr, flush=True)
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
