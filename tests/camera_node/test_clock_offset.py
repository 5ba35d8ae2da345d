"""The estimate of another machine's clock."""

from __future__ import annotations

import asyncio
from unittest.mock import AsyncMock

import grpc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node import clock_offset
from camera_node.clock_offset import ClockSync, OffsetEstimator
from freshfield.clock import WallClock
from freshfield.v1 import clock_pb2 as pb
from freshfield.v1 import clock_pb2_grpc as rpc

MS = 1_000_000

delays = st.tuples(st.integers(0, 200 * MS), st.integers(0, 5 * MS), st.integers(0, 200 * MS))


@given(offset=st.integers(-(10**18), 10**18), exchanges=st.lists(delays, min_size=1, max_size=40))
def test_the_true_offset_lies_within_the_bound(offset, exchanges):
    """Whatever the delays of both ways, the error is at most the bound: half the shortest round trip."""
    estimator, now = OffsetEstimator(drift_ppm=0.0), 10**18
    for there, thinking, back in exchanges:
        sent = now
        received = sent + there
        returned = received + thinking + back
        estimator.add(sent, received + offset, received + thinking + offset, returned)
        now = returned
    found = estimator.estimate(now)
    assert abs(found.offset_ns - offset) <= found.uncertainty_ns + 1
    assert found.uncertainty_ns <= min(a + b for a, _, b in exchanges[-16:]) // 2


def test_old_exchanges_lose_trust():
    estimator = OffsetEstimator(drift_ppm=50.0)
    estimator.add(0, 1 * MS, 1 * MS, 2 * MS)  # good, but then it grows old
    at_once = estimator.estimate(2 * MS)
    later = estimator.estimate(2 * MS + 100 * 10**9)
    assert at_once.uncertainty_ns == MS and later.uncertainty_ns == MS + 5 * MS
    estimator.add(100 * 10**9, 100 * 10**9 + 9 * MS, 100 * 10**9 + 9 * MS, 100 * 10**9 + 4 * MS)
    assert estimator.estimate(100 * 10**9 + 4 * MS).offset_ns == 7 * MS


def test_the_best_of_the_last_sixteen_exchanges_counts():
    estimator = OffsetEstimator(drift_ppm=0.0)
    estimator.add(0, 5, 5, 0)  # none better: the way takes no time
    offsets = []
    for k in range(1, 17):
        estimator.add(100 * k, 100 * k + 12, 100 * k + 12, 100 * k + 10)
        offsets.append(estimator.estimate(100 * k + 10).offset_ns)
    assert offsets == [5] * 15 + [7]


def test_impossible_exchanges_are_ignored():
    estimator = OffsetEstimator()
    estimator.add(0, 0, 10, 5)  # the answer took longer to make than the whole exchange
    estimator.add(0, 10, 5, 20)  # answered before it was received
    for absurd in (-(2**63), 2**63 - 1):  # no frame's header has room for the offset
        estimator.add(10**18, absurd, absurd, 10**18 + 5)
    assert estimator.estimate(100) is None


class _Peer(rpc.ClockServiceServicer):
    """Answers at once by a right clock, fails once, then answers late by a clock that is an hour ahead."""

    def __init__(self) -> None:
        self.answers = 0

    async def Exchange(self, request, context):
        self.answers += 1
        if self.answers == 6:
            await context.abort(grpc.StatusCode.UNAVAILABLE, "restarting")
        ahead_ns = 3600 * 10**9 if self.answers > 6 else 0
        now_ns = WallClock().now_ns() + ahead_ns
        answer = pb.ExchangeResponse(
            client_sent_ns=request.client_sent_ns, server_received_ns=now_ns, server_sent_ns=now_ns
        )
        if ahead_ns:
            await asyncio.sleep(0.05)
        return answer


async def test_the_offset_follows_a_peer_that_comes_back_with_another_clock(monkeypatch):
    """What the old peer answered, however promptly, says nothing about the new one's clock."""
    monkeypatch.setattr(clock_offset, "PERIOD_S", 0.2)
    monkeypatch.setattr(clock_offset, "_FIRST_PERIOD_S", 0.01)
    server, peer = grpc.aio.server(), _Peer()
    rpc.add_ClockServiceServicer_to_server(peer, server)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        sync = ClockSync(channel, (), WallClock())
        running = asyncio.ensure_future(sync.run())
        found = []
        for answers in (5, 11):
            while peer.answers < answers:
                await asyncio.sleep(0.01)
            found.append(sync.offset().offset_ns / 1e9)
        running.cancel()
    await server.stop(None)
    before, after = found
    assert abs(before) < 1.0 and abs(after - 3600.0) < 1.0


def test_exchanges_follow_each_other_quickly_at_first_and_four_replace_an_old_estimate(monkeypatch):
    pauses, in_use, answers = [], [], iter([True] * 5 + [False] + [True] * 5)
    sync = ClockSync(AsyncMock(), (), WallClock())

    async def exchanged(channel, metadata, clock, estimator, timeout_s) -> bool:
        in_use.append(estimator is sync._estimator)
        return next(answers)

    async def pause(seconds: float) -> None:
        pauses.append(seconds)

    monkeypatch.setattr(clock_offset, "exchange", exchanged)
    monkeypatch.setattr(clock_offset.asyncio, "sleep", pause)
    with pytest.raises(RuntimeError):  # the answers are over
        asyncio.run(sync.run())
    assert pauses == [0.05, 0.05, 0.05, 1.0, 1.0, 1.0, 0.05, 0.05, 0.05, 1.0, 1.0]
    assert in_use == [True] * 6 + [False] * 4 + [True] * 2
