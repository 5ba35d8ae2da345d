"""Repeats the decisions of a recorded trace live."""

from __future__ import annotations

import heapq

from channel_emu.model.link import EventKind, Link, Transit
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.service_time import ServiceTime, replayed
from channel_emu.model.trace import Record, TraceError

_NOT_RECORDED = Record("", "", 0, 0, 0, 0, None, None, 0, None, None, None, None)


class ReplayLink(Link):
    """A link that repeats a recording instead of making decisions.

    Offer ``n`` gets the recorded outcome of the ``n``-th offer from the first record on, with the recorded delay after
    its offer. Offers at the recorded instants reproduce the recording exactly. After the last record it continues with
    the first. An offer whose record a killed recording lost is dropped, so that those after it keep their records.

    records: of this camera, in the order of their numbers. Raises TraceError if there are none.
    """

    def __init__(self, camera: str, records: list[Record]) -> None:
        if not records:
            raise TraceError(f"the trace holds no frame of {camera}")
        super().__init__(camera, "parallel", ServiceTime(replayed([0.0]), [0.0], None))
        self._records = {record.number: record for record in records}
        self._first, self._count = records[0].number, records[-1].number + 1 - records[0].number

    def _arrive(self, transit: Transit, at_ns: int) -> None:
        record, shift = self._record_of(transit)
        transit.state, transit.flips = record.state, record.flips
        transit.arrived_ns = None if record.arrived_ns is None else record.arrived_ns + shift
        self.server.busy += 1
        if record.started_ns is None or record.due_ns is None:
            self._next_at(transit, self._end_of(transit)[1])
        else:
            transit.due_ns = min(record.due_ns + shift, NEVER_NS)
            self._next_at(transit, record.started_ns + shift)

    def _complete(self, at_ns: int) -> None:
        """A frame starts, or ends."""
        transit = heapq.heappop(self._serving)[2]
        if transit.started_ns is None and transit.due_ns is not None:
            transit.started_ns = at_ns
            self._record(EventKind.STARTED, at_ns, transit)
            self._next_at(transit, self._end_of(transit)[1])
            return
        self._update_next_event()
        self.server.busy -= 1
        self._end(transit, self._end_of(transit)[0], at_ns)
        if self._record_of(transit)[0].duplicated:
            self._duplicate(transit, at_ns)

    def _next_at(self, transit: Transit, at_ns: int) -> None:
        heapq.heappush(self._serving, (min(at_ns, NEVER_NS), transit.number, transit))
        self._update_next_event()

    def _record_of(self, transit: Transit) -> tuple[Record, int]:
        """The record of an offer, and how much later the offer is than the recorded one."""
        record = self._records.get(self._first + transit.number % self._count, _NOT_RECORDED)
        return record, transit.offered_ns - record.offered_ns

    def _end_of(self, transit: Transit) -> tuple[EventKind, int]:
        """Outcome and instant."""
        record, shift = self._record_of(transit)
        if record.outcome is not None and record.ended_ns is not None:
            return EventKind(record.outcome), record.ended_ns + shift
        # The recording ended before the outcome. The due instant was recorded if transmission had started.
        if record.due_ns is None:
            return EventKind.SUPERSEDED, transit.offered_ns
        return EventKind.DELIVERED, record.due_ns + shift
