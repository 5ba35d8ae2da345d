"""One camera's link: decides what becomes of each frame. Pure: it is told the time, it never asks.

Every instant is int64 nanoseconds since the channel's origin. All randomness is looked up by (camera, offer
number), so a link's decisions are a function of when it was offered frames and of the seed, and nothing else.
A link that is told of its own events late (a stalled process) still decides as if it had been punctual.
"""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

from channel_emu.model.instants import NEVER_NS
from channel_emu.model.queue_server import Server
from channel_emu.model.service_time import NoService, Service
from channel_emu.model.traffic import PoissonArrivals

DISCIPLINES = ("drop-new", "newest-waits", "fcfs", "lcfs-preempt", "parallel")


class Kind(StrEnum):
    """What can happen to a frame. All but STARTED and DUPLICATED end its stay in the link."""

    STARTED = "started"
    DELIVERED = "delivered"
    DUPLICATED = "duplicated"  # a second copy comes out beside the delivered one
    DROPPED_BUSY = "dropped_busy"  # the server, or the queue, was full
    SUPERSEDED = "superseded"  # a newer frame took its place
    SKIPPED = "skipped"  # never sampled by the arrival process
    LOST = "lost"
    BROKEN = "broken"  # the stream was reset under it


@dataclass(slots=True)
class Transit:
    """One offered frame on its way. Instants are None until they are known."""

    number: int
    item: Any
    size_bytes: int
    offered_ns: int
    started_ns: int | None = None
    due_ns: int | None = None
    state: int = 0
    """The chain's state when transmission started."""
    outcome: Kind | None = None
    ended_ns: int | None = None
    turn: int = 0
    """Of its arrivals the server counts each; a frame that replaces a waiting one may inherit its turn."""
    flips: tuple[tuple[float, int], ...] = ()
    """Damage: (place as a fraction of the payload, byte to exclusive-or with)."""

    @property
    def drawn_ns(self) -> int | None:
        """The delay the link drew, once transmission has started."""
        return None if self.started_ns is None or self.due_ns is None else self.due_ns - self.started_ns


@dataclass(frozen=True, slots=True)
class Event:
    kind: Kind
    at_ns: int
    transit: Transit


class Fault(Protocol):
    """What a fault may do to a transit; ``faults.NoFault`` does nothing and is their base."""

    def extra_ns(self, transit: Transit) -> int: ...
    def loses(self, transit: Transit) -> bool: ...
    def duplicates(self, transit: Transit) -> bool: ...
    def flips(self, transit: Transit) -> tuple[tuple[float, int], ...]: ...
    def next_reset_ns(self, after_ns: int) -> int: ...


