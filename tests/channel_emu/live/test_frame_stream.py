"""The live emulator with the edge's real ingest behind it, on the wall clock. What breaks inside or behind it ends it,
or its stream, in plain sight; an edge that is slow or away costs frames and nothing else."""

import asyncio
import dataclasses
import json
from collections import Counter
from pathlib import Path
from unittest import mock

import grpc
import grpc.aio
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from channel_emu.live import live_emulator_constants as tuned
from channel_emu.live import live_link
from channel_emu.live.camera_stream import PUSH
from channel_emu.live.frame_proxy import SET_BY_HAND
from channel_emu.live.live_emulator_constants import CREDITS
from channel_emu.live.live_link import Message
from channel_emu.live.proxy import EmulatorFailed
from channel_emu.model import trace
from channel_emu.model.chain import ChainError
from channel_emu.model.channel import Channel
from channel_emu.model.trace import Trace
from channel_emu.virtual.simulate import offer_all
from edge_server.report.frame_accounting import account_frames
from freshfield.frame import to_request
from freshfield.ledger import read_all
from freshfield.transport import Transport
from freshfield.v1 import channel_pb2, channel_pb2_grpc, clock_pb2, clock_pb2_grpc
from freshfield.v1 import frames_pb2 as pb
from tests.channel_emu.live.emulator import CAMERAS, answer_to, emulate, make, offer
from tests.edge_server.frames import frame
from tests.freshfield.serving import serving, status
from tests.integration.peer import Peer, silence
from tests.support import free_port, until

# The thesis's channel six times faster, so that a test takes seconds.
FAST = {
    "preset": "ch6",
    "arrivals": {"rate_per_ms": [1 / 20, 1 / 5]},
    "chain": {"mu1_per_ms": 1 / 50, "mu2_per_ms": 1 / 50},
    "service": {"mean_ms": [5.0, 10.0]},
}
ONE_LINE = {"service": "exp:1.5ms", "queue_limit": 6, "discipline": "lcfs-preempt", "server": {"shared": True}}
QUICK = {"service": "exp:4ms"}


def frame_account(out: Path):
    """The account of every frame, over the ledgers of all processes; it must close."""
    account = account_frames(out)
    assert account.doubts == []
    return account.total


def status_of(out: Path) -> dict:
    """The last one."""
    return json.loads((out / "channel.json").read_text())


def different(found: Trace) -> list[str]:
    """Every recorded message that, offered again at its recorded instant, gets another outcome, start, due instant or
    state."""
    cameras = found.by_camera()
    offers = {name: [(r.offered_ns, r.bytes) for r in records] for name, records in cameras.items()}
    last_ns = max(max(r.offered_ns, r.started_ns or 0, r.ended_ns or 0) for r in found.records)
    _, decided = offer_all(Channel(found.config, found.seed), offers, last_ns)
    pairs = [pair for name, records in cameras.items() for pair in zip(records, decided[name], strict=True)]
    told = [[(each.outcome, each.started_ns, each.due_ns, each.state) for each in pair] for pair in pairs]
    return [f"{then}, now {now}" for then, now in told if then != now]


@pytest.mark.parametrize("section", [FAST, ONE_LINE], ids=["ch6", "preempt, one line"])
async def test_live_decisions_are_those_of_virtual_time(tmp_path, section):
    """The emulator's trace, its offers decided again in virtual time: every start, due and outcome alike."""
    async with emulate(tmp_path, section, trace=tmp_path / "t.jsonl") as r:
        await r.stream(80, 0.004)
        await r.settled()
    found = trace.read(tmp_path / "t.jsonl")
    assert len(found.records) == 320 and different(found) == []
    assert len(different(dataclasses.replace(found, seed=4))) > 30, "it would notice"
    account = frame_account(tmp_path)
    outcomes = [r.outcome for r in found.records]
    assert account["sent"] == 320
    assert account["delivered"] == outcomes.count("delivered") > 30
    assert account["dropped_busy"] == outcomes.count("dropped_busy")
    assert (account["skipped"], account["superseded"]) == (outcomes.count("skipped"), outcomes.count("superseded"))
    assert all(r.actual_ns is None or r.actual_ns >= r.due_ns for r in found.records)
    status = status_of(tmp_path)
    assert status["running"] is False and status["counts"]["delivered"] == account["delivered"]
    assert status["delay_error_ms"]["count"] == account["delivered"]
    assert section is not FAST or status["state"] in status["states"] == ["low", "high"]


