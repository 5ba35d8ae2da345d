"""The live emulator with the edge's real ingest behind it, on the wall clock."""

from __future__ import annotations

import asyncio
import gc
import json
from collections import Counter
from pathlib import Path
from typing import Any

import grpc
import grpc.aio
import numpy as np
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from channel_emu.live import live_link
from channel_emu.live.camera_stream import CREDITS, PUSH
from channel_emu.live.live_link import Message
from channel_emu.live.status import SET_BY_HAND
from channel_emu.model import trace
from edge_server.report.frame_accounting import account_frames
from freshfield.depth import DepthImage
from freshfield.frame import to_request
from freshfield.ledger import read_all
from freshfield.transport import Transport
from freshfield.v1 import channel_pb2, channel_pb2_grpc, clock_pb2, clock_pb2_grpc
from freshfield.v1 import frames_pb2 as pb
from tests.channel_emu.decided_again import compare
from tests.channel_emu.live.emulator import CAMERAS, emulate, frame_of, make, offer
from tests.integration.peer import Peer, silence

# The thesis's channel six times faster, so that a test takes seconds.
FAST = {
    "preset": "ch6",
    "arrivals": {"rate_per_ms": [1 / 20, 1 / 5]},
    "chain": {"mu1_per_ms": 1 / 50, "mu2_per_ms": 1 / 50},
    "service": {"mean_ms": [5.0, 10.0]},
}
QUICK = {"service": {"law": "exponential", "mean_ms": 4.0}}


def frame_account(out: Path):
    """The account of every frame, over the ledgers of all processes; it must close."""
    account = account_frames(out)
    assert account.doubts == []
    return account.total


SHARED = {"service": {"law": "exponential", "mean_ms": 1.5}, "queue_limit": 6}
SECTIONS = {
    "ch6": FAST,
    "ch6, one line": {**FAST, "service": {"mean_ms": [2.0, 4.0]}, "server": {"shared": True}},
    "preempt, one line": {**SHARED, "discipline": "lcfs-preempt", "server": {"shared": True}},
}


@pytest.mark.parametrize("section", SECTIONS.values(), ids=SECTIONS.keys())
async def test_live_decisions_are_those_of_virtual_time(tmp_path: Path, section: dict) -> None:
    """The emulator's trace, its offers decided again in virtual time: every start, due and outcome alike."""
    async with emulate(tmp_path, section, trace=tmp_path / "t.jsonl") as r:
        await asyncio.gather(*(c.stream(80, 0.004) for c in r.cameras.values()))
        await r.settled()
    found = trace.read(tmp_path / "t.jsonl")
    assert compare(found) == {"frames": 320, "equal": 320, "different": []}
    account = frame_account(tmp_path)
    outcomes = [r.outcome for r in found.records]
    assert account.sent == 320
    assert account.delivered == outcomes.count("delivered") > 30
    assert account.dropped_busy == outcomes.count("dropped_busy")
    assert (account.skipped, account.superseded) == (outcomes.count("skipped"), outcomes.count("superseded"))
    for r in found.records:
        assert r.actual_ns is None or r.actual_ns >= r.due_ns
    status = json.loads((tmp_path / "channel.json").read_text())
    assert status["running"] is False and status["delay_error_ms"]["count"] == account.delivered
    assert status["counts"]["delivered"] == account.delivered
    assert sum(status["drawn_delay_ms"]["histogram"]["counts"]) > 0
    if section is FAST:
        assert status["states"] == ["low", "high"] and status["state"] in status["states"]
        assert sum(status["state_share"].values()) == pytest.approx(1)


async def test_depth_passes_untouched_and_takes_its_time_on_the_line(tmp_path: Path) -> None:
    """At 1 Mbit/s a byte takes 8 microseconds, whatever it belongs to."""
    counts = np.random.default_rng(0).integers(0, 2**16, (48, 64), np.uint16)
    depth = DepthImage(counts, 0.001, after_image_ns=-7).encode()
    async with emulate(tmp_path, {"preset": "ideal", "faults": {"bandwidth": 1.0}}, trace=tmp_path / "t.jsonl") as r:
        r.cameras["cam01"].depth = depth
        await asyncio.gather(*(r.cameras[c].push() for c in ("cam00", "cam01")))
        await r.settled()
        newest = r.edge.ingest.buffer.newest()
        assert (newest["cam00"].depth, newest["cam01"].depth) == (None, depth)
    took_ns = {r.camera: r.due_ns - r.offered_ns for r in trace.read(tmp_path / "t.jsonl").records}
    assert took_ns["cam01"] - took_ns["cam00"] == pytest.approx(8000 * len(depth.payload), rel=0.02)


