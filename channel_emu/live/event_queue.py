"""Schedules the links' events on the wall clock, with one exact timer for any number of links."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from channel_emu.live.timer import LoopTimer
from channel_emu.model.nanoseconds import NEVER_NS
from freshfield.clock import Clock


class Scheduled(Protocol):
    """A link with events."""

    @property
    def next_event_ns(self) -> int: ...

    def advance(self, now_ns: int) -> None:
        """Process the events up to the channel's instant ``now_ns``."""


class EventQueue:
    """Calls ``advance`` on each link that has an event due. Needs a running event loop.

    origin_ns: the clock's reading at the channel's instant zero.
    failed: called with what ``advance`` raises. An exception in the timer's callback would only be logged,
        and later messages would not leave.
    shared: whether the links compete for one server, so that an event of one may change the next event of
        all.
    """

    def __init__(
        self, clock: Clock, origin_ns: int, failed: Callable[[BaseException], None], shared: bool = False
    ) -> None:
        self.due_ns: dict[Scheduled, int] = {}
        """Instant of each link's next event."""
        self._clock = clock
        self._origin_ns = origin_ns
        self._failed = failed
        self._shared = shared
        self._timer = LoopTimer(self._fire)
        self._timer_ns = NEVER_NS

    def now_ns(self) -> int:
        """The channel's current instant."""
        return self._clock.now_ns() - self._origin_ns

    def schedule(self, link: Scheduled) -> None:
        """Schedule the next event of a link that is new or has changed, and of those that share its server."""
        self._look_at(link)
        self._arm()

    def close(self) -> None:
        self._timer.close()

    def _look_at(self, link: Scheduled) -> None:
        self.due_ns[link] = link.next_event_ns
        if self._shared:
            for other in self.due_ns:
                self.due_ns[other] = other.next_event_ns

    def _arm(self) -> None:
        next_ns = min(self.due_ns.values())
        if next_ns < self._timer_ns:
            self._timer_ns = next_ns
            self._timer.arm(next_ns - self.now_ns())

    def _fire(self) -> None:
        now_ns = self.now_ns()
        self._timer_ns = NEVER_NS
        try:
            while min(self.due_ns.values()) <= now_ns:
                link = min(self.due_ns, key=self.due_ns.__getitem__)
                link.advance(now_ns)
                self._look_at(link)
            self._arm()
        except Exception as error:
            self._failed(error)