async def test_a_trace_replayed_at_another_pace_is_decided_and_delivered_alike(tmp_path):
    """Each delivery as long after its offer as recorded, later by the delay error alone."""
    paths = tmp_path / "0" / "t.jsonl", tmp_path / "1" / "t.jsonl"
    for path, section, period_s in zip(paths, (FAST, QUICK), (0.004, 0.006)):
        replay = None if path is paths[0] else trace.read(paths[0])
        async with emulate(path.parent, section, trace=path, replay=replay) as r:
            await r.stream(60, period_s)
            await r.settled()
    assert frame_account(tmp_path / "1")["sent"] == 240
    recorded, replayed = (trace.read(path).by_camera() for path in paths)
    for camera in CAMERAS:
        for then, now in zip(recorded[camera], replayed[camera], strict=True):
            assert (then.outcome, then.drawn_ns) == (now.outcome, now.drawn_ns)
            if then.outcome == "delivered":
                assert then.ended_ns - then.offered_ns == now.ended_ns - now.offered_ns
                assert now.actual_ns is None or now.actual_ns >= now.ended_ns


async def test_the_account_closes_with_every_fault(tmp_path):
    async with emulate(tmp_path, {**QUICK, "faults": {"loss": 0.2, "duplication": 0.2, "corruption": 0.2}}) as r:
        await r.stream(60, 0.005)
        await r.settled()
    account, status = frame_account(tmp_path), status_of(tmp_path)
    assert min(account["lost"], account["duplicated"], account["delivered"]) > 10
    # The edge refuses damaged frames by their checksum, and second copies by their sequence number.
    assert set(account.as_dict()["rejected"]) == {"crc_mismatch", "replayed_sequence"}
    assert status["edge_rejected"] == account.as_dict()["rejected"]
    # The second copy of a frame is no further frame.
    assert status["delay_error_ms"]["count"] == status["counts"]["forwarded"] == status["counts"]["delivered"]


async def test_a_reset_breaks_the_stream_and_the_camera_comes_back(tmp_path):
    section = {"service": "det:300ms", "faults": {"reset": {"at_ms": [1500.0]}}}
    async with emulate(tmp_path, section, cameras=("cam00",)) as r:
        camera = r.cameras["cam00"]
        with pytest.raises((grpc.aio.AioRpcError, asyncio.InvalidStateError)):
            await camera.stream(100, 0.1)
        # INTERNAL is what gRPC's client makes of a write that crosses the reset on the wire.
        assert await camera.call.code() in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.INTERNAL)
        assert r.proxy.flows["cam00"].link.model.resets == 1
        await camera.connect()
        assert (await camera.push()).outcome == pb.OUTCOME_ACCEPTED
        await r.settled()
        assert r.proxy.flows["cam00"].link.model.counts["broken"] == 1


async def test_held_out_frames_pass_beside_the_channel(tmp_path):
    async with emulate(tmp_path, {"service": {"law": "deterministic", "mean_ms": 1e9}}, held_out=("cam03",)) as r:
        await r.cameras["cam03"].stream(20, 0.002)
        await r.cameras["cam00"].stream(5, 0.002)
        await until(lambda: len(r.edge.truth) >= 20)
        assert r.cameras["cam00"].answers == {"accepted": 1, "dropped_busy": 4}
        delays_ms = [(at - f.generated_ns) / 1e6 for f, at in r.edge.truth]
        assert sorted(delays_ms)[10] < 100
    status = status_of(tmp_path)
    assert status["delay_error_ms"]["count"] == 0 and status["counts"]["held_out"] == 20
    assert status["drawn_delay_ms"]["count"] == 1
    assert frame_account(tmp_path)["in_flight"] == 1


