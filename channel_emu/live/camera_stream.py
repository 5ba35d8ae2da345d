"""One camera: its frames pass a link and go on to the edge, on a stream that reconnects for ever."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter, deque
from typing import Any

import grpc
import grpc.aio
import numpy as np
from google.protobuf.message import DecodeError

from channel_emu.live import live_emulator_constants as tuned
from channel_emu.live.live_link import STREAM_ENDED, LiveLink, Message
from channel_emu.model.link import EventKind
from freshfield.clock import Clock
from freshfield.ledger import Ledger
from freshfield.limits import MAX_MESSAGE_BYTES, MAX_REASONS
from freshfield.transport import backoff_s, peer_text
from freshfield.v1 import frames_pb2 as pb

log = logging.getLogger("channel-emu")

PUSH = "/freshfield.v1.FrameStreamService/Push"


class CameraStream:
    """Offers a camera's frames to its link as they come in, and sends them on when they are due.

    Held-out frames get no link and are not in its statistics. While CREDITS frames are unanswered, one more is held.
    A frame is broken if the edge is not connected, if a newer one replaces it while it is held, or if the stream ends
    before the answer (the edge's ledger tells whether it arrived).

    origin_ns: the clock's reading at the channel's instant zero.
    edge, metadata: of the calls to the edge.
    jitter: random generator for the pauses before reconnecting.
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
        self.held_out = self.forwarded = self.broken = 0
        self.connected = False
        self.connections = 0
        self.opened = asyncio.Event()
        """Set when the first stream is open."""
        self.rejected: Counter[str] = Counter()
        """Number of the edge's refusals, by reason."""
        self._clock = clock
        self._origin_ns = origin_ns
        self._ledger = ledger
        self._edge = edge
        self._metadata = metadata
        self._jitter = jitter
        self._outbox: deque[Message] = deque()
        self._unanswered: deque[Message] = deque()
        self._held: Message | None = None
        self._wake = asyncio.Event()
        self._trouble = ""

    def take(self, raw: bytes, header: pb.FrameHeader) -> pb.PushResponse:
        """Let the link decide about a frame that came in. Returns the answer to the node."""
        now_ns = self._clock.now_ns()
        message = Message(raw, header.session_id, header.sequence, self)
        self._record(message, "received", now_ns)
        outcome = pb.OUTCOME_ACCEPTED
        if header.role == pb.ROLE_HELD_OUT:
            self.held_out += 1
            self.send(message)
        elif self.link.offer(message, now_ns - self._origin_ns).outcome is EventKind.DROPPED_BUSY:
            outcome = pb.OUTCOME_DROPPED_BUSY
        return pb.PushResponse(sequence=header.sequence, outcome=outcome)

    def settle(self, message: Message, kind: EventKind) -> None:
        """See ``Receiver``."""
        if kind is not EventKind.DELIVERED:
            self._record(message, str(kind), self._clock.now_ns())
        if kind in (EventKind.DELIVERED, EventKind.DUPLICATED):
            self.send(message)

    def send(self, frame: Message) -> None:
        """Send a frame that is due now. Never blocks."""
        if not self.connected:
            self._break(frame)
        elif self._full(frame):
            if self._held is not None:
                self._break(self._held)
            self._held = frame
        else:
            self._outbox.append(frame)
            self._wake.set()

    @property
    def pending(self) -> int:
        """Number of frames given to ``send`` and neither answered nor broken yet."""
        return len(self._outbox) + len(self._unanswered) + (self._held is not None)

    def close(self) -> None:
        """At the emulator's end: record frames inside the link as ``in_flight`` in the ledger."""
        for transit in self.link.model.pending():
            self._record(transit.item, "in_flight", self._clock.now_ns())

    async def run(self) -> None:
        """Keep a stream open until cancelled. Raises OSError if trace or ledger cannot be written."""
        failures = 0
        while True:
            answered = False
            try:
                await self._edge.channel_ready()
                answered = await self._session()
            except STREAM_ENDED as error:
                self._log_trouble(error)
            finally:
                self._end()
            failures = 0 if answered else failures + 1
            await asyncio.sleep(backoff_s(failures, tuned.FIRST_BACKOFF_S, tuned.MAX_BACKOFF_S, self._jitter))

    async def _session(self) -> bool:
        """Run one stream until it fails. Returns whether the edge answered anything on it."""
        call = self._edge.stream_stream(PUSH)(metadata=self._metadata)
        reader = asyncio.create_task(self._read(call))
        writer = asyncio.create_task(self._write(call))
        self.connected = True
        self.connections += 1
        self.opened.set()
        try:
            done, _ = await asyncio.wait({reader, writer}, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                # The stream itself may still be open, and then asking for its status would wait for ever.
                error = task.exception()
                if isinstance(error, DecodeError):
                    self._log_trouble("the edge sent a message that is not an answer")
                    return False
                if error is not None and not isinstance(error, STREAM_ENDED):
                    raise error
            code, details = await call.code(), await call.details()
            self._log_trouble(f"{code.name}: {peer_text(details)}" if details else code.name)
            return reader.done() and not reader.cancelled() and reader.result()
        finally:
            self.connected = False
            call.cancel()
            for task in (reader, writer):
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError, DecodeError, *STREAM_ENDED):
                    await task

    async def _write(self, call: grpc.aio.StreamStreamCall) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._outbox:
                frame = self._outbox.popleft()
                self._unanswered.append(frame)
                self._hand_on(frame)
                await call.write(frame.raw)

    async def _read(self, call: grpc.aio.StreamStreamCall) -> bool:
        answered, strange = False, 0
        try:
            while True:
                data = await call.read()
                if data is grpc.aio.EOF:
                    return answered
                response = pb.PushResponse.FromString(data)
                if not any(frame.sequence == response.sequence for frame in self._unanswered):
                    strange += 1
                    if strange > tuned.MOST_STRANGE:
                        raise DecodeError
                    continue
                while self._unanswered.popleft().sequence != response.sequence:
                    pass  # answers come in order, so earlier frames were answered too
                if not answered:
                    answered, self._trouble = True, ""
                if response.outcome == pb.OUTCOME_REJECTED:
                    reason = peer_text(response.reason[:48]) or "unspecified"
                    known = reason in self.rejected or len(self.rejected) < MAX_REASONS
                    self.rejected[reason if known else "other"] += 1
                if self._held is not None:
                    self._outbox.append(self._held)
                    self._held = None
                    self._wake.set()
        except STREAM_ENDED:
            return answered

    def _end(self) -> None:
        self.connected = False
        ended = [*self._unanswered, *self._outbox, *([self._held] if self._held is not None else [])]
        self._unanswered.clear()
        self._outbox.clear()
        self._held = None
        self._wake.clear()
        for frame in ended:
            self._break(frame)

    def _full(self, frame: Message) -> bool:
        """Whether the credits are used up: CREDITS frames, or MAX_MESSAGE_BYTES in more than one frame."""
        out = [len(each.raw) for each in (*self._outbox, *self._unanswered)]
        return len(out) >= tuned.CREDITS or (bool(out) and sum(out) + len(frame.raw) > MAX_MESSAGE_BYTES)

    def _hand_on(self, frame: Message) -> None:
        now_ns = self._clock.now_ns()
        self._record(frame, "forwarded", now_ns)
        if frame.handed_on:  # the second copy does not count as another frame
            return
        frame.handed_on = True
        self.forwarded += 1
        if frame.transit is not None:  # not a held-out frame
            self.link.hand_on(frame, now_ns - self._origin_ns)

    def _break(self, frame: Message) -> None:
        self.broken += 1
        self._record(frame, "broken", self._clock.now_ns())
        self.link.record(frame)

    def _record(self, frame: Message, event: str, now_ns: int) -> None:
        self._ledger.write(now_ns, self.camera, frame.session, frame.sequence, event)

    def _log_trouble(self, trouble: Any) -> None:
        """Log what failed, once per kind of trouble and not once per attempt."""
        if isinstance(trouble, grpc.aio.AioRpcError):
            trouble = f"{trouble.code().name}: {peer_text(trouble.details())}"
        if str(trouble) != self._trouble:
            self._trouble = str(trouble)
            log.warning("%s: stream to the edge ended (%s); trying again", self.camera, self._trouble)
