"""Repeats the decisions of a recorded trace live."""

from __future__ import annotations

import heapq
from collections import Counter
from typing import Any

from channel_emu.model.link import Event, EventKind, Transit
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.trace import Record, TraceError


class ReplayLink:
    """A link that repeats a recording, with the interface of ``model.link.Link``.

    Offer ``n`` gets the recorded outcome of offer ``n``, with the recorded delay after its offer. Offers at
    the recorded instants reproduce the recording exactly. After the last record it continues with the first.

    records: of this camera, in the order of their numbers. Raises TraceError if there are none.
    """

    def __init__(self, camera: str, records: list[Record]) -> None:
        if not records:
            raise TraceError(f"the trace holds no frame of {camera}")
        self.camera = camera
        self.counts: Counter[str] = Counter()
        self.offered = 0
        self.clock_backwards = 0
        self.resets = 0
        self.now_ns = 0
        self.chain = None
        self._records = records
        self._events: list[tuple[int, int, EventKind, Transit]] = []
        self._inside: set[int] = set()
        self._order = 0

    @property
    def in_flight(self) -> int:
        return len(self._inside)

    @property
    def next_event_ns(self) -> int:
        return self._events[0][0] if self._events else NEVER_NS

    def offer(self, at_ns: int, item: Any = None, size_bytes: int = 0) -> tuple[Transit, list[Event]]:
        events = self.advance(at_ns)
        at_ns = self.now_ns
        record = self._records[self.offered % len(self._records)]
        shift = at_ns - record.offered_ns
        transit = Transit(self.offered, item, size_bytes, at_ns, state=record.state, flips=record.flips)
        self.offered += 1
        self._inside.add(transit.number)
        if record.arrived_ns is not None:
            transit.arrived_ns = record.arrived_ns + shift
        if record.started_ns is not None and record.due_ns is not None:
            transit.due_ns = min(record.due_ns + shift, NEVER_NS)
            self._schedule(record.started_ns + shift, EventKind.STARTED, transit)
        outcome, ended_ns = record.outcome, record.ended_ns
        if outcome is None or ended_ns is None:
            # The outcome was not recorded. The due instant was recorded if transmission had started.
            outcome = EventKind.SUPERSEDED if record.due_ns is None else EventKind.DELIVERED
            ended_ns = record.due_ns if record.due_ns is not None else record.offered_ns
        self._schedule(ended_ns + shift, EventKind(outcome), transit)
        if record.duplicated:
            self._schedule(ended_ns + shift, EventKind.DUPLICATED, transit)
        return transit, events + self.advance(at_ns)

    def advance(self, to_ns: int) -> list[Event]:
        if to_ns < self.now_ns:
            self.clock_backwards += 1
        self.now_ns = max(self.now_ns, to_ns)
        events = []
        while self._events and self._events[0][0] <= self.now_ns and self._events[0][0] < NEVER_NS:
            at_ns, _, kind, transit = heapq.heappop(self._events)
            if kind is EventKind.STARTED:
                transit.started_ns = at_ns
            else:
                self.counts[kind] += 1
                if kind is not EventKind.DUPLICATED:
                    transit.outcome, transit.ended_ns = kind, at_ns
                    self._inside.discard(transit.number)
            events.append(Event(kind, at_ns, transit))
        return events

    def pending(self) -> list[Transit]:
        """The messages inside the link, oldest first."""
        inside = {t.number: t for _, _, _, t in self._events if t.number in self._inside}
        return [inside[number] for number in sorted(inside)]

    def _schedule(self, at_ns: int, kind: EventKind, transit: Transit) -> None:
        self._order += 1
        heapq.heappush(self._events, (min(at_ns, NEVER_NS), self._order, kind, transit))