async def test_the_edge_may_die_and_come_back(tmp_path):
    async with emulate(tmp_path, QUICK) as r:
        await r.stream(20, 0.005)
        await r.edge.stop()
        await r.stream(20, 0.005)  # answered all the same
        await r.edge.start()
        await r.connected()
        await r.stream(20, 0.005)
        await r.settled()
        assert sum(flow.broken for flow in r.proxy.flows.values()) > 20
        assert all(flow.connections == 2 for flow in r.proxy.flows.values())
        assert all(r.edge.ingest.delivered[c] > 0 for c in CAMERAS)
    account = frame_account(tmp_path)
    assert account["sent"] == 240 and account["in_flight"] == 0 and account["broken"] > 20


async def test_clock_and_health_pass_a_slow_channel(tmp_path):
    async with emulate(tmp_path, {"service": "det:1000s"}) as r, r.stranger() as channel:
        clock = clock_pb2_grpc.ClockServiceStub(channel)
        reply = await clock.Exchange(clock_pb2.ExchangeRequest(client_sent_ns=7), timeout=5)
        assert reply.client_sent_ns == 7 and reply.server_sent_ns >= reply.server_received_ns > 0
        health = health_pb2_grpc.HealthStub(channel)
        for service in ("", "freshfield.v1.FrameStreamService"):
            state = await health.Check(health_pb2.HealthCheckRequest(service=service), timeout=5)
            assert state.status == health_pb2.HealthCheckResponse.SERVING
        await r.edge.stop()
        gone = await status(clock.Exchange(clock_pb2.ExchangeRequest(), timeout=10))
        assert gone in ("UNAVAILABLE", "DEADLINE_EXCEEDED")


async def test_strangers_and_nonsense_are_refused_and_counted(tmp_path):
    """What cannot be parsed, or damaged, is found before the link decides to flip its bytes."""
    async with emulate(tmp_path, {"faults": {"corruption": 1.0}}) as r, r.stranger() as channel:
        call = channel.stream_stream(PUSH)()
        unknown = pb.PushRequest(header=pb.FrameHeader(camera_id="cam77", session_id="s"))
        bad_id = pb.PushRequest(header=pb.FrameHeader(camera_id="cam00", session_id="two\tcolumns\n"), payload=b"x")
        good = to_request(frame("cam00", 1, r.proxy.clock.now_ns())).SerializeToString()
        wrong = (b"\xff\xff\xff", good[:-1], b"\x12\x05abc", b"\x0a\x02\xff\xff", b"\x0b", good + b"\0\0")
        expected = dict.fromkeys(wrong, "unparsable")
        expected |= {unknown.SerializeToString(): "unknown_camera", b"": "unknown_camera"}
        expected |= {bad_id.SerializeToString(): "bad_id"}
        for raw, reason in expected.items():
            assert (await answer_to(call, raw)).reason == reason
        # The stream goes on, and the cameras never noticed.
        assert (await answer_to(call, good)).reason == ""
        await r.cameras["cam01"].stream(3)
        await r.settled()
        r.proxy.check()
        assert r.proxy.rejected == {"unknown_camera": 2, "bad_id": 1, "unparsable": 6}
        assert r.edge.ingest.rejected == {"crc_mismatch": 4}
    (ledger,) = (one for one in read_all(tmp_path) if one.role == "emulator")
    refused = Counter((e.camera, e.session, e.detail) for e in ledger.events if e.event == "rejected")
    assert refused == {("?", "?", "unknown_camera"): 2, ("cam00", "?", "bad_id"): 1, ("?", "?", "unparsable"): 6}