async def test_the_account_closes_with_every_fault(tmp_path: Path) -> None:
    chance = {"probability": 0.2}
    faults = {"loss": chance, "duplication": chance, "corruption": chance}
    async with emulate(tmp_path, {**QUICK, "faults": faults}) as r:
        await asyncio.gather(*(c.stream(60, 0.005) for c in r.cameras.values()))
        await r.settled()
    account = frame_account(tmp_path)
    assert min(account.lost, account.duplicated, account.delivered) > 10
    # The edge refuses damaged frames by their checksum, and second copies by their sequence number.
    assert set(account.rejected) == {"crc_mismatch", "replayed_sequence"}
    status = json.loads((tmp_path / "channel.json").read_text())
    assert status["edge_rejected"] == dict(account.rejected)
    # The second copy of a frame is no further frame.
    assert status["delay_error_ms"]["count"] == status["counts"]["forwarded"] == status["counts"]["delivered"]


async def test_a_reset_breaks_the_stream_and_the_camera_comes_back(tmp_path: Path) -> None:
    service = {"law": "deterministic", "mean_ms": 300.0}
    section = {"service": service, "faults": {"reset": {"at_ms": [1500.0]}}}
    async with emulate(tmp_path, section, cameras=("cam00",)) as r:
        camera = r.cameras["cam00"]
        with pytest.raises((grpc.aio.AioRpcError, asyncio.InvalidStateError)):
            for _ in range(100):
                await camera.push()
                await asyncio.sleep(0.1)
        # INTERNAL is what gRPC's client makes of a write that crosses the reset on the wire.
        assert await camera.code() in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.INTERNAL)
        assert r.proxy.flows["cam00"].link.model.resets == 1
        await camera.connect()
        assert (await camera.push()).outcome == pb.OUTCOME_ACCEPTED
        await r.settled()
        assert r.proxy.flows["cam00"].link.model.counts["broken"] == 1


async def test_held_out_frames_pass_beside_the_channel(tmp_path: Path) -> None:
    section = {"service": {"law": "deterministic", "mean_ms": 1e9}}
    async with emulate(tmp_path, section, held_out=("cam03",)) as r:
        await r.cameras["cam03"].stream(20, 0.002)
        await r.cameras["cam00"].stream(5, 0.002)
        async with asyncio.timeout(10):
            while len(r.edge.truth) < 20:
                await asyncio.sleep(0.01)
        assert r.cameras["cam00"].answers == {"accepted": 1, "dropped_busy": 4}
        delays_ms = [(at - f.generated_ns) / 1e6 for f, at in r.edge.truth]
        assert sorted(delays_ms)[10] < 100
    status = json.loads((tmp_path / "channel.json").read_text())
    assert status["delay_error_ms"]["count"] == 0 and status["counts"]["held_out"] == 20
    assert status["drawn_delay_ms"]["count"] == 1
    assert frame_account(tmp_path).in_flight == 1


async def test_the_edge_may_die_and_come_back(tmp_path: Path) -> None:
    async with emulate(tmp_path, QUICK) as r:
        cameras = r.cameras.values()
        await asyncio.gather(*(c.stream(20, 0.005) for c in cameras))
        await r.edge.stop()
        await asyncio.gather(*(c.stream(20, 0.005) for c in cameras))  # answered all the same
        await r.edge.start()
        await r.connected()
        await asyncio.gather(*(c.stream(20, 0.005) for c in cameras))
        await r.settled()
        assert sum(flow.broken for flow in r.proxy.flows.values()) > 20
        assert all(flow.connections == 2 for flow in r.proxy.flows.values())
        assert all(r.edge.ingest.delivered[c] > 0 for c in CAMERAS)
    account = frame_account(tmp_path)
    assert account.sent == 240 and account.in_flight == 0 and account.broken > 20


async def test_an_edge_that_never_answers_costs_frames_and_no_memory(tmp_path: Path) -> None:
    edge = await Peer(respond=silence).start()
    proxy, (flow,) = make(tmp_path, edge.address, {})
    await proxy.start()
    while not flow.connected:
        await asyncio.sleep(0.01)
    for n in range(200):
        offer(flow, n)
        await asyncio.sleep(0)
    await edge.until(CREDITS)
    assert flow.pending == CREDITS + 1
    assert flow.broken == 200 - CREDITS - 1
    await proxy.stop()
    assert flow.broken == 200
    await edge.stop()


