"""gRPC at the edge: the clock and operator services, and the thread that serves them beside ingest."""

from __future__ import annotations

import asyncio
import logging
import threading

import grpc
import grpc.aio

from edge_server.live import live_constants as tuned
from edge_server.live.ingest import Ingest
from edge_server.live.state import EdgeState, Publication
from freshfield.clock import Clock
from freshfield.streams import OpenStreams, serve_health
from freshfield.transport import Transport
from freshfield.v1 import clock_pb2, clock_pb2_grpc, edge_pb2, edge_pb2_grpc, frames_pb2

log = logging.getLogger(__name__)


class ClockService(clock_pb2_grpc.ClockServiceServicer):
    """Answers clock exchanges at once, on the event loop."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    async def Exchange(
        self, request: clock_pb2.ExchangeRequest, context: grpc.aio.ServicerContext
    ) -> clock_pb2.ExchangeResponse:
        received_ns = self._clock.now_ns()
        return clock_pb2.ExchangeResponse(
            client_sent_ns=request.client_sent_ns, server_received_ns=received_ns, server_sent_ns=self._clock.now_ns()
        )


class EdgeService(edge_pb2_grpc.EdgeServiceServicer):
    """Status, decisions as a stream, reset, snapshot, policy change."""

    def __init__(self, state: EdgeState) -> None:
        self._state = state
        self.watchers = OpenStreams(tuned.MAX_WATCHERS)

    async def GetStatus(
        self, request: edge_pb2.GetStatusRequest, context: grpc.aio.ServicerContext
    ) -> edge_pb2.GetStatusResponse:
        state, last = self._state, self._state.newest()
        return edge_pb2.GetStatusResponse(
            scenario=state.scenario,
            uptime_s=state.now_s(),
            cameras=[
                edge_pb2.CameraStatus(
                    camera_id=c.camera, age_ms=c.age_ms, delivered=c.delivered, rejected=c.rejected, held_out=c.held_out
                )
                for c in state.cameras()
            ],
            policy=state.controls.policy,
            value=state.controls.value,
            paused=state.controls.paused,
            last=to_decision(last) if last is not None else None,
        )

    async def WatchDecisions(self, request: edge_pb2.WatchDecisionsRequest, context: grpc.aio.ServicerContext) -> None:
        last = self._state.newest()
        seen = -1 if last is None else last.number
        async with self.watchers.open(context) as call:
            while True:
                for publication in self._state.publications(since=seen):
                    seen = publication.number
                    await call.write(edge_pb2.WatchDecisionsResponse(decision=to_decision(publication)))
                await asyncio.sleep(tuned.WATCH_S)

    async def ResetField(
        self, request: edge_pb2.ResetFieldRequest, context: grpc.aio.ServicerContext
    ) -> edge_pb2.ResetFieldResponse:
        self._state.controls.reset_requested = True
        return edge_pb2.ResetFieldResponse()

    async def SaveSnapshot(
        self, request: edge_pb2.SaveSnapshotRequest, context: grpc.aio.ServicerContext
    ) -> edge_pb2.SaveSnapshotResponse:
        try:
            path = await asyncio.to_thread(self._state.save_snapshot)
        except (OSError, RuntimeError) as error:
            await context.abort(grpc.StatusCode.FAILED_PRECONDITION, f"no snapshot written: {error}")
        return edge_pb2.SaveSnapshotResponse(path=str(path))

    async def SetPolicy(
        self, request: edge_pb2.SetPolicyRequest, context: grpc.aio.ServicerContext
    ) -> edge_pb2.SetPolicyResponse:
        controls = self._state.controls
        if request.name or request.HasField("value"):
            value = request.value if request.HasField("value") else None
            try:
                self._state.set_policy(request.name or controls.policy, value)
            except ValueError as error:
                # ``abort`` raises an error that a reference cycle keeps alive, and with it 8 MB of request.
                context.set_code(grpc.StatusCode.INVALID_ARGUMENT)
                context.set_details(str(error))
                return edge_pb2.SetPolicyResponse()
        if request.HasField("paused"):
            controls.paused = request.paused
        return edge_pb2.SetPolicyResponse(name=controls.policy, value=controls.value, paused=controls.paused)


def to_decision(publication: Publication) -> edge_pb2.Decision:
    """The wire form of a publication; scores that are missing stay unset."""
    scores = {
        name: value
        for name in ("psnr_db", "psnr_moving_db", "ssim", "lpips")
        if (value := getattr(publication, name)) is not None
    }
    return edge_pb2.Decision(
        number=publication.number,
        decided_ns=publication.published_ns - round(publication.update_ms * 1e6),
        published_ns=publication.published_ns,
        omega_ms=publication.omega_ms,
        selected=publication.selected,
        aaoi_ms=publication.aaoi_ms,
        update_ms=publication.update_ms,
        **scores,
    )


class GrpcThread:
    """Serves ingest, clock and operators on a thread with an event loop of its own.

    stopping: ends the thread when it is set; the thread sets it itself when serving fails.
    """

    def __init__(
        self,
        transport: Transport,
        address: str,
        ingest: Ingest,
        clock: Clock,
        state: EdgeState,
        stopping: threading.Event,
    ) -> None:
        self._transport, self._address = transport, address
        self._ingest, self._clock, self._state = ingest, clock, state
        self._stopping = stopping
        self._ready = threading.Event()
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._main, name="grpc", daemon=True)

    def start(self) -> None:
        """Start, and return once the server listens. Raises the error that prevented it from listening."""
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            raise self._failure

    def join(self, timeout_s: float = 5.0) -> None:
        self._thread.join(timeout_s)

    def _main(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as error:
            self._failure = error
            self._stopping.set()
            self._ready.set()

    async def _serve(self) -> None:
        server = self._transport.aio_server()
        self._ingest.add_to_server(server)
        clock_pb2_grpc.add_ClockServiceServicer_to_server(ClockService(self._clock), server)
        edge_service = EdgeService(self._state)
        edge_pb2_grpc.add_EdgeServiceServicer_to_server(edge_service, server)
        checks = await serve_health(
            server,
            [
                service.full_name
                for module in (frames_pb2, clock_pb2, edge_pb2)
                for service in module.DESCRIPTOR.services_by_name.values()
            ],
        )
        port = self._transport.bind(server, self._address)
        await server.start()
        log.info("listening on port %d", port)
        self._ready.set()
        await asyncio.to_thread(self._stopping.wait)
        await checks.enter_graceful_shutdown()
        for streams in (self._ingest.streams, edge_service.watchers):
            streams.end_all("the edge server ends")
        await server.stop(0.5)