async def test_silent_streams_and_a_spoofed_session_do_not_keep_a_camera_out(tmp_path):
    async with emulate(tmp_path, {}) as r:
        camera = r.cameras["cam00"]
        await camera.stream(2)
        async with r.stranger() as channel:
            silent = []
            for _ in range(30):
                silent.append(channel.stream_stream(PUSH)())
                await silent[-1].initial_metadata()
            spoof = to_request(frame("cam00", 2**63, r.proxy.clock.now_ns(), session=camera.session))
            assert (await answer_to(silent[-1], spoof.SerializeToString())).reason == "session_in_use"
            await camera.stream(3)
            await r.cameras["cam01"].stream(1)  # opens a stream of its own only now
            assert r.proxy.streams.ended > 10
        assert camera.answers == {"accepted": 5}
        await r.settled()
        assert r.edge.ingest.delivered["cam00"] == 5 and not r.edge.ingest.rejected


async def test_what_is_inside_the_links_is_bounded_in_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(live_link, "MAX_QUEUED_BYTES", 5_000)
    async with emulate(tmp_path, {"service": "det:200ms", "discipline": "fcfs"}, cameras=("cam00", "cam01")) as r:
        for camera in r.cameras.values():
            await camera.stream(5)
        inside = [len(t.item.raw) for f in r.proxy.flows.values() for t in f.link.model.pending()]
        assert 0 < sum(inside) == r.proxy._budget.held_bytes <= 5_000
        full = r.proxy.rejected["queue_full"]
        assert full == 10 - len(inside) and r.cameras["cam01"].reasons["queue_full"] > 0
        await r.settled()
        assert r.proxy._budget.held_bytes == 0
        await r.cameras["cam00"].stream(1)
        assert r.proxy.rejected["queue_full"] == full
    frame_account(tmp_path)


async def test_the_token_is_demanded_and_passed_on(tmp_path):
    async with emulate(tmp_path, {}, transport=Transport(tokens={"camera:*": "open sesame"})) as r:
        await r.cameras["cam00"].stream(5, 0.002)
        await r.settled()
        assert r.edge.ingest.delivered["cam00"] == 5
        async with r.stranger() as channel:
            assert await status(channel.stream_stream(PUSH)().read()) == "UNAUTHENTICATED"


async def test_an_operator_changes_the_channel_and_gives_it_back(tmp_path):
    section = {"arrivals": "poisson:1/1ms", "service": "exp:1ms", "discipline": "parallel"}
    async with emulate(tmp_path, section, cameras=("cam00",)) as r, r.stranger() as operator:
        counts = r.proxy.links["cam00"].model.counts
        ask = channel_pb2_grpc.ChannelServiceStub(operator).SetChannel

        async def deliveries_of(**wanted: float) -> int:
            await ask(channel_pb2.SetChannelRequest(**wanted))
            before = counts["delivered"]
            await r.cameras["cam00"].stream(20, 0.002)
            await r.settled()
            return counts["delivered"] - before

        assert await deliveries_of(delay_ms=80.0) == 20  # each frame enters: nothing samples them
        assert 40.0 < r.proxy.stats.latency.summary()["mean"] < 160.0
        assert await deliveries_of(loss=1.0) == 0
        said = r.proxy._snapshot()
        assert said["state"] == SET_BY_HAND and said["by_hand"] == {"delay_ms": 0.0, "loss": 1.0}
        assert 0 < await deliveries_of() <= 20 and counts["lost"] == 20
        for wrong in ({"delay_ms": float("nan")}, {"delay_ms": -1.0}, {"delay_ms": 1e9}, {"loss": 1.5}):
            with pytest.raises(grpc.aio.AioRpcError, match="0 to 1"):
                await ask(channel_pb2.SetChannelRequest(**wrong))


