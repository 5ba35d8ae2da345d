"""Wall and virtual clocks behind one method, and the estimate of another machine's clock.

Nothing else in the project reads the wall clock: links, buffers, policies and the edge's loop are given a
time or a clock, so that a whole deployment can run in virtual time from one seed.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Offset:
    """Another clock minus this one.

    uncertainty_ns: bound of the error, half the round trip of the exchange that the estimate rests on.
    """

    offset_ns: int
    uncertainty_ns: int


class OffsetEstimator:
    """NTP's estimate: the offset of the exchange with the shortest round trip among the last 16.

    The bound of an exchange grows by ``drift_ppm`` of its age, so that the estimate follows a drifting clock.
    Thread-safe.
    """

    def __init__(self, drift_ppm: float = 50.0) -> None:
        self._samples: deque[tuple[int, int, int]] = deque(maxlen=16)
        self._drift = drift_ppm * 1e-6
        self._lock = threading.Lock()

    def add(self, sent_ns: int, received_ns: int, replied_ns: int, returned_ns: int) -> None:
        """One exchange: sent by this clock, received and replied to by the other, returned by this one.
        Impossible exchanges are ignored."""
        round_trip = (returned_ns - sent_ns) - (replied_ns - received_ns)
        if round_trip < 0 or replied_ns < received_ns:
            return
        offset = ((received_ns - sent_ns) + (replied_ns - returned_ns)) // 2
        with self._lock:
            self._samples.append((returned_ns, offset, round_trip // 2))

    def estimate(self, now_ns: int) -> Offset | None:
        """Best offset at ``now_ns`` of this clock; None before the first exchange."""
        with self._lock:
            samples = list(self._samples)
        if not samples:
            return None

        def bound(sample: tuple[int, int, int]) -> int:
            return sample[2] + int(max(0, now_ns - sample[0]) * self._drift)

        best = min(samples, key=bound)
        return Offset(best[1], bound(best))
