"""What Ctrl-C does in a fit: noted also where Python loses it, and postponed while results are written."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial


@contextmanager
def noted() -> Iterator[threading.Event]:
    """Record whether Ctrl-C was pressed within the block, also if Python cannot raise it: in a callback of
    the garbage collector the exception is printed and lost."""
    pressed = threading.Event()

    def note(interrupt: Callable[[], object]) -> None:
        pressed.set()
        interrupt()

    with _on_ctrl_c(note):
        yield pressed


@contextmanager
def postponed(notice: str) -> Iterator[None]:
    """Let the block finish: the first Ctrl-C within it prints ``notice`` to stderr, the next ones interrupt it."""
    pressed = threading.Event()

    def note(interrupt: Callable[[], object]) -> None:
        if pressed.is_set():
            interrupt()
            return
        pressed.set()
        print(f"\n{notice}", file=sys.stderr, flush=True)

    with _on_ctrl_c(note):
        yield


@contextmanager
def _on_ctrl_c(act: Callable[[Callable[[], object]], None]) -> Iterator[None]:
    """Call ``act`` at each Ctrl-C within the block, with a function that does what Ctrl-C did before. Outside of the
    main thread, and where SIGINT is ignored, all stays as it is."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    signal.signal(signal.SIGINT, lambda number, frame: act(partial(before, number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
