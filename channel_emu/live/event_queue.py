"""Schedules the links' events on the wall clock, with one exact timer for any number of links."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Protocol

from channel_emu.live.timer import LoopTimer
from channel_emu.model.nanoseconds import NEVER_NS
from freshfield.clock import Clock

# Outdated entries are removed once there are more than four entries a link plus this many.
_SLACK = 16


class Scheduled(Protocol):
    """An entry's link. ``scheduled_ns`` belongs to the queue; it is -1 at first."""

    scheduled_ns: int

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
        self.entries: list[tuple[int, int, Scheduled]] = []
        """Heap of (instant, order, link). An entry is outdated if its link is no longer scheduled for it."""
        self._clock = clock
        self._origin_ns = origin_ns
        self._failed = failed
        self._sharing: dict[int, Scheduled] | None = {} if shared else None
        self._timer = LoopTimer(self._fire)
        self._timer_ns = NEVER_NS
        self._order = 0
        self._most = _SLACK

    def now_ns(self) -> int:
        """The channel's current instant."""
        return self._clock.now_ns() - self._origin_ns

    def schedule(self, link: Scheduled) -> None:
        """Schedule the link's next event. An earlier entry of the link, if any, becomes outdated."""
        if self._sharing is not None:
            self._sharing.setdefault(id(link), link)
        next_ns = link.next_event_ns
        if next_ns == link.scheduled_ns:
            return
        link.scheduled_ns = next_ns
        if next_ns >= NEVER_NS:
            return
        self._order += 1
        heapq.heappush(self.entries, (next_ns, self._order, link))
        if len(self.entries) > self._most:
            self._remove_outdated()
        if next_ns < self._timer_ns:
            self._timer_ns = next_ns
            self._timer.arm(next_ns - self.now_ns())

    def reschedule(self, link: Scheduled) -> None:
        """After a change of the link: schedule its next event, and those of links that share its server."""
        self.schedule(link)
        for other in tuple((self._sharing or {}).values()):
            self.schedule(other)

    def close(self) -> None:
        self._timer.close()

    def _remove_outdated(self) -> None:
        """Keep only current entries. Preemption would otherwise leave entries for instants far ahead."""
        current: dict[int, tuple[int, int, Scheduled]] = {}
        for entry in self.entries:
            if entry[0] == entry[2].scheduled_ns:
                current.setdefault(id(entry[2]), entry)
        self.entries = list(current.values())
        heapq.heapify(self.entries)
        self._most = 4 * len(self.entries) + _SLACK

    def _fire(self) -> None:
        try:
            self._advance_due()
        except Exception as error:
            self._failed(error)

    def _advance_due(self) -> None:
        now_ns = self.now_ns()
        while self.entries and self.entries[0][0] <= now_ns:
            at_ns, _, link = heapq.heappop(self.entries)
            if link.scheduled_ns == at_ns:
                link.scheduled_ns = -1
                link.advance(now_ns)
                self.reschedule(link)
        self._timer_ns = self.entries[0][0] if self.entries else NEVER_NS
        if self.entries:
            self._timer.arm(self._timer_ns - self.now_ns())
