"""One camera's link: decides the outcome of each frame. It reads no clock; the caller passes the time.

Every instant is int64 nanoseconds since the channel's origin. Random numbers are looked up by (camera, offer
number), so the decisions depend only on the seed and on when frames were offered. They stay the same if the
caller advances the link late (a stalled process).
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Literal, get_args

from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.queue_server import QueueServer
from channel_emu.model.service_time import ServiceTime
from channel_emu.model.traffic import PoissonArrivals

Discipline = Literal["drop-new", "newest-waits", "fcfs", "lcfs-preempt", "parallel"]
DISCIPLINES: tuple[Discipline, ...] = get_args(Discipline)
FITTED_DISCIPLINES = tuple(d for d in DISCIPLINES if d != "lcfs-preempt")
"""Disciplines that can be fitted to a recording. lcfs-preempt delivers only fast frames, which biases the
delays."""

MAX_SIZE_BYTES = 2**32 - 1
"""Largest size of a message: gRPC writes the length in 32 bits."""


class EventKind(StrEnum):
    """What can happen to a frame. All but STARTED and DUPLICATED end its transit."""

    STARTED = "started"
    DELIVERED = "delivered"
    DUPLICATED = "duplicated"  # a second copy follows the delivered one
    DROPPED_BUSY = "dropped_busy"  # the server, or the queue, was full
    SUPERSEDED = "superseded"  # a newer frame took its place
    SKIPPED = "skipped"  # never sampled by the arrival process
    LOST = "lost"  # by a fault
    BROKEN = "broken"  # the stream ended while the frame was inside the link


@dataclass(slots=True)
class Transit:
    """One offered frame inside the link. Instants are None until they are known.

    number: of the offer, from 0. item: the caller's object, not looked at.
    due_ns: when transmission ends. ended_ns: when ``outcome`` was decided.
    """

    number: int
    item: Any
    size_bytes: int
    offered_ns: int
    arrived_ns: int | None = None
    """When it arrived at the server: at its offer, or when the arrival process sampled it."""
    started_ns: int | None = None
    due_ns: int | None = None
    state: int = 0
    """The chain's state when transmission started."""
    outcome: EventKind | None = None
    ended_ns: int | None = None
    ticket: int = 0
    """Number of the arrival at the server; a frame that replaces a waiting one inherits its ticket."""
    flips: tuple[tuple[float, int], ...] = ()
    """Damaged bytes: (position as a fraction of the payload, non-zero byte to XOR with)."""

    @property
    def drawn_ns(self) -> int | None:
        """The delay the link drew, once transmission has started."""
        return None if self.started_ns is None or self.due_ns is None else self.due_ns - self.started_ns


@dataclass(frozen=True, slots=True)
class Event:
    """What happened to a frame, and when."""

    kind: EventKind
    at_ns: int
    transit: Transit


class Fault:
    """Base class of the faults; it changes nothing itself."""

    by_size: ClassVar[bool] = False
    """Whether the fault depends on the size of a frame."""

    def extra_ns(self, transit: Transit) -> int:
        """Nanoseconds to add to the frame's delay; asked when transmission starts."""
        return 0

    def loses(self, transit: Transit) -> bool:
        """Whether the frame is lost; asked when it is due."""
        return False

    def duplicates(self, transit: Transit) -> bool:
        """Whether a second copy follows; asked when the frame is delivered."""
        return False

    def flips(self, transit: Transit) -> tuple[tuple[float, int], ...]:
        """Damage to the payload, see ``Transit.flips``."""
        return ()

    def next_reset_ns(self, after_ns: int) -> int:
        """Instant of the first reset of the camera's stream after ``after_ns``; NEVER_NS if none."""
        return NEVER_NS


