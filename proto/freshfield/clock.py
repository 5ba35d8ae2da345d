"""Wall and virtual clocks behind one method.

Nothing else in the project reads the wall clock: links, buffers, policies and the edge's loop are given a
time or a clock, so that a whole deployment can run in virtual time from one seed.
"""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    def now_ns(self) -> int: ...


class WallClock:
    """UTC nanoseconds that never step: the wall clock read once, carried on by the monotonic one.

    offset_ns, drift_ppm: errors of a deliberately wrong clock (the clock_drift effect).
    """

    def __init__(self, offset_ns: int = 0, drift_ppm: float = 0.0) -> None:
        self._start = time.monotonic_ns()
        self._wall = time.time_ns() + offset_ns
        self._drift = drift_ppm * 1e-6

    def now_ns(self) -> int:
        elapsed = time.monotonic_ns() - self._start
        return self._wall + elapsed + int(elapsed * self._drift)


class SystemClock:
    """UTC as the machine has it now, steps included: what drivers stamp by."""

    def now_ns(self) -> int:
        return time.time_ns()


class VirtualClock:
    """A clock that ``advance_to`` moves, forward only (else ValueError)."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now = int(start_ns)

    def now_ns(self) -> int:
        return self._now

    def advance_to(self, now_ns: int) -> None:
        if now_ns < self._now:
            raise ValueError(f"virtual time cannot go back from {self._now} to {now_ns} ns")
        self._now = int(now_ns)
