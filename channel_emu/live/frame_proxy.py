"""The proxy of freshfield's frame stream: nodes stream to the emulator, the emulator to the edge; and its status.

Frames are opaque bytes: only their headers are read. A node's answer is its link's decision. The edge's
answers are counted here and not passed on.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import grpc
import grpc.aio
import numpy as np

from channel_emu.live import live_emulator_constants as tuned
from channel_emu.live.camera_stream import PUSH, CameraStream
from channel_emu.live.channel_service import ChannelService
from channel_emu.live.histogram import Histogram
from channel_emu.live.live_link import Flips
from channel_emu.live.proxy import Proxy, ProxyOptions
from channel_emu.model.counter_rng import stream_key
from channel_emu.model.link import EventKind
from channel_emu.model.settings import ChannelConfig
from freshfield.files import read_status, write_json
from freshfield.frame import FrameRejected, counted_ids, parse, valid_id
from freshfield.ledger import Ledger
from freshfield.limits import MAX_STREAMS_PER_CAMERA
from freshfield.streams import OpenStreams, ServedCall, SessionStreams, serve_health
from freshfield.transport import CLIENT_OPTIONS
from freshfield.v1 import channel_pb2, channel_pb2_grpc, clock_pb2, frames_pb2

log = logging.getLogger("channel-emu")

SERVICE = frames_pb2.DESCRIPTOR.services_by_name["FrameStreamService"].full_name
CLOCK_SERVICE = clock_pb2.DESCRIPTOR.services_by_name["ClockService"].full_name
CONTROL_SERVICE = channel_pb2.DESCRIPTOR.services_by_name["ChannelService"].full_name
_EXCHANGE = f"/{CLOCK_SERVICE}/Exchange"
SET_BY_HAND = "set by hand"
"""The state while an operator's delays and losses are in force."""


