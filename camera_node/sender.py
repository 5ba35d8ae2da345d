"""One camera's stream: sends each frame after the previous one was answered, and reconnects after
failures."""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Callable
from dataclasses import replace

import grpc
import grpc.aio
import numpy as np

from camera_node import node_constants as tuned
from camera_node.clock_offset import Offset
from camera_node.outbox import Outbox
from freshfield.frame import Frame, to_request
from freshfield.limits import MAX_CAPTURE_AGE_NS, MAX_REASONS
from freshfield.transport import backoff_s, peer_text
from freshfield.v1 import frames_pb2 as pb
from freshfield.v1 import frames_pb2_grpc as rpc

log = logging.getLogger("camera-node")

# An offset that was never measured may have any value, so its uncertainty is large.
UNKNOWN_OFFSET = Offset(0, MAX_CAPTURE_AGE_NS)
_REASON = re.compile(r"[a-z0-9_]{1,48}")

_OUTCOMES = {
    pb.OUTCOME_ACCEPTED: "accepted",
    pb.OUTCOME_DROPPED_BUSY: "dropped_busy",
    pb.OUTCOME_SUPERSEDED: "superseded",
}
TAKEN = tuple(_OUTCOMES.values())
"""Outcomes of frames that were not refused."""


class ProtocolError(RuntimeError):
    """The peer broke the protocol, e.g. answered another frame, or ended the stream."""


