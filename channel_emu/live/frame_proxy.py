"""The live emulator: a gRPC server to the camera nodes, a client to the edge, and links between them.

Everything happens on one event loop, woken by an exact timer. Frames are opaque bytes: only their headers
are read. What a node is answered is the link's decision; what the edge answers stays here, counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import grpc.aio
import numpy as np
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from channel_emu.live.camera_lane import HardLimit, Lane, Measures
from channel_emu.live.event_queue import Agenda
from channel_emu.live.histogram import Histogram
from channel_emu.live.replay_link import ReplayLink
from channel_emu.live.status import StatusFile, snapshot
from channel_emu.live.upstream import Upstream
from channel_emu.live.wire import WireError, header_of
from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig
from channel_emu.model.counter_rng import stream_key
from channel_emu.model.link import Link
from channel_emu.model.trace import Trace, TraceWriter
from freshfield.clock import Clock, WallClock
from freshfield.frame import valid_id
from freshfield.ledger import Ledger
from freshfield.transport import Transport
from freshfield.v1 import clock_pb2, frames_pb2

log = logging.getLogger("channel-emu")

SERVICE = frames_pb2.DESCRIPTOR.services_by_name["FrameStreamService"].full_name
CLOCK_SERVICE = clock_pb2.DESCRIPTOR.services_by_name["ClockService"].full_name
_STREAMS_PER_CAMERA = 4
_EXCHANGE_TIMEOUT_S = 5.0
_STATUS_EVERY_S = 0.5
# How much of the chain's path is kept behind the present; events are never later than this.
_KEEP_PATH_NS = 60 * 10**9
# After this long without the edge, say so once.
_PATIENCE_NS = 3 * 10**9
_STOP_GRACE_S = 0.5
# Cameras are let in once the streams to the edge stand, or after this long without them.
_FIRST_WAIT_S = 2.0


class EmulatorFailed(RuntimeError):
    """The emulator cannot go on: its books cannot be written, or a part of it broke."""


@dataclass(frozen=True)
class ProxyOptions:
    """How one emulator runs. listen, to: host:port; port 0 takes any. trace: record to this file. replay:
    repeat these decisions instead of making new ones."""

    listen: str
    to: str
    out: Path
    transport: Transport
    trace: Path | None = None
    replay: Trace | None = None
    priority: str = "normal"
    """What ``priority.raise_priority`` reached, for the record."""


class Proxy:
    """``start``, then ``stop``; or ``run`` until told. Must be made with an event loop running."""

    def __init__(
        self,
        config: ChannelConfig,
        cameras: Sequence[str],
        seed: int,
        options: ProxyOptions,
        clock: Clock | None = None,
    ) -> None:
        self.options = options
        self.clock = clock or WallClock()
        self.origin_ns = self.clock.now_ns()
        self.channel = Channel(config, seed)
        self.measures = Measures(Histogram(), Histogram())
        self.rejected: dict[str, int] = {}
        self.port = 0
        self._ledger = Ledger(options.out, "emulator", "channel", self.origin_ns)
        self._trace = TraceWriter(options.trace, config, seed) if options.trace else None
        self._status = StatusFile(options.out / "channel.json")
        self._edge = options.transport.aio_channel(options.to)
        self._exchange = self._edge.unary_unary(f"/{CLOCK_SERVICE}/Exchange")
        self._failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._agenda = Agenda(self.clock, self.origin_ns, self._fail, shared=config.server.shared)
        self._streams = 0
        self._server = options.transport.aio_server()
        self._tasks: list[asyncio.Task[None]] = []
        self.lanes = {camera: self._lane(camera, config) for camera in cameras}

    async def start(self) -> None:
        """Listen, look for the edge, and let the cameras in once it is found or a moment has passed.

        Raises TransportError if the address cannot be had.
        """
        server, transport = self._server, self.options.transport
        push = {"Push": grpc.stream_stream_rpc_method_handler(self._push)}
        exchange = {"Exchange": grpc.unary_unary_rpc_method_handler(self._pass_exchange)}
        server.add_generic_rpc_handlers((
            grpc.method_handlers_generic_handler(SERVICE, push),
            grpc.method_handlers_generic_handler(CLOCK_SERVICE, exchange),
        ))  # fmt: skip
        checks = health.aio.HealthServicer()
        health_pb2_grpc.add_HealthServicer_to_server(checks, server)
        names = (SERVICE, CLOCK_SERVICE, health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, server)
        self.port = transport.bind(server, self.options.listen)
        upstreams = [self._upstream(lane) for lane in self.lanes.values()]
        for work in (*(upstream.run() for upstream in upstreams), self._keep_status()):
            task = asyncio.create_task(work)
            task.add_done_callback(self._ended)
            self._tasks.append(task)
        for lane in self.lanes.values():
            self._agenda.arm(lane)
        # Frames that come before the first streams to the edge would be broken for no fault of the channel.
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_FIRST_WAIT_S):
                for upstream in upstreams:
                    await upstream.opened.wait()
        await server.start()
        for name in ("", SERVICE, CLOCK_SERVICE):
            await checks.set(name, health_pb2.HealthCheckResponse.SERVING)
        # The collector's long pauses come from old objects, and nearly all of those are made by now.
        gc.collect()
        gc.freeze()

    async def run(self, stop: asyncio.Event) -> None:
        """From start to ``stop``. Raises HardLimit where the scenario sets one, EmulatorFailed if broken."""
        await self.start()
        log.info("listening on port %d, sending to %s", self.port, self.options.to)
        stopping = asyncio.ensure_future(stop.wait())
        either: set[asyncio.Future[Any]] = {stopping, self._failure}
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        finally:
            stopping.cancel()
            try:
                await self.stop()
            except OSError as error:
                self._fail(error)
        if not self._failure.done():
            return
        failure = self._failure.exception()
        if isinstance(failure, HardLimit):
            raise failure
        kind = "" if isinstance(failure, OSError) else f"{type(failure).__name__}: "
        hint = "; is there room on the disk?" if isinstance(failure, OSError) else ""
        raise EmulatorFailed(f"stopped, it could not go on: {kind}{failure}{hint}") from failure

    async def stop(self) -> None:
        """Close streams and books, each whatever becomes of the others. What is inside the links stays
        ``in_flight``. Raises OSError if the books cannot be closed."""
        with contextlib.ExitStack() as books:  # closes the last one named first
            books.callback(lambda: self._status.write(self._snapshot(final=True)))
            books.callback(lambda: self._ledger.close(self.clock.now_ns()))
            if self._trace is not None:
                books.callback(self._trace.close)
            for lane in self.lanes.values():
                books.callback(lane.close)
            books.callback(self._agenda.close)
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            for lane in self.lanes.values():
                for stream in lane.streams:
                    stream.cancel()
            await self._server.stop(_STOP_GRACE_S)
            await self._edge.close()

    def _lane(self, camera: str, config: ChannelConfig) -> Lane:
        link: Link | ReplayLink = self.channel.link(camera)
        if self.options.replay is not None:
            records = self.options.replay.by_camera().get(camera)
            if records:
                link = ReplayLink(camera, records)
            else:
                log.info("%s: not in the replayed trace (held out?); its link decides anew", camera)
        return Lane(
            camera, link, self.clock, self.origin_ns, self._ledger, self.measures, self._trace,
            config.hard_limit_ms, self._fail,
        )  # fmt: skip

    def _upstream(self, lane: Lane) -> Upstream:
        jitter = np.random.default_rng(stream_key(self.channel.seed, lane.camera, "channel.backoff"))
        metadata = self.options.transport.metadata()
        lane.upstream = Upstream(lane.camera, self._edge, metadata, lane.on_forwarded, lane.on_broken, jitter)
        return lane.upstream

    async def _push(self, _: Any, context: grpc.aio.ServicerContext) -> None:
        """One stream of a node. Every message is answered once, as soon as the link has decided."""
        if self._streams >= _STREAMS_PER_CAMERA * len(self.lanes):
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "too many streams are open")
        task = asyncio.current_task()
        assert task is not None
        lane: Lane | None = None
        self._streams += 1
        try:
            # Nodes wait for this before they send.
            await context.send_initial_metadata(())
            while (raw := await context.read()) is not grpc.aio.EOF:
                response, lane = self._take(raw, lane, task)
                await context.write(response.SerializeToString())
        except WireError as error:
            await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
        except asyncio.CancelledError:
            if lane is None or task not in lane.cut:
                raise
            task.uncancel()
            await context.abort(grpc.StatusCode.UNAVAILABLE, "the emulated network reset this stream")
        finally:
            self._streams -= 1
            if lane is not None:
                lane.streams.discard(task)
                lane.cut.discard(task)

    def _take(
        self, raw: bytes, lane: Lane | None, task: asyncio.Task[None]
    ) -> tuple[frames_pb2.PushResponse, Lane | None]:
        header = header_of(raw)
        if lane is None or lane.camera != header.camera_id:
            if lane is not None:
                lane.streams.discard(task)
            lane = self.lanes.get(header.camera_id)
        if lane is None:
            return self._reject(header, "unknown_camera", "this camera is not part of the scenario"), None
        lane.streams.add(task)
        if not valid_id(header.session_id):
            detail = "session ids are 1 to 64 letters, digits, '.', '_', '-'"
            return self._reject(header, "bad_id", detail), lane
        try:
            response = lane.take(raw, header)
        except Exception as error:
            self._fail(error)
            raise
        self._agenda.arm_touched(lane)
        return response, lane

    def _reject(self, header: frames_pb2.FrameHeader, reason: str, detail: str) -> frames_pb2.PushResponse:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1
        ids = [i if valid_id(i) else "?" for i in (header.camera_id, header.session_id)]
        self._ledger.write(self.clock.now_ns(), ids[0], ids[1], header.sequence, "rejected", reason)
        return frames_pb2.PushResponse(
            sequence=header.sequence, outcome=frames_pb2.OUTCOME_REJECTED, reason=reason, detail=detail
        )

    async def _pass_exchange(self, request: bytes, context: grpc.aio.ServicerContext) -> bytes:
        """The clock exchange is part of the instrument, not of the emulated network: it passes undelayed."""
        try:
            return await self._exchange(
                request, timeout=_EXCHANGE_TIMEOUT_S, metadata=self.options.transport.metadata()
            )
        except grpc.aio.AioRpcError as error:
            await context.abort(error.code(), f"edge: {error.details()}")
            raise AssertionError("abort raises") from None

    def _ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            self._fail(error)

    def _fail(self, error: BaseException) -> None:
        """End ``run`` with this error; the first one counts."""
        if self._failure.done():
            return
        if not isinstance(error, HardLimit | OSError):
            log.error("a part of the emulator broke", exc_info=error)
        self._failure.set_exception(error)

    def _snapshot(self, final: bool = False) -> dict[str, Any]:
        return snapshot(
            self.channel, list(self.lanes.values()), self.measures, self.rejected,
            self.clock.now_ns() - self.origin_ns, self.options.priority, final,
        )  # fmt: skip

    async def _keep_status(self) -> None:
        patience_ns = self.clock.now_ns() + _PATIENCE_NS
        while True:
            if patience_ns and self.clock.now_ns() > patience_ns:
                patience_ns = 0
                if not any(lane.upstream and lane.upstream.connected for lane in self.lanes.values()):
                    log.warning("no answer from the edge at %s yet; frames are broken until it is there",
                                self.options.to)  # fmt: skip
            state = self._snapshot()
            await asyncio.to_thread(self._status.write, state)
            before_ns = self.clock.now_ns() - self.origin_ns - _KEEP_PATH_NS
            self.channel.forget(before_ns)
            for lane in self.lanes.values():
                if lane.link.chain is not None:
                    lane.link.chain.forget(before_ns)
            await asyncio.sleep(_STATUS_EVERY_S)
