"""The clocks that stamp frames: the machine's, a deliberately wrong one, and a device's own."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from freshfield.clock import Clock


class ClockError(Protocol):
    """What makes a camera's clock wrong: its effects."""

    def node_ns(self, true_ns: int) -> int: ...


class NodeClock:
    """``true`` with ``error``, or ``true`` itself where there is none."""

    def __init__(self, true: Clock, error: ClockError | None = None) -> None:
        self._true = true
        self._error = error

    @property
    def exact(self) -> bool:
        return self._error is None

    def now_ns(self) -> int:
        return self.stamp_ns(self._true.now_ns())

    def stamp_ns(self, true_ns: int) -> int:
        """What this clock shows at a true time."""
        return true_ns if self._error is None else self._error.node_ns(true_ns)


class ArrivalClock:
    """Converts a device's stamps to the host's clock, from nothing but the arrival of its samples.

    A sample comes late, never early, so the least delay of the last ``window_ns`` gives the offset between
    the clocks; older samples are forgotten, because the clocks drift apart. The delay that even the fastest
    sample has (a cable, a cycle of the device) remains in the result.
    """

    def __init__(self, window_ns: int = 5_000_000_000) -> None:
        self._window_ns = window_ns
        self._least: deque[tuple[int, int]] = deque()  # (arrival, offset), offsets increasing

    def host_ns(self, stamp_ns: int, arrived_ns: int) -> int:
        """When a sample was taken, given its stamp and its arrival (ns)."""
        offset = arrived_ns - stamp_ns
        while self._least and self._least[-1][1] >= offset:
            self._least.pop()
        self._least.append((arrived_ns, offset))
        while self._least[0][0] < arrived_ns - self._window_ns:
            self._least.popleft()
        return stamp_ns + self._least[0][1]
