"""When a camera captures: at the ticks of its frame rate, or as a recording says."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from fractions import Fraction
from typing import Protocol, runtime_checkable


class Pace(Protocol):
    """Numbered captures, each due at an instant of true time. whole: each of them is to be sent, however
    late; else a newer one takes the place of one that still waits."""

    whole: bool

    def first(self, now_ns: int) -> int:
        """The first capture to make."""
        ...

    def due_ns(self, tick: int) -> int:
        """The instant that a capture shows."""
        ...

    def after(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        """The capture that follows ``tick``, None where that was the last, and how many are missed
        between."""
        ...


@runtime_checkable
class Paced(Protocol):
    """A source with a pace and a codec of its own. start_ns: the instant its first capture is due, if it has
    a first; the same for all cameras of a node."""

    codec: str

    def pace(self, start_ns: int) -> Pace: ...


class Ticks:
    """Tick k is due at k / fps since the epoch. A node that is late goes on with the newest tick."""

    whole = False

    def __init__(self, fps: Fraction) -> None:
        self._rate = fps.numerator
        self._per_tick = fps.denominator * 1_000_000_000

    def first(self, now_ns: int) -> int:
        return self._latest(now_ns) + 1

    def due_ns(self, tick: int) -> int:
        return tick * self._per_tick // self._rate

    def after(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        latest = self._latest(now_ns)
        return max(tick + 1, latest), max(0, latest - tick - 1)

    def _latest(self, now_ns: int) -> int:
        return now_ns * self._rate // self._per_tick


class Once:
    """Captures ``times_ns`` after ``start_ns``, each of them, however late the node is."""

    whole = True

    def __init__(self, times_ns: Sequence[int], start_ns: int) -> None:
        self._times, self._start = times_ns, start_ns

    def first(self, now_ns: int) -> int:
        return 0

    def due_ns(self, tick: int) -> int:
        return self._start + self._times[tick]

    def after(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        return (tick + 1 if tick + 1 < len(self._times) else None), 0


class Round:
    """Captures at ``times_ns`` (from 0, below ``period_ns``) of every period since the epoch, so that nodes
    that replay one recording are in step. A node that is late goes on with the newest."""

    whole = False

    def __init__(self, times_ns: Sequence[int], period_ns: int) -> None:
        self._times, self._period = times_ns, period_ns

    def first(self, now_ns: int) -> int:
        return self._latest(now_ns) + 1

    def due_ns(self, tick: int) -> int:
        turn, place = divmod(tick, len(self._times))
        return turn * self._period + self._times[place]

    def after(self, tick: int, now_ns: int) -> tuple[int | None, int]:
        latest = self._latest(now_ns)
        return max(tick + 1, latest), max(0, latest - tick - 1)

    def _latest(self, now_ns: int) -> int:
        turn, since = divmod(now_ns, self._period)
        return turn * len(self._times) + bisect_right(self._times, since) - 1
