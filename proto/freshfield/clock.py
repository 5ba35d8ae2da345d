"""Wall and virtual clocks with one common method.

Nothing else in the project reads the wall clock: links, buffers, policies and the edge's loop receive a time
or a clock, so a whole deployment can run in virtual time from one seed.
"""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Tells the time in ns; wall clocks count since 1970 (UTC)."""

    def now_ns(self) -> int: ...


class WallClock:
    """UTC nanoseconds that never step: the wall clock, read once, plus the monotonic clock since then."""

    def __init__(self) -> None:
        self._ahead = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        return self._ahead + time.monotonic_ns()


class SystemClock:
    """The machine's UTC clock, steps included: the clock that drivers stamp with."""

    def now_ns(self) -> int:
        return time.time_ns()


class VirtualClock:
    """A clock that ``advance_to`` sets; it raises ValueError for an earlier time."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now = int(start_ns)

    def now_ns(self) -> int:
        return self._now

    def advance_to(self, now_ns: int) -> None:
        if now_ns < self._now:
            raise ValueError(f"virtual time cannot go back from {self._now} to {now_ns} ns")
        self._now = int(now_ns)