async def test_clock_health_and_reflection_pass_a_slow_channel(tmp_path: Path) -> None:
    async with emulate(tmp_path, {"service": {"law": "deterministic", "mean_ms": 1e6}}) as r:
        channel = Transport().aio_channel(f"127.0.0.1:{r.proxy.port}")
        clock = clock_pb2_grpc.ClockServiceStub(channel)
        reply = await clock.Exchange(clock_pb2.ExchangeRequest(client_sent_ns=7), timeout=5)
        assert reply.client_sent_ns == 7 and reply.server_sent_ns >= reply.server_received_ns > 0
        health = health_pb2_grpc.HealthStub(channel)
        for service in ("", "freshfield.v1.FrameStreamService"):
            state = await health.Check(health_pb2.HealthCheckRequest(service=service), timeout=5)
            assert state.status == health_pb2.HealthCheckResponse.SERVING
        await r.edge.stop()
        with pytest.raises(grpc.aio.AioRpcError) as gone:
            await clock.Exchange(clock_pb2.ExchangeRequest(), timeout=10)
        assert gone.value.code() in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.DEADLINE_EXCEEDED)
        await channel.close()


async def test_strangers_and_nonsense_are_refused_and_counted(tmp_path: Path) -> None:
    async with emulate(tmp_path, {}) as r:
        channel = Transport().aio_channel(f"127.0.0.1:{r.proxy.port}")
        call = channel.stream_stream(PUSH)()

        async def send(raw: bytes) -> str:
            await call.write(raw)
            return pb.PushResponse.FromString(await call.read()).reason

        header = pb.FrameHeader(camera_id="cam77", session_id="s")
        assert await send(pb.PushRequest(header=header).SerializeToString()) == "unknown_camera"
        assert await send(b"") == "unknown_camera"
        header = pb.FrameHeader(camera_id="cam00", session_id="two\tcolumns\n")
        assert await send(pb.PushRequest(header=header, payload=b"x").SerializeToString()) == "bad_id"
        good = to_request(frame_of("cam00", "s", 1, r.proxy.clock.now_ns())).SerializeToString()
        wrong = (b"\xff\xff\xff", good[:-1], b"\x12\x05abc", b"\x0a\x02\xff\xff", b"\x0b", good + b"\0\0")
        for raw in wrong:
            assert await send(raw) == "unparsable"
        # The stream goes on, and the cameras never noticed.
        assert await send(good) == ""
        await r.cameras["cam01"].stream(3, 0)
        assert r.proxy.rejected == {"unknown_camera": 2, "bad_id": 1, "unparsable": len(wrong)}
        await channel.close()
    (ledger,) = (one for one in read_all(tmp_path) if one.role == "emulator")
    refused = Counter((e.camera, e.session, e.detail) for e in ledger.events if e.event == "rejected")
    expected = {("?", "?", "unknown_camera"): 2, ("cam00", "?", "bad_id"): 1, ("?", "?", "unparsable"): 6}
    assert refused == expected


async def test_silent_streams_and_a_spoofed_session_do_not_keep_a_camera_out(tmp_path: Path) -> None:
    async with emulate(tmp_path, {}) as r:
        camera = r.cameras["cam00"]
        await camera.stream(2, 0)
        async with Transport().aio_channel(f"127.0.0.1:{r.proxy.port}") as channel:
            silent = []
            for _ in range(30):
                silent.append(channel.stream_stream(PUSH)())
                await silent[-1].initial_metadata()
            spoof = to_request(frame_of("cam00", camera.session, 2**63, r.proxy.clock.now_ns()))
            await silent[-1].write(spoof.SerializeToString())
            answer = pb.PushResponse.FromString(await silent[-1].read())
            assert answer.reason == "session_in_use"
            await camera.stream(3, 0)
            await r.cameras["cam01"].stream(1, 0)  # opens a stream of its own only now
            assert r.proxy.streams.ended > 10
        assert camera.answers == {"accepted": 5}
        await r.settled()
        assert r.edge.ingest.delivered["cam00"] == 5 and not r.edge.ingest.rejected


async def test_what_is_inside_the_links_is_bounded_in_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_link, "MAX_QUEUED_BYTES", 20_000)
    section = {"service": {"law": "deterministic", "mean_ms": 200.0}, "discipline": "fcfs"}
    async with emulate(tmp_path, section, cameras=("cam00", "cam01")) as r:
        for name in r.cameras:
            await r.cameras[name].stream(5, 0)
        inside = [len(t.item.raw) for f in r.proxy.flows.values() for t in f.link.model.pending()]
        assert 0 < sum(inside) == r.proxy._budget.held_bytes <= 20_000
        full = r.proxy.rejected["queue_full"]
        assert full == 10 - len(inside) and r.cameras["cam01"].reasons["queue_full"] > 0
        await r.settled()
        assert r.proxy._budget.held_bytes == 0
        await r.cameras["cam00"].stream(1, 0)
        assert r.proxy.rejected["queue_full"] == full
    frame_account(tmp_path)


