"""Our own services, unchanged, behind the fixture that users get (``channel_emu.testing``)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import grpc
import numpy as np
import pytest

from camera_node.clock_offset import OffsetEstimator
from channel_emu.model.ages import RunningAge
from channel_emu.testing import channel
from freshfield import ledger
from freshfield.clock import WallClock
from freshfield.frame import to_request
from freshfield.transport import Transport
from freshfield.v1 import clock_pb2, clock_pb2_grpc, frames_pb2_grpc
from tests.channel_emu.live.emulator import Edge, frame_of

assert channel  # the fixture

DELAY_MS = 20.0


@asynccontextmanager
async def edge_at(out: Path) -> AsyncIterator[Edge]:
    edge = Edge(out, ("cam00",), (), Transport())
    await edge.start()
    try:
        yield edge
    finally:
        await edge.stop()


def test_the_edges_frame_stream_over_a_lossy_link(channel, tmp_path: Path) -> None:
    """Frames at 100 a second over exponential delays of 15 ms: the edge buffers what the link released, in
    order, and its age is the link's."""
    section = {"service": {"law": "exponential", "mean_ms": 15.0}, "discipline": "drop-new"}
    clock = WallClock()
    born: dict[int, int] = {}

    async def live() -> None:
        async with edge_at(tmp_path) as edge:
            link = await asyncio.to_thread(channel, section, to=f"127.0.0.1:{edge.port}", seed=6)
            to_link = grpc.aio.insecure_channel(link.address)
            call = frames_pb2_grpc.FrameStreamServiceStub(to_link).Push()
            await call.wait_for_connection()
            begun = asyncio.get_running_loop().time()
            for n in range(150):
                await asyncio.sleep(begun + n * 0.01 - asyncio.get_running_loop().time())
                born[n] = clock.now_ns()
                await call.write(to_request(frame_of("cam00", "s", n, born[n])))
            await call.done_writing()
            answered = [response.sequence async for response in call]
            await to_link.close()
            report = await asyncio.to_thread(link.settle)
            assert report.offered == 150 and 40 < report.delivered < 110
            assert len(answered) == edge.ingest.delivered["cam00"] == report.delivered
            assert not edge.ingest.rejected and answered == sorted(answered)
            assert report.dropped == report.outcomes["dropped_busy"]
            (file,) = ledger.read_all(tmp_path)
            arrived = [(e.t_ns, born[e.sequence]) for e in file.events if e.event == "delivered"]
            at_ns, born_ns = (np.array(column, np.int64) for column in zip(*arrived))
            age = RunningAge(arrived)
            # Between the two lie only the hops to the link and from it.
            hops_ms = float((at_ns - born_ns).mean()) / 1e6 - report.latency_ms["mean"]
            assert 0 < hops_ms < 100
            expected = report.mean_age_ms + hops_ms
            assert age.mean_age_ms(int(at_ns[-1])) == pytest.approx(expected, abs=3 + hops_ms)

    asyncio.run(live())


@pytest.mark.parametrize(("direction", "sign"), [("up", 1), ("down", -1), ("both", 0)])
def test_the_clock_exchange_over_an_unequal_link(channel, tmp_path: Path, direction: str, sign: int) -> None:
    """NTP assumes that both ways take equally long: a delay of one way only gives an error of half of it,
    which lies within the estimate's bound."""
    section = {"service": {"law": "deterministic", "mean_ms": DELAY_MS}}
    estimator, clock = OffsetEstimator(), WallClock()
    trips_ms: list[float] = []

    async def live() -> None:
        async with edge_at(tmp_path) as edge:
            link = await asyncio.to_thread(channel, section, to=f"127.0.0.1:{edge.port}", direction=direction)
            to_link = grpc.aio.insecure_channel(link.address)
            exchange = clock_pb2_grpc.ClockServiceStub(to_link).Exchange
            for _ in range(8):
                sent = clock.now_ns()
                reply = await exchange(clock_pb2.ExchangeRequest(client_sent_ns=sent), timeout=10)
                back = clock.now_ns()
                estimator.add(sent, reply.server_received_ns, reply.server_sent_ns, back)
                trips_ms.append((back - sent - reply.server_sent_ns + reply.server_received_ns) / 1e6)
            await to_link.close()

    asyncio.run(live())
    found = estimator.estimate(clock.now_ns())
    assert found is not None
    ways = 2 if direction == "both" else 1
    # Whatever the quickest trip took beyond the link's delay, on one way or the other; 1 ms for clock drift.
    assert min(trips_ms) >= ways * DELAY_MS
    slack_ms = (min(trips_ms) - ways * DELAY_MS) / 2 + 1
    assert found.offset_ns / 1e6 == pytest.approx(sign * DELAY_MS / 2, abs=slack_ms)
    assert abs(found.offset_ns) <= found.uncertainty_ns
    assert ways * DELAY_MS / 2 <= found.uncertainty_ns / 1e6 < ways * DELAY_MS / 2 + slack_ms
