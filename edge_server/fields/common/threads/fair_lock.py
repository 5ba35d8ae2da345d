"""A first-come, first-served lock around a field: who trains it and who renders it."""

from __future__ import annotations

import threading
from collections import deque


class FairLock:
    """A lock that is handed over in the order of asking, so that a training loop does not starve a page."""

    def __init__(self) -> None:
        self._mutex = threading.Lock()
        self._waiting: deque[threading.Lock] = deque()
        self._taken = False

    def __enter__(self) -> None:
        gate = None
        with self._mutex:
            if self._taken:
                gate = threading.Lock()
                gate.acquire()
                self._waiting.append(gate)
            self._taken = True
        if gate is not None:
            gate.acquire()  # released by the previous owner, who passes the lock on to us

    def __exit__(self, *_: object) -> None:
        with self._mutex:
            if self._waiting:
                self._waiting.popleft().release()
            else:
                self._taken = False
