"""When a camera captures: at the ticks of its frame rate, or when a recording did."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from fractions import Fraction
from typing import Protocol, runtime_checkable


class CaptureSchedule(Protocol):
    """Numbered captures, each due at an instant of true time. lossless: every capture is sent, however late;
    otherwise a newer one replaces one that still waits."""

    lossless: bool

    def first(self, now_ns: int) -> int:
        """The first capture to make."""
        ...

    def due_ns(self, tick: int) -> int:
        """The instant that a capture shows."""
        ...

    def next(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        """The capture after ``tick`` (None if that was the last), and how many are missed between."""
        ...


@runtime_checkable
class ScheduledSource(Protocol):
    """A source with a schedule and codec of its own. start_ns: the instant of its first capture, if it has a
    first; the same for all cameras of a node."""

    codec: str

    def schedule(self, start_ns: int) -> CaptureSchedule: ...


class _Endless:
    """Captures without an end. A node that is late goes on with the newest."""

    lossless = False

    def first(self, now_ns: int) -> int:
        return self._latest(now_ns) + 1

    def next(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        latest = self._latest(now_ns)
        return max(tick + 1, latest), max(0, latest - tick - 1)

    def _latest(self, now_ns: int) -> int:
        raise NotImplementedError


class RateSchedule(_Endless):
    """Tick k is due ``phase_ns`` after k / fps since the epoch."""

    def __init__(self, fps: Fraction, phase_ns: int = 0) -> None:
        self._rate = fps.numerator
        self._per_tick = fps.denominator * 1_000_000_000
        self._phase_ns = phase_ns

    def due_ns(self, tick: int) -> int:
        return tick * self._per_tick // self._rate + self._phase_ns

    def _latest(self, now_ns: int) -> int:
        return (now_ns - self._phase_ns) * self._rate // self._per_tick


class LoopSchedule(_Endless):
    """Captures at ``times_ns`` (from 0, below ``period_ns``) of every period since the epoch, so that nodes
    that replay one recording are in step."""

    def __init__(self, times_ns: Sequence[int], period_ns: int) -> None:
        self._times, self._period = times_ns, period_ns

    def due_ns(self, tick: int) -> int:
        loop, place = divmod(tick, len(self._times))
        return loop * self._period + self._times[place]

    def _latest(self, now_ns: int) -> int:
        loop, since = divmod(now_ns, self._period)
        return loop * len(self._times) + bisect_right(self._times, since) - 1


class OnceSchedule:
    """Captures ``times_ns`` after ``start_ns``, each of them, however late the node is."""

    lossless = True

    def __init__(self, times_ns: Sequence[int], start_ns: int) -> None:
        self._times, self._start = times_ns, start_ns

    def first(self, now_ns: int) -> int:
        return 0

    def due_ns(self, tick: int) -> int:
        return self._start + self._times[tick]

    def next(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        return (tick + 1 if tick + 1 < len(self._times) else None), 0
