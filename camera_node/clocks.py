"""The clocks that stamp frames: the machine's, a deliberately wrong one, and a device's own."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from camera_node import node_constants as tuned
from freshfield.clock import Clock


class ClockError(Protocol):
    """The clock error that a camera's effects produce."""

    def node_ns(self, true_ns: int) -> int:
        """What the wrong clock shows at a true time."""
        ...


class NodeClock:
    """The clock ``true`` with ``error`` applied; without an error, ``true`` itself."""

    def __init__(self, true: Clock, error: ClockError | None = None) -> None:
        self._true = true
        self._error = error

    @property
    def exact(self) -> bool:
        """Whether it has no error."""
        return self._error is None

    def now_ns(self) -> int:
        return self.stamp_ns(self._true.now_ns())

    def stamp_ns(self, true_ns: int) -> int:
        """What this clock shows at a true time."""
        return true_ns if self._error is None else self._error.node_ns(true_ns)


class ArrivalClock:
    """Converts a device's time stamps to the host's clock, using only the arrival times of its samples.

    Samples arrive late, never early, so the smallest difference between arrival and stamp within the last
    ``ARRIVAL_WINDOW_NS`` estimates the offset between the clocks. Older samples are forgotten, because the clocks
    drift apart. The delay of the fastest sample (a cable, a cycle of the device) remains in the result.
    """

    def __init__(self) -> None:
        self._least: deque[tuple[int, int]] = deque()  # (arrival, offset), offsets increasing

    def host_ns(self, stamp_ns: int, arrived_ns: int) -> int:
        """When a sample was taken, on the host's clock.

        stamp_ns: on the device's clock. arrived_ns: on the host's clock, ascending from call to call.
        """
        offset = arrived_ns - stamp_ns
        while self._least and self._least[-1][1] >= offset:
            self._least.pop()
        self._least.append((arrived_ns, offset))
        while self._least[0][0] < arrived_ns - tuned.ARRIVAL_WINDOW_NS:
            self._least.popleft()
        return stamp_ns + self._least[0][1]
