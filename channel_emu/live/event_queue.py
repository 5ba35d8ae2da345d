"""When each link's next event is due, on the wall clock: one exact timer for any number of links."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Protocol

from channel_emu.live.replay_link import ReplayLink
from channel_emu.live.timer import LoopTimer
from channel_emu.model.instants import NEVER_NS
from channel_emu.model.link import Link
from freshfield.clock import Clock

# Entries beside four for each link before the outdated ones are cleared away.
_SLACK = 16


class Timed(Protocol):
    """Who has a link on the agenda. armed_ns: the agenda's own, -1 to begin with."""

    @property
    def link(self) -> Link | ReplayLink: ...

    armed_ns: int

    def advance(self, now_ns: int) -> None:
        """Do what is due up to the channel's instant ``now_ns``."""


class Agenda:
    """Calls ``advance`` on whoever's link has an event due. Must be made with an event loop running.

    origin_ns: the clock's reading at the channel's instant zero. failed: told of what ``advance`` raises; in
    the timer's callback an exception would only be logged, and every later message be stuck. shared: the
    links compete for one server, so that what happens to one changes what is next for all.
    """

    def __init__(
        self, clock: Clock, origin_ns: int, failed: Callable[[BaseException], None], shared: bool = False
    ) -> None:
        self.due: list[tuple[int, int, Timed]] = []
        """Heap of (instant, order, who); outdated where who is no longer armed for the instant."""
        self._clock = clock
        self._origin_ns = origin_ns
        self._failed = failed
        self._everybody: dict[int, Timed] | None = {} if shared else None
        self._timer = LoopTimer(self._fire)
        self._armed_ns = NEVER_NS
        self._order = 0
        self._most = _SLACK

    def now_ns(self) -> int:
        """The channel's present instant."""
        return self._clock.now_ns() - self._origin_ns

    def arm(self, who: Timed) -> None:
        """Note the next event of who's link; an earlier entry of it is passed over when it comes up."""
        if self._everybody is not None:
            self._everybody.setdefault(id(who), who)
        next_ns = who.link.next_event_ns
        if next_ns == who.armed_ns:
            return
        who.armed_ns = next_ns
        if next_ns >= NEVER_NS:
            return
        self._order += 1
        heapq.heappush(self.due, (next_ns, self._order, who))
        if len(self.due) > self._most:
            self._clear()
        if next_ns < self._armed_ns:
            self._armed_ns = next_ns
            self._timer.arm(next_ns - self.now_ns())

    def arm_touched(self, who: Timed) -> None:
        """Something happened to who's link: note its next event, and those of links that share its server."""
        self.arm(who)
        for other in tuple((self._everybody or {}).values()):
            self.arm(other)

    def close(self) -> None:
        self._timer.close()

    def _clear(self) -> None:
        """Where frames preempt each other, outdated entries would stay until their instants far ahead."""
        found: dict[int, tuple[int, int, Timed]] = {}
        for at_ns, order, who in self.due:
            if at_ns == who.armed_ns:
                found.setdefault(id(who), (at_ns, order, who))
        self.due = list(found.values())
        heapq.heapify(self.due)
        self._most = 4 * len(self.due) + _SLACK

    def _fire(self) -> None:
        try:
            self._advance_due()
        except Exception as error:
            self._failed(error)

    def _advance_due(self) -> None:
        now_ns = self.now_ns()
        while self.due and self.due[0][0] <= now_ns:
            at_ns, _, who = heapq.heappop(self.due)
            if who.armed_ns == at_ns:
                who.armed_ns = -1
                who.advance(now_ns)
                self.arm_touched(who)
        self._armed_ns = self.due[0][0] if self.due else NEVER_NS
        if self.due:
            self._timer.arm(self._armed_ns - self.now_ns())