async def test_a_message_that_left_keeps_no_memory_until_a_garbage_collection(tmp_path: Path) -> None:
    _, (flow,) = make(tmp_path, "127.0.0.1:1", {**QUICK, "discipline": "fcfs"})

    def held() -> bool:
        return any(isinstance(o, Message) and o.receiver is flow for o in gc.get_objects())

    gc.collect()
    gc.disable()
    try:
        for sequence in range(9):
            offer(flow, sequence)
        assert held()
        flow.link.advance(10**12)
        assert not held()
    finally:
        gc.enable()


async def test_the_credits_at_the_edge_hold_for_bytes_too(tmp_path: Path) -> None:
    edge = await Peer(respond=silence).start()
    proxy, (flow,) = make(tmp_path, edge.address, {})
    await proxy.start()
    large = Message(bytes(5 * 2**20), "s", 0, flow)
    for _ in range(6):
        flow.send(large)
    assert flow.pending == 2 and flow.broken == 4  # one on its way, the newest held
    assert proxy._snapshot()["counts"]["in_flight"] == 2
    await proxy.stop()
    await edge.stop()


async def test_a_message_that_cannot_be_damaged_does_not_end_the_emulator(tmp_path: Path) -> None:
    """Field number 0: to be found before the link decides to flip its bytes."""
    async with emulate(tmp_path, {"faults": {"corruption": {"probability": 1.0}}}) as r:
        good = to_request(frame_of("cam00", "s", 1, r.proxy.clock.now_ns())).SerializeToString()
        async with Transport().aio_channel(f"127.0.0.1:{r.proxy.port}") as channel:
            call = channel.stream_stream(PUSH)()
            for raw in (good + b"\0\0", good):
                await call.write(raw)
                await call.read()
        await r.settled()
        r.proxy.check()
        assert r.edge.ingest.rejected == {"crc_mismatch": 1}


async def test_the_token_is_demanded_and_passed_on(tmp_path: Path) -> None:
    async with emulate(tmp_path, {}, transport=Transport(tokens={"camera:*": "open sesame"})) as r:
        await r.cameras["cam00"].stream(5, 0.002)
        await r.settled()
        assert r.edge.ingest.delivered["cam00"] == 5
        stranger = Transport().aio_channel(f"127.0.0.1:{r.proxy.port}")
        call = stranger.stream_stream(PUSH)()
        with pytest.raises(grpc.aio.AioRpcError) as refused:
            await call.read()
        assert refused.value.code() == grpc.StatusCode.UNAUTHENTICATED
        await stranger.close()


async def test_an_operator_changes_the_channel_and_gives_it_back(tmp_path: Path) -> None:
    def snapshot_of(emulation: Any) -> dict[str, Any]:
        return emulation.proxy._snapshot()

    section = {"arrivals": "poisson:1/1ms", "service": "exp:1ms", "discipline": "parallel"}
    async with emulate(tmp_path, section, cameras=("cam00",)) as r:
        link = r.proxy.links["cam00"].model
        operator = Transport().aio_channel(f"127.0.0.1:{r.proxy.port}")
        ask = channel_pb2_grpc.ChannelServiceStub(operator).SetChannel

        async def deliveries_of(**wanted: float) -> int:
            await ask(channel_pb2.SetChannelRequest(**wanted))
            before = link.counts["delivered"]
            await r.cameras["cam00"].stream(20, 0.002)
            await r.settled()
            return link.counts["delivered"] - before

        assert await deliveries_of(delay_ms=80.0) == 20  # each frame enters: nothing samples them
        assert 40.0 < r.proxy.stats.latency.summary()["mean"] < 160.0
        assert await deliveries_of(loss=1.0) == 0
        assert snapshot_of(r)["state"] == SET_BY_HAND and snapshot_of(r)["by_hand"] == {"delay_ms": 0, "loss": 1}
        lost = link.counts["lost"]
        assert 0 < await deliveries_of() <= 20 and link.counts["lost"] == lost == 20
        for wrong in ({"delay_ms": float("nan")}, {"delay_ms": -1.0}, {"delay_ms": 1e9}, {"loss": 1.5}):
            with pytest.raises(grpc.aio.AioRpcError, match="0 to 1"):
                await ask(channel_pb2.SetChannelRequest(**wrong))
        assert [change["loss"] for change in snapshot_of(r)["changes"]] == [0.0, 1.0, None]
        assert snapshot_of(r)["by_hand"] is None and snapshot_of(r)["state"] is None
        await operator.close()