class Link:
    """Usage: ``offer`` frames, ``advance`` to ``next_event_ns``, and handle the events that both return.

    camera: name of the link.
    discipline: one of DISCIPLINES; ``queue_server`` explains them.
    service: draws the delay of each frame.
    arrivals: a Poisson process that samples the newest offered frame; a frame that is replaced before the
        next arrival is ``skipped``. None: every offer is an arrival.
    faults: applied in this order.
    server: may be shared with other links; None makes one for this link alone. ``offer`` and ``advance``
        advance all links of a shared server. The other links keep their events until they are advanced
        themselves; until then their ``next_event_ns`` is not later than now.
    Raises ValueError for an unknown discipline, or if the server already has a link of this name.
    """

    def __init__(
        self,
        camera: str,
        discipline: str,
        service: ServiceTime,
        arrivals: PoissonArrivals | None = None,
        faults: Sequence[Fault] = (),
        server: QueueServer | None = None,
    ) -> None:
        if discipline not in DISCIPLINES:
            raise ValueError(f"discipline {discipline!r} is not one of {', '.join(DISCIPLINES)}")
        self.camera = camera
        self.discipline = discipline
        self.counts: Counter[str] = Counter()
        self.offered = 0
        self.clock_backwards = 0
        """How often the caller's clock ran backwards; the link then keeps the later time."""
        self.resets = 0
        """How often a fault reset the camera's stream."""
        self.chain = service.chain
        self.waiting: deque[Transit] = deque()
        self.server = server or QueueServer()
        self._service = service
        self._arrivals = arrivals
        self._faults = tuple(faults)
        self._serving: list[tuple[int, int, Transit]] = []  # heap of (due, number)
        self._unsampled: Transit | None = None
        self._sample_ns = NEVER_NS
        self._next_reset_ns = min((f.next_reset_ns(-1) for f in self._faults), default=NEVER_NS)
        self._events: list[Event] = []
        self._unread_since_ns = NEVER_NS  # instant of the first event that the caller has not taken
        self.own_event_ns = self._next_reset_ns
        """Like ``next_event_ns``, without events that already happened."""
        self.server.add(self)

    @property
    def by_size(self) -> bool:
        """Whether a fault depends on the size of a frame."""
        return any(fault.by_size for fault in self._faults)

    @property
    def in_flight(self) -> int:
        """Number of frames inside the link."""
        return len(self._serving) + len(self.waiting) + (self._unsampled is not None)

    @property
    def next_event_ns(self) -> int:
        """Instant of the next event if this camera offers no further frame; NEVER_NS if there is none."""
        return min(self.own_event_ns, self._unread_since_ns)

    @property
    def tie_break(self) -> tuple[int, int]:
        """Orders the events of several links at one instant: the least comes first."""
        at_ns = self.own_event_ns
        if self._serving and self._serving[0][0] == at_ns:
            return 0, 0
        if self._next_reset_ns == at_ns or self._unsampled is None:
            return 1, 0
        return 2, self._unsampled.offered_ns

    def offer(self, at_ns: int, item: Any = None, size_bytes: int = 0) -> tuple[Transit, list[Event]]:
        """Offer a frame. Returns its transit and all events up to and including ``at_ns``, in order.

        at_ns: now. item: any object of the caller. size_bytes: used by faults only.
        Events due at ``at_ns`` are processed first, so a frame that completes now makes room for the new one.
        ``transit.outcome`` is set at once if the frame was dropped.
        """
        at_ns = self._clamp(at_ns)
        self.server.advance_to(at_ns)
        transit = Transit(self.offered, item, size_bytes, at_ns)
        self.offered += 1
        if self._arrivals is None:
            self._arrive(transit, at_ns)
        else:
            if self._unsampled is not None:
                self._end(self._unsampled, EventKind.SKIPPED, at_ns)
            self._unsampled = transit
            self._sample_ns = self._arrivals.next_ns(at_ns, transit.number)
            self._update_next_event()
        self.server.advance_to(at_ns)
        return transit, self._take_events()

    def advance(self, to_ns: int) -> list[Event]:
        """Process and return all events up to and including ``to_ns``, in order."""
        self.server.advance_to(self._clamp(to_ns))
        return self._take_events()

    def change(
        self, at_ns: int, service: ServiceTime, arrivals: PoissonArrivals | None, faults: Sequence[Fault]
    ) -> list[Event]:
        """Process the events up to ``at_ns``; from then on, use these service times, arrivals and faults. Returns the
        events in order.

        Frames in service keep their due instants; the new faults decide whether they arrive.
        """
        at_ns = self._clamp(at_ns)
        self.server.advance_to(at_ns)
        self._service, self._arrivals, self._faults = service, arrivals, tuple(faults)
        self._next_reset_ns = min((f.next_reset_ns(at_ns) for f in self._faults), default=NEVER_NS)
        waiting, self._unsampled, self._sample_ns = self._unsampled, None, NEVER_NS
        self._update_next_event()
        if waiting is not None:  # its sampling instant came from the previous arrival process
            self._arrive(waiting, at_ns)
        return self._take_events()

    def flush(self, at_ns: int) -> list[Event]:
        """Process the events up to ``at_ns``, then break all frames still inside. Returns all events in
        order."""
        at_ns = self._clamp(at_ns)
        self.server.advance_to(at_ns)
        self._break_all(at_ns)
        self.server.start_next(at_ns)
        return self._take_events()

    def pending(self) -> list[Transit]:
        """The frames inside the link, oldest first."""
        inside = [t for _, _, t in self._serving] + list(self.waiting)
        if self._unsampled is not None:
            inside.append(self._unsampled)
        return sorted(inside, key=lambda t: t.number)

    def step(self) -> None:
        """Process this link's next own event; called by the server."""
        at_ns = self.own_event_ns
        if self._serving and self._serving[0][0] == at_ns:
            self._complete(at_ns)
        elif self._next_reset_ns == at_ns:
            self._reset(at_ns)
        else:
            transit, self._unsampled, self._sample_ns = self._unsampled, None, NEVER_NS
            assert transit is not None
            self._update_next_event()
            self._arrive(transit, at_ns)

    def start_waiting(self, at_ns: int) -> None:
        """Start the first waiting frame; called by the server when it is free."""
        self.server.waiting -= 1
        self._start(self.waiting.popleft(), at_ns)

    def _clamp(self, at_ns: int) -> int:
        if at_ns < self.server.now_ns:
            self.clock_backwards += 1
            return self.server.now_ns
        self.server.now_ns = at_ns
        return at_ns

    def _update_next_event(self) -> None:
        """Cached, because a shared server asks every link at each step."""
        due = self._serving[0][0] if self._serving else NEVER_NS
        self.own_event_ns = min(due, self._sample_ns, self._next_reset_ns)

    def _take_events(self) -> list[Event]:
        events, self._events, self._unread_since_ns = self._events, [], NEVER_NS
        return events

    def _record(self, kind: EventKind, at_ns: int, transit: Transit) -> None:
        self._events.append(Event(kind, at_ns, transit))
        self._unread_since_ns = min(self._unread_since_ns, at_ns)

    def _arrive(self, transit: Transit, at_ns: int) -> None:
        server = self.server
        transit.arrived_ns = at_ns
        transit.ticket = server.issue_ticket()
        if not server.busy:
            self._start(transit, at_ns)
        elif self.discipline == "drop-new":
            self._end(transit, EventKind.DROPPED_BUSY, at_ns)
        elif self.discipline == "newest-waits":
            if self.waiting:
                server.waiting -= 1
                older = self.waiting.popleft()
                transit.ticket = older.ticket
                self._end(older, EventKind.SUPERSEDED, at_ns)
            self._wait(transit)
        elif self.discipline == "fcfs":
            if server.waiting >= server.queue_limit:
                self._end(transit, EventKind.DROPPED_BUSY, at_ns)
            else:
                self._wait(transit)
        elif self.discipline == "lcfs-preempt":
            assert server.last_started is not None
            server.last_started.preempt(at_ns)
            self._start(transit, at_ns)
        elif server.busy >= server.queue_limit:
            self._end(transit, EventKind.DROPPED_BUSY, at_ns)
        else:
            self._start(transit, at_ns)

    def _wait(self, transit: Transit) -> None:
        self.server.waiting += 1
        self.waiting.append(transit)

    def preempt(self, at_ns: int) -> None:
        """End the frame in service, because a newer one of any camera replaces it."""
        self.server.busy -= 1
        self._end(heapq.heappop(self._serving)[2], EventKind.SUPERSEDED, at_ns)
        self._update_next_event()

    def _start(self, transit: Transit, at_ns: int) -> None:
        transit.started_ns = at_ns
        due_ns, transit.state = self._service.due_ns(at_ns, transit.number)
        for fault in self._faults:
            due_ns = min(due_ns + fault.extra_ns(transit), NEVER_NS)
        transit.due_ns = due_ns
        heapq.heappush(self._serving, (due_ns, transit.number, transit))
        self._update_next_event()
        self.server.busy += 1
        self.server.last_started = self
        self._record(EventKind.STARTED, at_ns, transit)

    def _complete(self, at_ns: int) -> None:
        transit = heapq.heappop(self._serving)[2]
        self._update_next_event()
        self.server.busy -= 1
        if self._faults and any(fault.loses(transit) for fault in self._faults):
            self._end(transit, EventKind.LOST, at_ns)
        else:
            for fault in self._faults:
                transit.flips += fault.flips(transit)
            self._end(transit, EventKind.DELIVERED, at_ns)
            if self._faults and any(fault.duplicates(transit) for fault in self._faults):
                self._duplicate(transit, at_ns)
        self.server.start_next(at_ns)

    def _duplicate(self, transit: Transit, at_ns: int) -> None:
        self.counts[EventKind.DUPLICATED] += 1
        self._record(EventKind.DUPLICATED, at_ns, transit)

    def _reset(self, at_ns: int) -> None:
        self._break_all(at_ns)
        self.resets += 1
        self._next_reset_ns = min(f.next_reset_ns(at_ns) for f in self._faults)
        self._update_next_event()
        self.server.start_next(at_ns)

    def _break_all(self, at_ns: int) -> None:
        for transit in self.pending():
            self._end(transit, EventKind.BROKEN, at_ns)
        self.server.busy -= len(self._serving)
        self.server.waiting -= len(self.waiting)
        self._serving.clear()
        self.waiting.clear()
        self._unsampled, self._sample_ns = None, NEVER_NS
        self._unread_since_ns = min(self._unread_since_ns, at_ns)
        self._update_next_event()

    def _end(self, transit: Transit, kind: EventKind, at_ns: int) -> None:
        transit.outcome = kind
        transit.ended_ns = at_ns
        self.counts[kind] += 1
        self._record(kind, at_ns, transit)
