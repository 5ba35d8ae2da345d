"""One camera's way through the live emulator: link, wall clock, books, upstream."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from channel_emu.live.histogram import Histogram
from channel_emu.live.replay_link import ReplayLink
from channel_emu.live.upstream import Outgoing, Upstream
from channel_emu.live.wire import damaged
from channel_emu.model.link import Event, Kind, Link, Transit
from channel_emu.model.trace import TraceWriter
from freshfield.clock import Clock
from freshfield.ledger import Ledger
from freshfield.v1 import frames_pb2 as pb

_LOST_ON_THE_WAY = (Kind.DROPPED_BUSY, Kind.SUPERSEDED, Kind.SKIPPED, Kind.LOST, Kind.BROKEN)


class HardLimit(RuntimeError):
    """Reality fell further behind the model than the scenario allows."""


@dataclass(slots=True)
class Parcel:
    """A frame as the emulator holds it."""

    raw: bytes
    session: str
    sequence: int
    duplicated: bool = False
    transit: Transit | None = None
    traced: bool = False


@dataclass
class Measures:
    """Figures of all links together; held-out frames pass beside the links and are not in them."""

    drawn_delay: Histogram
    delay_error: Histogram


class Lane:
    """Offers frames to the link at the instant they come in and sends them on at the instant they are due.

    origin_ns: the clock's reading at the channel's instant zero.
    """

    def __init__(
        self,
        camera: str,
        link: Link | ReplayLink,
        clock: Clock,
        origin_ns: int,
        ledger: Ledger,
        measures: Measures,
        trace: TraceWriter | None = None,
        hard_limit_ms: float | None = None,
        on_hard_limit: Callable[[HardLimit], None] | None = None,
    ) -> None:
        self.camera = camera
        self.link = link
        self.upstream: Upstream | None = None
        self.streams: set[asyncio.Task[None]] = set()
        """The handlers of the node's open streams."""
        self.cut: set[asyncio.Task[None]] = set()
        """Those of them that a fault has reset."""
        self.armed_ns = -1
        self.received = self.forwarded = self.broken = self.held_out = 0
        self._clock = clock
        self._origin_ns = origin_ns
        self._ledger = ledger
        self._measures = measures
        self._trace = trace
        self._hard_limit_ns = None if hard_limit_ms is None else hard_limit_ms * 1e6
        self._on_hard_limit = on_hard_limit
        self._resets_seen = 0

    def take(self, raw: bytes, header: pb.FrameHeader) -> pb.PushResponse:
        """A frame came in: let the link decide, act on it, and answer the node."""
        now_ns = self._clock.now_ns()
        self.received += 1
        parcel = Parcel(raw, header.session_id, header.sequence)
        self._write(parcel, "received", now_ns)
        outcome = pb.OUTCOME_ACCEPTED
        if header.role == pb.ROLE_HELD_OUT:
            self.held_out += 1
            self._send(parcel, raw)
        else:
            transit, events = self.link.offer(now_ns - self._origin_ns, parcel, len(raw))
            parcel.transit = transit
            self._act(events)
            if transit.outcome is Kind.DROPPED_BUSY:
                outcome = pb.OUTCOME_DROPPED_BUSY
        return pb.PushResponse(sequence=header.sequence, outcome=outcome)

    def advance(self, now_ns: int) -> None:
        """Do what is due up to the channel's instant ``now_ns``."""
        self._act(self.link.advance(now_ns))

    def close(self) -> None:
        """Note in the trace what is still inside."""
        for transit in self.link.pending():
            self._note(transit.item)

    def on_forwarded(self, frame: Outgoing) -> None:
        """The frame is being handed to gRPC: the moment that counts as its actual delivery."""
        parcel: Parcel = frame.tag
        now_ns = self._clock.now_ns()
        self.forwarded += 1
        self._write(parcel, "forwarded", now_ns)
        transit = parcel.transit
        if transit is None or transit.ended_ns is None:
            return
        actual_ns = now_ns - self._origin_ns
        late_ns = actual_ns - transit.ended_ns
        self._measures.delay_error.add(late_ns / 1e6)
        self._note(parcel, actual_ns)
        if self._hard_limit_ns is not None and late_ns > self._hard_limit_ns and self._on_hard_limit:
            self._on_hard_limit(HardLimit(
                f"frame {parcel.sequence} of {self.camera} left {late_ns / 1e6:.2f} ms after it was due; "
                f"hard_limit_ms is {self._hard_limit_ns / 1e6:g}"
            ))  # fmt: skip

    def on_broken(self, frame: Outgoing) -> None:
        """The edge was away, or its stream ended before it answered."""
        self.broken += 1
        self._write(frame.tag, "broken", self._clock.now_ns())
        self._note(frame.tag)

    def _act(self, events: list[Event]) -> None:
        for event in events:
            if event.kind is Kind.DUPLICATED:
                event.transit.item.duplicated = True
        for event in events:
            parcel: Parcel = event.transit.item
            # An offer's own events come before ``take`` has the transit to keep.
            parcel.transit = event.transit
            kind = event.kind
            if kind is Kind.STARTED:
                drawn_ns = event.transit.drawn_ns
                self._measures.drawn_delay.add(0.0 if drawn_ns is None else drawn_ns / 1e6)
            elif kind is Kind.DELIVERED:
                self._send(parcel, damaged(parcel.raw, event.transit))
            elif kind is Kind.DUPLICATED:
                self._write(parcel, "duplicated", self._clock.now_ns())
                self._send(parcel, damaged(parcel.raw, event.transit))
            elif kind in _LOST_ON_THE_WAY:
                self._write(parcel, str(kind), self._clock.now_ns())
                self._note(parcel)
        if self.link.resets != self._resets_seen:
            self._resets_seen = self.link.resets
            self.cut |= self.streams
            for stream in self.streams:
                stream.cancel()

    def _send(self, parcel: Parcel, raw: bytes) -> None:
        assert self.upstream is not None
        self.upstream.send(Outgoing(raw, parcel.sequence, parcel))

    def _write(self, parcel: Parcel, event: str, now_ns: int) -> None:
        self._ledger.write(now_ns, self.camera, parcel.session, parcel.sequence, event)

    def _note(self, parcel: Parcel, actual_ns: int | None = None) -> None:
        """One trace record a frame, however many copies of it left."""
        if self._trace is not None and parcel.transit is not None and not parcel.traced:
            parcel.traced = True
            self._trace.write(
                self.camera, parcel.session, parcel.sequence, parcel.transit, actual_ns, parcel.duplicated
            )