SHORT = {"service": "det:300ms"}
FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("edge_is_there", [False, True], ids=["in the timer", "in the upstream task"])
async def test_a_full_disk_ends_the_emulator_and_its_other_books_are_closed(tmp_path, monkeypatch, edge_is_there):
    """A frame comes due whose fate cannot be recorded: broken at once, or forwarded by the stream's task."""
    monkeypatch.setattr(tuned, "FIRST_WAIT_S", 5.0 if edge_is_there else 0.1)
    edge = await Peer().start() if edge_is_there else None
    address = edge.address if edge else f"127.0.0.1:{free_port()}"
    proxy, (flow,) = make(tmp_path, address, SHORT, trace=tmp_path / "t.jsonl")
    running = asyncio.create_task(proxy.run(asyncio.Event()))
    await until(lambda: proxy.port and flow.opened.is_set() is edge_is_there)
    offer(flow, 0)
    proxy._trace.close()
    proxy._trace._file = FULL.open("wb", buffering=0)
    with pytest.raises(EmulatorFailed, match=r"No space left on device.*is there room"):
        async with asyncio.timeout(15):
            await running
    if edge:
        await edge.stop()
    assert json.loads((tmp_path / "channel.json").read_text())["running"] is False
    (ledger,) = read_all(tmp_path)
    assert ledger.closed


async def test_a_part_that_breaks_ends_the_emulator(tmp_path):
    """With an error that is no OSError."""
    proxy, _ = make(tmp_path, f"127.0.0.1:{free_port()}", SHORT)
    proxy.refresh = mock.Mock(side_effect=ChainError("no such state"))
    with pytest.raises(EmulatorFailed, match="ChainError: no such state"):
        async with asyncio.timeout(15):
            await proxy.run(asyncio.Event())


@pytest.mark.parametrize(
    "answers",
    [[b"\xff\xff\xff"], [pb.PushResponse(sequence=77).SerializeToString()] * 1000],
    ids=["no answer", "to no frame"],
)
async def test_answers_that_are_none_end_the_stream_and_not_the_emulator(tmp_path, answers):
    """Nor do they keep it busy for as long as they come."""

    async def nonsense(request: bytes, context: grpc.aio.ServicerContext) -> None:
        await context.read()
        for answer in answers:
            await context.write(answer)
        await asyncio.sleep(60)

    push = grpc.method_handlers_generic_handler(
        "freshfield.v1.FrameStreamService", {"Push": grpc.stream_stream_rpc_method_handler(nonsense)}
    )
    async with serving(Transport(), push) as port:
        proxy, (flow,) = make(tmp_path, f"localhost:{port}", {})
        await proxy.start()
        offer(flow, 0)
        await until(lambda: flow.connections >= 2)
        assert flow.broken == 1 and not proxy._failure.done()
        await proxy.stop()


async def test_an_edge_that_never_answers_costs_frames_and_no_memory(tmp_path):
    """The credits hold for frames and for bytes."""
    edge = await Peer(respond=silence).start()
    proxy, flows = make(tmp_path, edge.address, {}, ("cam00", "cam01"))
    await proxy.start()
    assert all(flow.connected for flow in flows), "cameras are let in once the streams to the edge stand"
    for n in range(200):
        offer(flows[0], n)
        await asyncio.sleep(0)
    await edge.until(CREDITS)
    assert (flows[0].pending, flows[0].broken) == (CREDITS + 1, 200 - CREDITS - 1)
    large = Message(bytes(5 * 2**20), "s", 0, flows[1])
    for _ in range(6):
        flows[1].send(large)
    assert (flows[1].pending, flows[1].broken) == (2, 4)  # one on its way, the newest held
    assert proxy._snapshot()["counts"]["in_flight"] == CREDITS + 3
    await proxy.stop()
    assert flows[0].broken == 200
    await edge.stop()


async def test_a_status_that_a_thread_still_holds_does_not_replace_the_last(tmp_path):
    proxy, _ = make(tmp_path, "127.0.0.1:1", {})
    proxy._write_status({"running": False})
    proxy._write_status({"running": True})
    assert json.loads((tmp_path / "channel.json").read_text()) == {"running": False}
