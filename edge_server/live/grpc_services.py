"""gRPC services of the edge beside ingest: clock exchange, and what operators ask for."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import grpc
import grpc.aio

from edge_server.live.state import EdgeState, Publication
from freshfield.clock import Clock
from freshfield.v1 import clock_pb2, clock_pb2_grpc, edge_pb2, edge_pb2_grpc

# How often a watcher's stream looks for new decisions; updates take hundreds of milliseconds.
_WATCH_S = 0.05


class ClockService(clock_pb2_grpc.ClockServiceServicer):
    """Answers the NTP exchange at once, on the event loop."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    async def Exchange(
        self, request: clock_pb2.ExchangeRequest, context: grpc.aio.ServicerContext
    ) -> clock_pb2.ExchangeResponse:
        received_ns = self._clock.now_ns()
        return clock_pb2.ExchangeResponse(
            client_sent_ns=request.client_sent_ns,
            server_received_ns=received_ns,
            server_sent_ns=self._clock.now_ns(),
        )


class EdgeService(edge_pb2_grpc.EdgeServiceServicer):
    """Status, decisions as a stream, reset, snapshot, policy change."""

    def __init__(self, state: EdgeState) -> None:
        self._state = state

    async def GetStatus(
        self, request: edge_pb2.GetStatusRequest, context: grpc.aio.ServicerContext
    ) -> edge_pb2.GetStatusResponse:
        state = self._state
        publications = state.publications()
        return edge_pb2.GetStatusResponse(
            scenario=state.scenario,
            uptime_s=state.now_s(),
            cameras=[
                edge_pb2.CameraStatus(
                    camera_id=c.camera,
                    age_ms=c.age_ms,
                    delivered=c.delivered,
                    rejected=c.rejected,
                    held_out=c.held_out,
                )
                for c in state.cameras()
            ],
            policy=state.controls.policy,
            value=state.controls.value,
            paused=state.controls.paused,
            last=decision(publications[-1]) if publications else None,
        )

    async def WatchDecisions(
        self, request: edge_pb2.WatchDecisionsRequest, context: grpc.aio.ServicerContext
    ) -> AsyncIterator[edge_pb2.WatchDecisionsResponse]:
        publications = self._state.publications()
        seen = publications[-1].number if publications else -1
        while True:
            for publication in self._state.publications(since=seen):
                seen = publication.number
                yield edge_pb2.WatchDecisionsResponse(decision=decision(publication))
            await asyncio.sleep(_WATCH_S)

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
        if request.name:
            value = request.value if request.HasField("value") else None
            try:
                self._state.set_policy(request.name, value)
            except ValueError as error:
                await context.abort(grpc.StatusCode.INVALID_ARGUMENT, str(error))
        if request.HasField("paused"):
            controls.paused = request.paused
        return edge_pb2.SetPolicyResponse(name=controls.policy, value=controls.value, paused=controls.paused)


def decision(publication: Publication) -> edge_pb2.Decision:
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