class FrameProxy(Proxy):
    """The proxy of the frame stream. A frame's header selects the camera, and with it the link.

    cameras: ids of the scenario's cameras; others are refused.
    out: folder of ``channel.json`` and the ledger.
    Further arguments as of ``Proxy``. Raises OSError if the ledger cannot be created.
    """

    client_options = CLIENT_OPTIONS
    streams_last = True

    def __init__(
        self, config: ChannelConfig, seed: int, options: ProxyOptions, cameras: Sequence[str], out: Path
    ) -> None:
        most_streams = MAX_STREAMS_PER_CAMERA * len(cameras)
        super().__init__(config, seed, options, most_streams + tuned.MAX_OTHER_CALLS)
        self.rejected: dict[str, int] = {}
        """Frames refused here, by reason."""
        self.streams = OpenStreams(most_streams)
        self._sessions = SessionStreams(cameras)
        self._out = out
        self._status_lock, self._status_is_final = threading.Lock(), False
        self._ledger = Ledger(out, "emulator", "channel", self.origin_ns)
        self._metadata = options.transport.metadata()
        self._exchange = self.service_channel.unary_unary(_EXCHANGE)
        self._warn_at_ns = self.origin_ns + tuned.WARN_AFTER_NS
        self.flows = {camera: self._flow(camera) for camera in cameras}
        self._control = ChannelService(self)
        if changes := read_status(out / "channel.json").get("changes"):  # of an earlier process
            self._control.changes.extend(changes)
            if changes[-1].get("loss") is not None:  # that change ended with its process
                self._control.changes.append({"at_ns": self.origin_ns, "delay_ms": None, "loss": None})
        self._handlers = {
            PUSH: grpc.stream_stream_rpc_method_handler(self._push),
            _EXCHANGE: grpc.unary_unary_rpc_method_handler(self._pass_exchange),
        }

    def service(self, details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        """The handler of a method, as gRPC asks for it; None: not served."""
        return self._handlers.get(details.method)

    async def prepare(self, server: grpc.aio.Server) -> None:
        """Connect to the edge. Returns when all streams are open, or after FIRST_WAIT_S."""
        channel_pb2_grpc.add_ChannelServiceServicer_to_server(self._control, server)
        await serve_health(server, (SERVICE, CLOCK_SERVICE, CONTROL_SERVICE))
        for flow in self.flows.values():
            self.spawn(flow.run())
        # Frames that came before the streams to the edge were open would be broken, but not by the channel.
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(tuned.FIRST_WAIT_S):
                for flow in self.flows.values():
                    await flow.opened.wait()
        # The garbage collector's long pauses come from scanning old objects, nearly all of which exist by now.
        gc.collect()
        gc.freeze()

    async def refresh(self) -> None:
        """Write the status; warn once if the edge is not connected."""
        if self._warn_at_ns and self.clock.now_ns() > self._warn_at_ns:
            self._warn_at_ns = 0
            if not any(flow.connected for flow in self.flows.values()):
                log.warning("no answer from the edge at %s yet; frames are broken until it answers", self.options.to)
        await asyncio.to_thread(self._write_status, self._snapshot())

    def close(self) -> None:
        """Close ledger and status, each even if the other fails."""
        try:
            for flow in self.flows.values():
                flow.close()
            self._ledger.close(self.clock.now_ns())
        finally:
            self._write_status(self._snapshot(final=True))

    @property
    def pending(self) -> int:
        return sum(flow.pending for flow in self.flows.values())

    def _flow(self, camera: str) -> CameraStream:
        jitter = np.random.default_rng(stream_key(self.channel.seed, camera, "channel.backoff"))
        link = self.link(camera, damage_payload)
        return CameraStream(
            link, self.clock, self.origin_ns, self._ledger, self.service_channel, self._metadata, jitter
        )

    async def _push(self, _: Any, context: grpc.aio.ServicerContext) -> None:
        """Handle one stream of a node. Each message is answered as soon as the link has taken or dropped
        it."""
        flow: CameraStream | None = None
        async with self.streams.open(context) as call:
            try:
                # Nodes wait for this before they send.
                await call.send(context.send_initial_metadata, ())
                while (raw := await context.read()) is not grpc.aio.EOF:
                    response, flow = self._take(raw, flow, call)
                    await call.write(response.SerializeToString())
            finally:
                if flow is not None:
                    flow.link.calls.discard(call)

    def _take(
        self, raw: bytes, flow: CameraStream | None, call: ServedCall
    ) -> tuple[frames_pb2.PushResponse, CameraStream | None]:
        """Take one frame. flow: of the previous frame on the same stream. Returns the answer and the frame's
        flow."""
        try:
            header = parse(raw).header
        except FrameRejected as error:
            return self._reject(frames_pb2.FrameHeader(), error.reason, str(error)), flow
        if flow is None or flow.camera != header.camera_id:
            if flow is not None:
                flow.link.calls.discard(call)
            flow = self.flows.get(header.camera_id)
        if flow is None:
            return self._reject(header, "unknown_camera", "this camera is not part of the scenario"), None
        flow.link.calls.add(call)
        if not valid_id(header.session_id):
            detail = "session ids are 1 to 64 letters, digits, '.', '_', '-'"
            return self._reject(header, "bad_id", detail), flow
        try:
            self._sessions.claim(flow.camera, header.session_id, call, self.clock.now_ns())
        except FrameRejected as error:
            return self._reject(header, error.reason, str(error)), flow
        if not flow.link.has_room(raw):
            return self._reject(header, "queue_full", "the emulator's queue has reached its limit of bytes"), flow
        call.use()
        try:
            return flow.take(raw, header), flow
        except Exception as error:
            self.fail(error)
            raise

    def _reject(self, header: frames_pb2.FrameHeader, reason: str, detail: str) -> frames_pb2.PushResponse:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1
        ids = counted_ids(header, self.flows)
        self._ledger.write(self.clock.now_ns(), *ids, header.sequence, "rejected", reason)
        return frames_pb2.PushResponse(
            sequence=header.sequence, outcome=frames_pb2.OUTCOME_REJECTED, reason=reason, detail=detail
        )

    async def _pass_exchange(self, request: bytes, context: grpc.aio.ServicerContext) -> bytes:
        """Pass a clock exchange on without delay: it is for measuring, not part of the emulated network."""
        try:
            return await self._exchange(request, timeout=tuned.EXCHANGE_TIMEOUT_S, metadata=self._metadata)
        except grpc.aio.AioRpcError as error:
            await context.abort(error.code(), f"edge: {error.details()}")
            raise AssertionError("abort raises") from None

    def _write_status(self, state: dict[str, Any]) -> None:
        with self._status_lock, contextlib.suppress(OSError):  # a full disk must not end the emulator
            if not self._status_is_final:  # a thread may still hold an earlier status than the last
                self._status_is_final = not state["running"]
                write_json(self._out / "channel.json", state)

    def _snapshot(self, final: bool = False) -> dict[str, Any]:
        """The status as plain values. final: whether the emulator is ending.

        ``state`` is that of the shared chain, or SET_BY_HAND; with one chain a camera, ``by_camera`` has the states.
        ``counts`` are sums over all cameras; ``broken`` counts frames broken by a reset or a missing edge.
        """
        channel, now = self.channel, max(self.events.now_ns(), 0)
        by_hand, chain, names = channel.by_hand, channel.chain, channel.config.state_names
        totals, edge_rejected = Counter[str](), Counter[str]()
        by_camera: dict[str, Any] = {}
        for camera, flow in self.flows.items():
            counts = _counts(flow)
            totals.update(counts)
            edge_rejected.update(flow.rejected)
            by_camera[camera] = {**counts, "connected": flow.connected, "streams": len(flow.link.calls)}
            if by_hand is None and chain is None and flow.link.model.chain is not None:
                by_camera[camera]["state"] = names[flow.link.model.chain.state(now)]
        return {
            "running": not final,
            "preset": channel.config.preset,
            "discipline": channel.config.discipline,
            "seed": channel.seed,
            "uptime_s": round(now / 1e9, 3),
            "states": names,
            "state": SET_BY_HAND if by_hand else None if chain is None else names[chain.state(now)],
            "by_hand": None if by_hand is None else {"delay_ms": by_hand[0], "loss": by_hand[1]},
            "changes": list(self._control.changes),
            "state_share": self._shares(now),
            "drawn_delay_ms": _figures(self.stats.drawn, shape=True),
            "delay_error_ms": _figures(self.stats.error, shape=final),
            "counts": dict(totals),
            "rejected": dict(self.rejected),
            "edge_rejected": dict(edge_rejected),
            "by_camera": by_camera,
        }

    def _shares(self, now_ns: int) -> dict[str, float]:
        chains = [self.channel.chain] if self.channel.chain else [link.model.chain for link in self.links.values()]
        shares = [chain.occupancy(now_ns) for chain in chains if chain is not None]
        means = zip(self.channel.config.state_names, zip(*shares))
        return {name: round(sum(share) / len(share), 6) for name, share in means}


def damage_payload(raw: bytes, flips: Flips) -> bytes:
    """A PushRequest with damaged payload bytes; the checksum stays the sender's, so the edge notices."""
    from channel_emu.model.faults.corruption import damage_frame  # only where a scenario lists it

    request = frames_pb2.PushRequest.FromString(raw)
    damage_frame(request, flips)
    return request.SerializeToString()


def _counts(flow: CameraStream) -> dict[str, int]:
    link = flow.link.model
    return {
        "received": link.offered + flow.held_out,
        "held_out": flow.held_out,
        "forwarded": flow.forwarded,
        **{str(kind): link.counts[kind] for kind in EventKind if kind is not EventKind.STARTED},
        # Frames are broken by a reset of the stream, and by an edge that is not connected.
        "broken": link.counts[EventKind.BROKEN] + flow.broken,
        "in_flight": link.in_flight + flow.pending,
        "clock_backwards": link.clock_backwards,
    }


def _figures(histogram: Histogram, shape: bool) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "count": histogram.count,
        **{name: None if value is None else round(value, 4) for name, value in histogram.summary().items()},
    }
    if shape:
        edges_ms, counts = histogram.linear()
        figures["histogram"] = {"edges_ms": edges_ms, "counts": counts}
    return figures
