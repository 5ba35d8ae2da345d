"""Capture schedules: at the ticks of a frame rate, or at the instants of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Protocol


class CaptureSchedule(Protocol):
    """Numbered captures (ticks), each due at an instant of true time.

    lossless: every capture is sent, however late; otherwise a newer one replaces one that still waits.
    """

    lossless: bool

    def first(self, now_ns: int) -> int:
        """Tick of the first capture to make."""
        ...

    def due_ns(self, tick: int) -> int:
        """The instant at which the capture is due, which its image shows."""
        ...

    def next(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        """The tick to capture after ``tick`` (None if that was the last), and the number of ticks missed in
        between."""
        ...


class RateSchedule:
    """Tick k is due ``phase_ns`` after k / fps since the epoch. A node that is late continues with the newest due
    tick."""

    lossless = False

    def __init__(self, fps: Fraction, phase_ns: int = 0) -> None:
        self._rate = fps.numerator
        self._per_tick = fps.denominator * 1_000_000_000
        self._phase_ns = phase_ns

    def first(self, now_ns: int) -> int:
        return self._latest(now_ns) + 1

    def next(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        latest = self._latest(now_ns)
        return max(tick + 1, latest), max(0, latest - tick - 1)

    def due_ns(self, tick: int) -> int:
        return tick * self._per_tick // self._rate + self._phase_ns

    def _latest(self, now_ns: int) -> int:
        return (now_ns - self._phase_ns) * self._rate // self._per_tick


class PartialSchedule(RateSchedule):
    """All but the first of every ``every`` ticks, renumbered without gaps: the training captures of a moving camera
    some of whose captures are held out."""

    def __init__(self, fps: Fraction, phase_ns: int, every: int) -> None:
        super().__init__(fps, phase_ns)
        self._every = every

    def whole(self, tick: int) -> int:
        """The number of a tick among all ticks of the rate."""
        return tick + tick // (self._every - 1) + 1

    def due_ns(self, tick: int) -> int:
        return super().due_ns(self.whole(tick))

    def _latest(self, now_ns: int) -> int:
        latest = super()._latest(now_ns)
        return latest - latest // self._every - 1


class OnceSchedule:
    """Captures at ``times_ns`` after ``start_ns``, once and without skipping any, however late the node
    is."""

    lossless = True

    def __init__(self, times_ns: Sequence[int], start_ns: int) -> None:
        self._times, self._start = times_ns, start_ns

    def first(self, now_ns: int) -> int:
        return 0

    def due_ns(self, tick: int) -> int:
        return self._start + self._times[tick]

    def next(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        return (tick + 1 if tick + 1 < len(self._times) else None), 0