class Link:
    """``offer`` frames, ``advance`` to an instant, ask for ``next_event_ns``: all there is.

    arrivals: with a Poisson process, a frame waits where it is offered until the process's next arrival
    samples it; a newer one takes its place there (``skipped``). None: every offer is an arrival.
    server: the line, which other links may have joined; None makes one for this link alone. Links that share
    one must be told of time together: what one caller's ``offer`` or ``advance`` makes happen to another
    camera's frames waits in that camera's link, whose ``next_event_ns`` is then no later than now.
    """

    def __init__(
        self,
        camera: str,
        discipline: str,
        service: Service | NoService,
        arrivals: PoissonArrivals | None = None,
        faults: Sequence[Fault] = (),
        server: Server | None = None,
    ) -> None:
        if discipline not in DISCIPLINES:
            raise ValueError(f"discipline {discipline!r} is not one of {', '.join(DISCIPLINES)}")
        self.camera = camera
        self.discipline = discipline
        self.counts: Counter[str] = Counter()
        self.offered = 0
        self.clock_backwards = 0
        """Times at which the caller's clock ran backwards and was held."""
        self.resets = 0
        """Times at which a fault reset the camera's stream."""
        self.chain = service.chain
        self.waiting: deque[Transit] = deque()
        self.newest_delivered_ns = -1
        """Instant at which the newest frame that was delivered had been offered."""
        self.server = server or Server()
        self._service = service
        self._arrivals = arrivals
        self._faults = tuple(faults)
        self._serving: list[tuple[int, int, Transit]] = []  # heap of (due, number)
        self._unsampled: Transit | None = None
        self._sample_ns = NEVER_NS
        self._reset_ns = min((f.next_reset_ns(-1) for f in self._faults), default=NEVER_NS)
        self._events: list[Event] = []
        self._news_ns = NEVER_NS  # since when something has happened that the caller was not told
        self.own_event_ns = self._reset_ns
        """As ``next_event_ns``, without what has happened already."""
        self.server.join(self)

    @property
    def queue_limit(self) -> int:
        """Frames waiting (fcfs) or in service (parallel) at most; more are dropped_busy."""
        return self.server.queue_limit

    @property
    def in_flight(self) -> int:
        return len(self._serving) + len(self.waiting) + (self._unsampled is not None)

    @property
    def next_event_ns(self) -> int:
        """Instant of the next thing that happens without an offer of this camera, as far as is known now;
        NEVER_NS if nothing will."""
        return min(self.own_event_ns, self._news_ns)

    @property
    def urgency(self) -> tuple[int, int]:
        """Which of several links' events at one instant comes first: the least."""
        at_ns = self.own_event_ns
        if self._serving and self._serving[0][0] == at_ns:
            return 0, 0
        if self._reset_ns == at_ns or self._unsampled is None:
            return 1, 0
        return 2, self._unsampled.offered_ns

    def offer(self, at_ns: int, item: Any = None, size_bytes: int = 0) -> tuple[Transit, list[Event]]:
        """The camera offers a frame. Returns it and everything that happened up to and at this instant.

        What was due at this very instant comes first: a frame that completes on the boundary makes room for
        the frame of that boundary. ``transit.outcome`` says at once whether it was dropped.
        """
        at_ns = self._hold(at_ns)
        self.server.run_to(at_ns)
        transit = Transit(self.offered, item, size_bytes, at_ns)
        self.offered += 1
        if self._arrivals is None:
            self._arrive(transit, at_ns)
        else:
            if self._unsampled is not None:
                self._end(self._unsampled, Kind.SKIPPED, at_ns)
            self._unsampled = transit
            self._sample_ns = self._arrivals.next_ns(at_ns, transit.number)
            self._reckon()
        self.server.run_to(at_ns)
        return transit, self._take_events()

    def advance(self, to_ns: int) -> list[Event]:
        """Everything that happens up to and at ``to_ns``, in order."""
        self.server.run_to(self._hold(to_ns))
        return self._take_events()

    def flush(self, at_ns: int) -> list[Event]:
        """Break off everything inside at ``at_ns``, after what is due up to it; the events, in order."""
        at_ns = self._hold(at_ns)
        self.server.run_to(at_ns)
        self._empty(at_ns)
        self.server.feed(at_ns)
        return self._take_events()

    def pending(self) -> list[Transit]:
        """The frames now inside, oldest first."""
        inside = [t for _, _, t in self._serving] + list(self.waiting)
        if self._unsampled is not None:
            inside.append(self._unsampled)
        return sorted(inside, key=lambda t: t.number)

    def step(self) -> None:
        """Let the next of this link's own events happen; the server calls it in turn."""
        at_ns = self.own_event_ns
        if self._serving and self._serving[0][0] == at_ns:
            self._complete(at_ns)
        elif self._reset_ns == at_ns:
            self._break(at_ns)
        else:
            transit, self._unsampled, self._sample_ns = self._unsampled, None, NEVER_NS
            assert transit is not None
            self._reckon()
            self._arrive(transit, at_ns)

    def start_waiting(self, at_ns: int) -> None:
        """The server is free and this link's turn has come."""
        self.server.waiting -= 1
        self._start(self.waiting.popleft(), at_ns)

    def _hold(self, at_ns: int) -> int:
        if at_ns < self.server.now_ns:
            self.clock_backwards += 1
            return self.server.now_ns
        self.server.now_ns = at_ns
        return at_ns

    def _reckon(self) -> None:
        """Which event is next; a shared server asks every link at each step, so it is kept, not found."""
        due = self._serving[0][0] if self._serving else NEVER_NS
        self.own_event_ns = min(due, self._sample_ns, self._reset_ns)

    def _take_events(self) -> list[Event]:
        events, self._events, self._news_ns = self._events, [], NEVER_NS
        return events

    def _tell(self, kind: Kind, at_ns: int, transit: Transit) -> None:
        self._events.append(Event(kind, at_ns, transit))
        self._news_ns = min(self._news_ns, at_ns)

    def _arrive(self, transit: Transit, at_ns: int) -> None:
        server = self.server
        transit.turn = server.next_turn()
        if not server.busy:
            self._start(transit, at_ns)
        elif self.discipline == "drop-new":
            self._end(transit, Kind.DROPPED_BUSY, at_ns)
        elif self.discipline == "newest-waits":
            if self.waiting:
                server.waiting -= 1
                older = self.waiting.popleft()
                if server.order == "fcfs":
                    transit.turn = older.turn
                self._end(older, Kind.SUPERSEDED, at_ns)
            self._wait(transit)
        elif self.discipline == "fcfs":
            if server.waiting >= server.queue_limit:
                self._end(transit, Kind.DROPPED_BUSY, at_ns)
            else:
                self._wait(transit)
        elif self.discipline == "lcfs-preempt":
            assert server.served is not None
            server.served._yield(at_ns)
            self._start(transit, at_ns)
        elif server.busy >= server.queue_limit:
            self._end(transit, Kind.DROPPED_BUSY, at_ns)
        else:
            self._start(transit, at_ns)

    def _wait(self, transit: Transit) -> None:
        self.server.waiting += 1
        self.waiting.append(transit)

    def _yield(self, at_ns: int) -> None:
        """Give up the frame in service to a newer one."""
        self.server.busy -= 1
        self._end(heapq.heappop(self._serving)[2], Kind.SUPERSEDED, at_ns)
        self._reckon()

    def _start(self, transit: Transit, at_ns: int) -> None:
        transit.started_ns = at_ns
        due_ns, transit.state = self._service.due_ns(at_ns, transit.number)
        for fault in self._faults:
            due_ns = min(due_ns + fault.extra_ns(transit), NEVER_NS)
        transit.due_ns = due_ns
        heapq.heappush(self._serving, (due_ns, transit.number, transit))
        self._reckon()
        self.server.busy += 1
        self.server.served = self
        self._tell(Kind.STARTED, at_ns, transit)

    def _complete(self, at_ns: int) -> None:
        transit = heapq.heappop(self._serving)[2]
        self._reckon()
        self.server.busy -= 1
        if self._faults and any(fault.loses(transit) for fault in self._faults):
            self._end(transit, Kind.LOST, at_ns)
        else:
            for fault in self._faults:
                transit.flips += fault.flips(transit)
            self.newest_delivered_ns = max(self.newest_delivered_ns, transit.offered_ns)
            self._end(transit, Kind.DELIVERED, at_ns)
            if self._faults and any(fault.duplicates(transit) for fault in self._faults):
                self.counts[Kind.DUPLICATED] += 1
                self._tell(Kind.DUPLICATED, at_ns, transit)
        self.server.feed(at_ns)

    def _break(self, at_ns: int) -> None:
        """A fault resets the camera's stream."""
        self._empty(at_ns)
        self.resets += 1
        self._reset_ns = min(f.next_reset_ns(at_ns) for f in self._faults)
        self._reckon()
        self.server.feed(at_ns)

    def _empty(self, at_ns: int) -> None:
        for transit in self.pending():
            self._end(transit, Kind.BROKEN, at_ns)
        self.server.busy -= len(self._serving)
        self.server.waiting -= len(self.waiting)
        self._serving.clear()
        self.waiting.clear()
        self._unsampled, self._sample_ns = None, NEVER_NS
        self._news_ns = min(self._news_ns, at_ns)
        self._reckon()

    def _end(self, transit: Transit, kind: Kind, at_ns: int) -> None:
        transit.outcome = kind
        transit.ended_ns = at_ns
        self.counts[kind] += 1
        self._tell(kind, at_ns, transit)
