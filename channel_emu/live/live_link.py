"""A link on the wall clock: offers messages to the link model, acts on each decision and measures delays.

It is the same for freshfield's frame stream and for any other service; the message's ``Receiver`` does what
differs.
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
from channel_emu.live.live_emulator_constants import MAX_QUEUED_BYTES
from channel_emu.model.ages import RunningAge
from channel_emu.model.channel import Channel
from channel_emu.model.link import Event, EventKind, Link, Transit
from channel_emu.model.trace import TraceWriter

STREAM_ENDED = (grpc.RpcError, grpc.aio.BaseError, asyncio.InvalidStateError)
"""Exceptions by which gRPC reports that a stream is over."""
Flips = tuple[tuple[float, int], ...]
"""Damage: (position as a fraction of the message, byte to XOR with)."""


class Receiver(Protocol):
    """Carries out the link's decisions for one direction of a call, or for one camera's frames."""

    def settle(self, message: Message, kind: EventKind) -> None:
        """DELIVERED: pass the message on. DUPLICATED: pass it on again. Any other kind: it was dropped."""


class Ends(Protocol):
    """A call, or a connection, that a reset of the link ends. ``use``: it carried a message."""

    def use(self) -> None: ...
    def end(self, code: grpc.StatusCode, details: str) -> None: ...


@dataclass(slots=True)
class Message:
    """One message in a link.

    raw: its bytes. session, sequence: of the frame; of another service, the call and the index in the call.
    delivered: None until the link has decided.
    handed_on: whether it, or its first copy, was handed to gRPC.
    traced: whether its trace record was written.
    """

    raw: bytes
    session: str
    sequence: int
    receiver: Receiver
    transit: Transit | None = None
    delivered: bool | None = None
    duplicated: bool = False
    handed_on: bool = False
    traced: bool = False


class DelayStats:
    """Histograms of one link, or of all links together.

    drawn: delay drawn by the link.
    latency: from receiving a message to handing it on.
    error: from the instant at which a message, and all that it has to wait for, was due to handing it on.
    total: further statistics that count every message of these too.
    """

    def __init__(self, total: DelayStats | None = None) -> None:
        self.drawn: Histogram = Histogram(None if total is None else total.drawn)
        self.latency: Histogram = Histogram(None if total is None else total.latency)
        self.error: Histogram = Histogram(None if total is None else total.error)


@dataclass
class ByteBudget:
    """The bytes that several links share. held_bytes: size of all messages inside them."""

    held_bytes: int = 0


class LiveLink:
    """Usage: ``offer`` messages; the event queue calls ``advance`` when an event is due.

    name: selects the link's random numbers, together with the channel's seed.
    model: makes the decisions. events: schedules the model's events.
    stats: counts the link's messages.
    damage: applies flips to the bytes of a message.
    trace: None records nothing.
    budget: limits the bytes inside, shared with other links; None: this link's own.
    """

    def __init__(
        self,
        name: str,
        model: Link,
        events: EventQueue,
        stats: DelayStats,
        damage: Callable[[bytes, Flips], bytes],
        trace: TraceWriter | None = None,
        budget: ByteBudget | None = None,
    ) -> None:
        self.name = name
        self.model = model
        self.calls: set[Ends] = set()
        """The open calls whose messages pass this link; a reset ends them."""
        self.stats = stats
        self.age = RunningAge()
        self.last_ns = 0
        """Instant at which a message last came in or was handed on."""
        self.forwarded = 0
        """Number of messages handed on."""
        self.cancelled = 0
        """Number of messages that the link delivered after their call was over."""
        self.overfull = 0
        """Number of messages dropped before the link because there was no room for their bytes."""
        self._budget = ByteBudget() if budget is None else budget
        self._events = events
        self._damage = damage
        self._trace = trace
        self._resets = 0

    @property
    def next_event_ns(self) -> int:
        return self.model.next_event_ns

    def has_room(self, raw: bytes) -> bool:
        """Whether a message may be offered: the bytes inside all links are limited (MAX_QUEUED_BYTES)."""
        return self._budget.held_bytes + len(raw) <= MAX_QUEUED_BYTES

    def offer(self, message: Message, at_ns: int) -> Transit:
        """Offer a message that came in at the channel's instant ``at_ns``, and act on all decisions due."""
        self.last_ns = at_ns
        self._budget.held_bytes += len(message.raw)
        transit, events = self.model.offer(at_ns, message, len(message.raw))
        message.transit = transit
        self._act(events)
        self._events.schedule(self)
        return transit

    def change(self, channel: Channel, at_ns: int) -> None:
        """Follow the channel, which an operator has changed, from ``at_ns`` on."""
        self._act(channel.change(self.model, at_ns))
        self._events.schedule(self)

    def advance(self, now_ns: int) -> None:
        """Act on all decisions due up to the channel's instant ``now_ns``."""
        self._act(self.model.advance(now_ns))

    def hand_on(self, message: Message, at_ns: int, due_ns: int = 0) -> None:
        """Record that the message is being handed to gRPC at ``at_ns``, which counts as its delivery.

        due_ns: when the last of the messages that it has to wait for was due.
        """
        transit = message.transit
        assert transit is not None and transit.ended_ns is not None
        self.last_ns = at_ns
        self.forwarded += 1
        self.stats.latency.add((at_ns - transit.offered_ns) / 1e6)
        self.stats.error.add((at_ns - max(transit.ended_ns, due_ns)) / 1e6)
        self.age.add(at_ns, transit.offered_ns)
        self.record(message, at_ns)

    def record(self, message: Message, actual_ns: int | None = None) -> None:
        """Write the message's trace record, once, however many copies of it were handed on.

        actual_ns: when it was handed to gRPC; None if it was not.
        """
        if self._trace is not None and message.transit is not None and not message.traced:
            message.traced = True
            self._trace.write(
                self.name, message.session, message.sequence, message.transit, actual_ns, message.duplicated
            )

    def close(self) -> None:
        """Write the trace records of the messages still inside."""
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
            # Break the reference cycle, which would keep the bytes until the next garbage collection.
            message.transit = replace(event.transit, item=None)
            if kind is not EventKind.DUPLICATED:
                self._budget.held_bytes -= len(message.raw)
            if kind is EventKind.DELIVERED and event.transit.flips:
                message.raw = self._damage(message.raw, event.transit.flips)
            message.receiver.settle(message, kind)
            if kind is not EventKind.DELIVERED and kind is not EventKind.DUPLICATED:
                self.record(message)
        if self.model.resets != self._resets:
            self._resets = self.model.resets
            for call in list(self.calls):
                call.end(grpc.StatusCode.UNAVAILABLE, "the emulated network reset this stream")
