"""The clock a camera stamps its frames with: the machine's, or a deliberately wrong one; and devices'."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from freshfield.clock import Clock


class Drifting(Protocol):
    """What shifts time: the effects of a camera."""

    def node_ns(self, true_ns: int) -> int: ...


class NodeClock:
    """``true`` seen through ``drift``; ``true`` itself without it."""

    def __init__(self, true: Clock, drift: Drifting | None = None) -> None:
        self._true = true
        self._drift = drift

    @property
    def true_to_machine(self) -> bool:
        return self._drift is None

    def now_ns(self) -> int:
        return self.stamp_ns(self._true.now_ns())

    def stamp_ns(self, true_ns: int) -> int:
        """What this clock shows at a true time."""
        return true_ns if self._drift is None else self._drift.node_ns(true_ns)


class ArrivalClock:
    """A device's own stamps as nanoseconds of our clock, known from nothing but when its samples came.

    A sample comes late, never early, so the one that took least of those of the last ``window_ns`` says how
    the two clocks lie; older ones are forgotten, because the clocks drift apart. What even the fastest takes
    (a cable, a cycle of the device) is not seen and stays in.
    """

    def __init__(self, window_ns: int = 5_000_000_000) -> None:
        self._window_ns = window_ns
        self._least: deque[tuple[int, int]] = deque()  # (arrival, offset), offsets increasing

    def ours_ns(self, stamp_ns: int, arrived_ns: int) -> int:
        """When a sample was taken, given its stamp and when it came."""
        offset = arrived_ns - stamp_ns
        while self._least and self._least[-1][1] >= offset:
            self._least.pop()
        self._least.append((arrived_ns, offset))
        while self._least[0][0] < arrived_ns - self._window_ns:
            self._least.popleft()
        return stamp_ns + self._least[0][1]
