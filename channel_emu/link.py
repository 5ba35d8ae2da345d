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

from channel_emu.instants import NEVER_NS
from channel_emu.service import NoService, Service
from channel_emu.traffic import PoissonArrivals

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
    queue_limit: frames waiting (fcfs) or in service (parallel) at most; more are dropped_busy.
    """

    def __init__(
        self,
        camera: str,
        discipline: str,
        service: Service | NoService,
        arrivals: PoissonArrivals | None = None,
        faults: Sequence[Fault] = (),
        queue_limit: int = 1024,
    ) -> None:
        if discipline not in DISCIPLINES:
            raise ValueError(f"discipline {discipline!r} is not one of {', '.join(DISCIPLINES)}")
        self.camera = camera
        self.discipline = discipline
        self.queue_limit = queue_limit
        self.counts: Counter[str] = Counter()
        self.offered = 0
        self.clock_backwards = 0
        """Times at which the caller's clock ran backwards and was held."""
        self.resets = 0
        """Times at which a fault reset the camera's stream."""
        self.now_ns = 0
        self.chain = service.chain
        self._service = service
        self._arrivals = arrivals
        self._faults = tuple(faults)
        self._serving: list[tuple[int, int, Transit]] = []  # heap of (due, number)
        self._waiting: deque[Transit] = deque()
        self._unsampled: Transit | None = None
        self._sample_ns = NEVER_NS
        self._reset_ns = min((f.next_reset_ns(-1) for f in self._faults), default=NEVER_NS)
        self._events: list[Event] = []

    @property
    def in_flight(self) -> int:
        return len(self._serving) + len(self._waiting) + (self._unsampled is not None)

    @property
    def next_event_ns(self) -> int:
        """Instant of the next thing that happens without an offer; NEVER_NS if nothing will."""
        due = self._serving[0][0] if self._serving else NEVER_NS
        return min(due, self._sample_ns, self._reset_ns)

    def offer(self, at_ns: int, item: Any = None, size_bytes: int = 0) -> tuple[Transit, list[Event]]:
        """The camera offers a frame. Returns it and everything that happened up to and at this instant.

        What was due at this very instant comes first: a frame that completes on the boundary makes room for
        the frame of that boundary. ``transit.outcome`` says at once whether it was dropped.
        """
        at_ns = self._hold(at_ns)
        self._run_to(at_ns)
        transit = Transit(self.offered, item, size_bytes, at_ns)
        self.offered += 1
        if self._arrivals is None:
            self._arrive(transit, at_ns)
        else:
            if self._unsampled is not None:
                self._end(self._unsampled, Kind.SKIPPED, at_ns)
            self._unsampled = transit
            self._sample_ns = self._arrivals.next_ns(at_ns, transit.number)
        self._run_to(at_ns)
        return transit, self._take_events()

    def advance(self, to_ns: int) -> list[Event]:
        """Everything that happens up to and at ``to_ns``, in order."""
        self._run_to(self._hold(to_ns))
        return self._take_events()

    def pending(self) -> list[Transit]:
        """The frames now inside, oldest first."""
        inside = [t for _, _, t in self._serving] + list(self._waiting)
        if self._unsampled is not None:
            inside.append(self._unsampled)
        return sorted(inside, key=lambda t: t.number)

    def _hold(self, at_ns: int) -> int:
        if at_ns < self.now_ns:
            self.clock_backwards += 1
            return self.now_ns
        self.now_ns = at_ns
        return at_ns

    def _take_events(self) -> list[Event]:
        events, self._events = self._events, []
        return events

    def _run_to(self, to_ns: int) -> None:
        while (at_ns := self.next_event_ns) <= to_ns and at_ns < NEVER_NS:
            if self._serving and self._serving[0][0] == at_ns:
                self._complete(at_ns)
            elif self._reset_ns == at_ns:
                self._break(at_ns)
                self.resets += 1
                self._reset_ns = min(f.next_reset_ns(at_ns) for f in self._faults)
            else:
                transit, self._unsampled, self._sample_ns = self._unsampled, None, NEVER_NS
                assert transit is not None
                self._arrive(transit, at_ns)

    def _arrive(self, transit: Transit, at_ns: int) -> None:
        if not self._serving:
            self._start(transit, at_ns)
        elif self.discipline == "drop-new":
            self._end(transit, Kind.DROPPED_BUSY, at_ns)
        elif self.discipline == "newest-waits":
            if self._waiting:
                self._end(self._waiting.popleft(), Kind.SUPERSEDED, at_ns)
            self._waiting.append(transit)
        elif self.discipline == "fcfs":
            if len(self._waiting) >= self.queue_limit:
                self._end(transit, Kind.DROPPED_BUSY, at_ns)
            else:
                self._waiting.append(transit)
        elif self.discipline == "lcfs-preempt":
            self._end(heapq.heappop(self._serving)[2], Kind.SUPERSEDED, at_ns)
            self._start(transit, at_ns)
        elif len(self._serving) >= self.queue_limit:
            self._end(transit, Kind.DROPPED_BUSY, at_ns)
        else:
            self._start(transit, at_ns)

    def _start(self, transit: Transit, at_ns: int) -> None:
        transit.started_ns = at_ns
        due_ns, transit.state = self._service.due_ns(at_ns, transit.number)
        for fault in self._faults:
            due_ns = min(due_ns + fault.extra_ns(transit), NEVER_NS)
        transit.due_ns = due_ns
        heapq.heappush(self._serving, (due_ns, transit.number, transit))
        self._events.append(Event(Kind.STARTED, at_ns, transit))

    def _complete(self, at_ns: int) -> None:
        transit = heapq.heappop(self._serving)[2]
        if self._faults and any(fault.loses(transit) for fault in self._faults):
            self._end(transit, Kind.LOST, at_ns)
        else:
            for fault in self._faults:
                transit.flips += fault.flips(transit)
            self._end(transit, Kind.DELIVERED, at_ns)
            if self._faults and any(fault.duplicates(transit) for fault in self._faults):
                self.counts[Kind.DUPLICATED] += 1
                self._events.append(Event(Kind.DUPLICATED, at_ns, transit))
        if self._waiting:
            self._start(self._waiting.popleft(), at_ns)

    def _break(self, at_ns: int) -> None:
        for transit in self.pending():
            self._end(transit, Kind.BROKEN, at_ns)
        self._serving.clear()
        self._waiting.clear()
        self._unsampled, self._sample_ns = None, NEVER_NS

    def _end(self, transit: Transit, kind: Kind, at_ns: int) -> None:
        transit.outcome = kind
        transit.ended_ns = at_ns
        self.counts[kind] += 1
        self._events.append(Event(kind, at_ns, transit))