class Sender:
    """Sends the frames of an outbox over one stream, at most one unanswered at a time, and reconnects for
    ever.

    metadata: of the calls.
    offset: returns the current estimate of the peer's clock minus the camera's, which each frame carries.
    jitter: random generator for the pauses between attempts.
    troubles: current problem by camera, shared by the senders of a node so that each problem is logged once.
    response_timeout_s: the stream counts as dead if an answer takes longer than this, or much longer than the
        recent ones. After each such timeout the allowed time is doubled, up to this one.
    """

    def __init__(
        self,
        outbox: Outbox,
        channel: grpc.aio.Channel,
        metadata: tuple[tuple[str, str], ...],
        offset: Callable[[], Offset | None],
        jitter: np.random.Generator,
        troubles: dict[str, str],
        response_timeout_s: float = tuned.ANSWER_TIMEOUT_S,
    ) -> None:
        self.outbox = outbox
        self.connected = False
        self.busy = False
        self.connections = 0
        self._troubles = troubles
        self._channel = channel
        self._stub = rpc.FrameStreamServiceStub(channel)
        self._metadata = metadata
        self._offset = offset
        self._jitter = jitter
        self._timeout = self._patience_s = response_timeout_s
        self._slowest_s = 0.0
        self._reasons: dict[str, int] = {}
        self._offset_awaited = False

    @property
    def trouble(self) -> str:
        """Why the camera's last stream failed, until a frame is answered again; empty if nothing is wrong."""
        return self._troubles.get(self.outbox.camera, "")

    @property
    def ready(self) -> bool:
        """Whether a frame put into the outbox now would be sent at once, with a clock offset."""
        return self.connected and self._offset_awaited

    async def run(self) -> None:
        """Connect and send until cancelled."""
        failures = 0
        while True:
            answered = self.outbox.counts["sent"] - self.outbox.counts["broken"]
            try:
                await self._session()
            except (grpc.RpcError, grpc.aio.BaseError, TimeoutError, ProtocolError, asyncio.InvalidStateError) as error:
                self._report(error)
            except asyncio.CancelledError:
                # gRPC raises this also if only the call was cancelled; a cancelled task ends the sender.
                task = asyncio.current_task()
                if task is None or task.cancelling():
                    raise
                self._report(ProtocolError("stream was cancelled"))
            finally:
                self.connected = False
            if self.outbox.counts["sent"] - self.outbox.counts["broken"] > answered:
                failures = 0  # it worked for a while
            await asyncio.sleep(backoff_s(failures, tuned.FIRST_BACKOFF_S, tuned.MAX_BACKOFF_S, self._jitter))
            failures += 1

    async def _session(self) -> None:
        """One stream, from the moment the peer can be reached until it fails."""
        async with asyncio.timeout(tuned.CONNECT_S):
            await self._channel.channel_ready()
        call = self._stub.Push(metadata=self._metadata)
        try:
            await call.wait_for_connection()
            self.connected = True
            self.connections += 1
            await self._await_offset(call)
            while True:
                await self.outbox.wait_frame()
                if call.done():  # before taking a frame that could only be lost
                    raise await _status(call)
                await self._exchange(call, self.outbox.take())
        finally:
            call.cancel()

    async def _await_offset(self, call: grpc.aio.StreamStreamCall) -> None:
        """Wait up to ``OFFSET_WAIT_S`` until the peer's clock is known, because the age of earlier frames
        would be unknown. The outbox takes captures meanwhile, so the newest one is sent first."""
        if self._offset_awaited:
            return
        try:
            async with asyncio.timeout(tuned.OFFSET_WAIT_S):
                while self._offset() is None:
                    if call.done():
                        return  # the next stream waits again
                    await asyncio.sleep(tuned.OFFSET_POLL_S)
        except TimeoutError:
            pass
        self._offset_awaited = True

    async def _exchange(self, call: grpc.aio.StreamStreamCall, frame: Frame) -> None:
        answered, patience_s, begun_s = False, self._patience_s, time.monotonic()
        self.busy = True
        try:
            async with asyncio.timeout(patience_s):
                await call.write(to_request(self._stamped(frame)))
                response = await call.read()
            if response is grpc.aio.EOF:
                raise await _status(call)
            if response is None:  # gRPC's result for bytes that are no PushResponse
                raise ProtocolError("the answer is not a PushResponse")
            if response.sequence != frame.sequence:
                raise ProtocolError(f"answer to frame {response.sequence}, expected {frame.sequence}")
            answered = True
            self._slowest_s = max(time.monotonic() - begun_s, tuned.SLOWEST_ANSWER_DECAY * self._slowest_s)
            self._patience_s = min(max(tuned.ANSWER_PATIENCE * self._slowest_s, tuned.LEAST_PATIENCE_S), self._timeout)
        except TimeoutError:
            self._patience_s = min(2.0 * patience_s, self._timeout)
            raise TimeoutError(f"no answer within {patience_s:.3g} s") from None
        finally:
            self.busy = False
            if not answered:
                self.outbox.record(frame.sequence, "broken")
        self._count(frame, response)
        self._answered()

    def _stamped(self, frame: Frame) -> Frame:
        offset = self._offset() or UNKNOWN_OFFSET
        return replace(frame, clock_offset_ns=offset.offset_ns, clock_uncertainty_ns=offset.uncertainty_ns)

    def _count(self, frame: Frame, response: pb.PushResponse) -> None:
        outcome = _OUTCOMES.get(response.outcome)
        if outcome is None:
            reason = response.reason if _REASON.fullmatch(response.reason) else "unspecified"
            if reason not in self._reasons and len(self._reasons) >= MAX_REASONS:
                reason = "other"
            if reason not in self._reasons:
                log.warning("%s: frame refused: %s (%s)", frame.camera, reason, peer_text(response.detail))
            self._reasons[reason] = self._reasons.get(reason, 0) + 1
            outcome = f"rejected:{reason}"
        self.outbox.record(frame.sequence, "answered", outcome)

    def _answered(self) -> None:
        """Clear the problem, and log so once no other camera of the node has the same one."""
        trouble = self._troubles.pop(self.outbox.camera, "")
        if trouble and trouble not in self._troubles.values():
            log.info("%s: connected again", self.outbox.camera)

    def _report(self, error: Exception) -> None:
        """Log a failure once per kind, not once per attempt or per camera of a node."""
        if isinstance(error, grpc.aio.AioRpcError):
            text = f"{error.code().name}: {peer_text(error.details())}"
        else:
            text = str(error) or "peer not reachable"
        if text not in self._troubles.values():
            log.warning("%s: %s; trying again", self.outbox.camera, text)
        self._troubles[self.outbox.camera] = text


async def _status(call: grpc.aio.StreamStreamCall) -> Exception:
    """Why a stream ended, as an exception."""
    code, details = await call.code(), await call.details()
    return ProtocolError(f"stream ended: {code.name}{': ' + peer_text(details) if details else ''}")
