"""A link on the wall clock: it offers messages to the link model, acts on each decision and measures it.

It is the same for our frame stream and for any other service. What differs is done by the message's
``Receiver``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import grpc
import grpc.aio

from channel_emu.live.event_queue import EventQueue
from channel_emu.live.histogram import Histogram
from channel_emu.live.replay_link import ReplayLink
from channel_emu.model.ages import RunningAge
from channel_emu.model.link import Event, EventKind, Link, Transit
from channel_emu.model.trace import TraceWriter
from freshfield.limits import MAX_QUEUED_BYTES
from freshfield.streams import ServedCall

STREAM_ENDED = (grpc.RpcError, grpc.aio.BaseError, asyncio.InvalidStateError)
"""How gRPC says that a stream is over."""
Flips = tuple[tuple[float, int], ...]
"""Damage: (place as a fraction of the message, byte to exclusive-or with)."""


class Receiver(Protocol):
    """Passes messages on when the link has decided: one direction of a call, or a camera's frames."""

    def settle(self, message: Message, kind: EventKind) -> None:
        """DELIVERED: pass the message on. DUPLICATED: pass it on once more. Any other kind: it is dropped."""


@dataclass(slots=True)
class Message:
    """sequence: its place in its session. delivered: None until the link has decided. traced: it has its
    record in the trace."""

    raw: bytes
    session: str
    sequence: int
    receiver: Receiver
    transit: Transit | None = None
    delivered: bool | None = None
    duplicated: bool = False
    traced: bool = False


class DelayStats:
    """Histograms of one link, or of all links together.

    drawn: the delay that the link drew. latency: from receiving a message to handing it on. error: how long
    after it was due a message was handed on. total: counts what this one counts.
    """

    def __init__(self, total: DelayStats | None = None) -> None:
        self.drawn: Histogram = Histogram(None if total is None else total.drawn)
        self.latency: Histogram = Histogram(None if total is None else total.latency)
        self.error: Histogram = Histogram(None if total is None else total.error)


@dataclass
class Room:
    """held_bytes: of the messages inside some links."""

    held_bytes: int = 0


class LiveLink:
    """``offer`` messages; the event queue calls ``advance`` when something is due.

    name: decides the link's draws, together with the channel's seed. stats: its messages are counted there.
    damage: how the bytes of a message are flipped. room: for the bytes inside, shared with other links.
    """

    def __init__(
        self,
        name: str,
        model: Link | ReplayLink,
        events: EventQueue,
        stats: DelayStats,
        damage: Callable[[bytes, Flips], bytes],
        trace: TraceWriter | None = None,
        room: Room | None = None,
    ) -> None:
        self.name = name
        self.model = model
        self.scheduled_ns = -1
        self.calls: set[ServedCall] = set()
        """The open calls whose messages pass this link; a reset ends them."""
        self.stats = stats
        self.age = RunningAge()
        self.last_ns = 0
        """When a message last came in or was handed on."""
        self.forwarded = 0
        """Messages handed on."""
        self.cancelled = 0
        """Messages that the link delivered after their call was over."""
        self.overfull = 0
        """Messages dropped before the link, because there was no room for their bytes."""
        self._room = Room() if room is None else room
        self._events = events
        self._damage = damage
        self._trace = trace
        self._resets = 0

    @property
    def next_event_ns(self) -> int:
        return self.model.next_event_ns

    def has_room(self, raw: bytes) -> bool:
        """Whether a message may be offered: what is inside all links is bounded in bytes as well."""
        return self._room.held_bytes + len(raw) <= MAX_QUEUED_BYTES

    def offer(self, message: Message, at_ns: int) -> Transit:
        """A message came in at the channel's instant ``at_ns``: let the link decide, and act on it."""
        self.last_ns = at_ns
        self._room.held_bytes += len(message.raw)
        transit, events = self.model.offer(at_ns, message, len(message.raw))
        message.transit = transit
        self._act(events)
        self._events.reschedule(self)
        return transit

    def advance(self, now_ns: int) -> None:
        """Do what is due up to the channel's instant ``now_ns``."""
        self._act(self.model.advance(now_ns))

    def hand_on(self, message: Message, at_ns: int) -> None:
        """The message is being handed to gRPC: this instant counts as its actual delivery."""
        transit = message.transit
        assert transit is not None and transit.ended_ns is not None
        self.last_ns = at_ns
        self.forwarded += 1
        self.stats.latency.add((at_ns - transit.offered_ns) / 1e6)
        self.stats.error.add((at_ns - transit.ended_ns) / 1e6)
        self.age.add(at_ns, transit.offered_ns)
        self.record(message, at_ns)

    def record(self, message: Message, actual_ns: int | None = None) -> None:
        """Write the message's trace record: one for each message, however many copies of it left."""
        if self._trace is not None and message.transit is not None and not message.traced:
            message.traced = True
            self._trace.write(
                self.name, message.session, message.sequence, message.transit, actual_ns, message.duplicated
            )

    def close(self) -> None:
        """Record what is still inside."""
        for transit in self.model.pending():
            self.record(transit.item)

    def _act(self, events: list[Event]) -> None:
        for event in events:
            if event.kind is EventKind.DUPLICATED:  # the record of the first copy says so already
                event.transit.item.duplicated = True
        for event in events:
            message: Message = event.transit.item
            kind = event.kind
            if kind is EventKind.STARTED:
                self.stats.drawn.add((event.transit.drawn_ns or 0) / 1e6)
                continue
            # Without a reference cycle, which would keep the bytes until the next garbage collection.
            message.transit = replace(event.transit, item=None)
            if kind is not EventKind.DUPLICATED:
                self._room.held_bytes -= len(message.raw)
            if kind is EventKind.DELIVERED and event.transit.flips:
                message.raw = self._damage(message.raw, event.transit.flips)
            message.receiver.settle(message, kind)
            if kind is not EventKind.DELIVERED and kind is not EventKind.DUPLICATED:
                self.record(message)
        if self.model.resets != self._resets:
            self._resets = self.model.resets
            for call in list(self.calls):
                call.end(grpc.StatusCode.UNAVAILABLE, "the emulated network reset this stream")
