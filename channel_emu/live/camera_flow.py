"""Passes one camera's frames through a link to the edge, answers the node, and writes the ledger."""

from __future__ import annotations

import grpc.aio
import numpy as np

from channel_emu.live.live_link import LiveLink, Message
from channel_emu.live.upstream import Upstream
from channel_emu.model.link import EventKind
from freshfield.clock import Clock
from freshfield.ledger import Ledger
from freshfield.v1 import frames_pb2 as pb


class CameraFlow:
    """Offers a camera's frames to its link as they come in, and sends them to the edge when they are due.

    Held-out frames bypass the link and are not in its statistics.

    origin_ns: the clock's reading at the channel's instant zero.
    edge, metadata, jitter: of the stream to the edge, see ``Upstream``.
    """

    def __init__(
        self,
        link: LiveLink,
        clock: Clock,
        origin_ns: int,
        ledger: Ledger,
        edge: grpc.aio.Channel,
        metadata: tuple[tuple[str, str], ...],
        jitter: np.random.Generator,
    ) -> None:
        self.camera = link.name
        self.link = link
        self.upstream = Upstream(self.camera, edge, metadata, self._on_forwarded, self._on_broken, jitter)
        self.held_out = self.forwarded = self.broken = 0
        self._clock = clock
        self._origin_ns = origin_ns
        self._ledger = ledger

    def take(self, raw: bytes, header: pb.FrameHeader) -> pb.PushResponse:
        """Let the link decide about a frame that came in. Returns the answer to the node."""
        now_ns = self._clock.now_ns()
        message = Message(raw, header.session_id, header.sequence, self)
        self._write(message, "received", now_ns)
        outcome = pb.OUTCOME_ACCEPTED
        if header.role == pb.ROLE_HELD_OUT:
            self.held_out += 1
            self.upstream.send(message)
        elif self.link.offer(message, now_ns - self._origin_ns).outcome is EventKind.DROPPED_BUSY:
            outcome = pb.OUTCOME_DROPPED_BUSY
        return pb.PushResponse(sequence=header.sequence, outcome=outcome)

    def settle(self, message: Message, kind: EventKind) -> None:
        """See ``Receiver``."""
        if kind is not EventKind.DELIVERED:
            self._write(message, str(kind), self._clock.now_ns())
        if kind in (EventKind.DELIVERED, EventKind.DUPLICATED):
            self.upstream.send(message)

    def close(self) -> None:
        """At the emulator's end: record frames inside the link as ``in_flight`` in the ledger."""
        for transit in self.link.model.pending():
            self._write(transit.item, "in_flight", self._clock.now_ns())

    def _on_forwarded(self, message: Message) -> None:
        """The frame is being handed to gRPC."""
        now_ns = self._clock.now_ns()
        self.forwarded += 1
        self._write(message, "forwarded", now_ns)
        if message.transit is not None:  # not a held-out frame
            self.link.hand_on(message, now_ns - self._origin_ns)

    def _on_broken(self, message: Message) -> None:
        """The edge was not connected, or its stream ended before it answered."""
        self.broken += 1
        self._write(message, "broken", self._clock.now_ns())
        self.link.record(message)

    def _write(self, message: Message, event: str, now_ns: int) -> None:
        self._ledger.write(now_ns, self.camera, message.session, message.sequence, event)
