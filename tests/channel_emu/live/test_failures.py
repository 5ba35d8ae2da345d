"""What breaks inside or behind the live emulator ends it, or its stream, in plain sight; an edge that is slow or away
costs frames and nothing else."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import grpc
import grpc.aio
import pytest

from channel_emu.live import frame_proxy
from channel_emu.live.camera_stream import CREDITS
from channel_emu.live.live_link import Message
from channel_emu.live.proxy import EmulatorFailed, Proxy
from channel_emu.model.chain import ChainError
from freshfield.ledger import read_all
from freshfield.transport import Transport
from freshfield.v1 import frames_pb2 as pb
from tests.channel_emu.live.emulator import make, offer
from tests.integration.peer import Peer, silence
from tests.support import free_port

SHORT = {"service": "det:300ms"}
FULL = Path("/dev/full")
SERVICE = "freshfield.v1.FrameStreamService"
STRANGE = pb.PushResponse(sequence=77).SerializeToString()


def fill_the_disk(proxy: Proxy) -> None:
    """From here on every line of the trace meets a full disk."""
    assert proxy._trace is not None
    proxy._trace.close()
    proxy._trace._file = FULL.open("wb", buffering=0)


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("edge_is_there", [False, True], ids=["in the timer", "in the upstream task"])
async def test_a_full_disk_ends_the_emulator_and_its_other_books_are_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edge_is_there: bool
) -> None:
    """A frame comes due whose fate cannot be recorded: broken at once, or forwarded by the stream's task."""
    monkeypatch.setattr(frame_proxy, "_FIRST_WAIT_S", 5.0 if edge_is_there else 0.1)
    edge = await Peer().start() if edge_is_there else None
    address = edge.address if edge else f"127.0.0.1:{free_port()}"
    proxy, (flow,) = make(tmp_path, address, SHORT, trace=tmp_path / "t.jsonl")
    running = asyncio.create_task(proxy.run(asyncio.Event()))
    while not proxy.port or flow.opened.is_set() is not edge_is_there:
        await asyncio.sleep(0.01)
    offer(flow, 0)
    fill_the_disk(proxy)
    with pytest.raises(EmulatorFailed, match=r"No space left on device.*is there room"):
        async with asyncio.timeout(15):
            await running
    if edge:
        await edge.stop()
    assert json.loads((tmp_path / "channel.json").read_text())["running"] is False
    (ledger,) = read_all(tmp_path)
    assert ledger.closed


def raising(*_: object) -> None:
    raise ChainError("no such state")


def break_background(proxy: frame_proxy.FrameProxy) -> None:
    proxy.channel.forget = raising


def break_timer(proxy: frame_proxy.FrameProxy) -> None:
    proxy.flows["cam00"].link.advance = raising


@pytest.mark.parametrize("break_it", [break_background, break_timer])
async def test_a_part_that_breaks_ends_the_emulator(tmp_path: Path, monkeypatch, break_it) -> None:
    """With an error that is no OSError."""
    monkeypatch.setattr(frame_proxy, "_FIRST_WAIT_S", 0.1)
    proxy, (flow,) = make(tmp_path, f"127.0.0.1:{free_port()}", SHORT)
    break_it(proxy)
    running = asyncio.create_task(proxy.run(asyncio.Event()))
    await asyncio.sleep(0.3)
    if not running.done():
        offer(flow, 0)
    with pytest.raises(EmulatorFailed, match="ChainError: no such state"):
        async with asyncio.timeout(15):
            await running


@pytest.mark.parametrize("answers", [[b"\xff\xff\xff"], [STRANGE] * 1000], ids=["no answer", "to no frame"])
async def test_answers_that_are_none_end_the_stream_and_not_the_emulator(tmp_path: Path, answers: list[bytes]) -> None:
    """Nor do they keep it busy for as long as they come."""

    async def nonsense(request: bytes, context: grpc.aio.ServicerContext) -> None:
        await context.read()
        for answer in answers:
            await context.write(answer)
        await asyncio.sleep(60)

    server = Transport().aio_server()
    handler = {"Push": grpc.stream_stream_rpc_method_handler(nonsense)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, handler),))
    address = f"127.0.0.1:{Transport().bind(server, '127.0.0.1:0')}"
    await server.start()
    proxy, (flow,) = make(tmp_path, address, {})
    await proxy.start()
    offer(flow, 0)
    async with asyncio.timeout(10):
        while flow.connections < 2:
            await asyncio.sleep(0.01)
    assert flow.broken == 1 and not proxy._failure.done()
    await proxy.stop()
    await server.stop(None)


async def test_an_edge_that_never_answers_costs_frames_and_no_memory(tmp_path: Path) -> None:
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


async def test_a_status_that_a_thread_still_holds_does_not_replace_the_last(tmp_path: Path) -> None:
    proxy, _ = make(tmp_path, "127.0.0.1:1", {})
    proxy._write_status({"running": False})
    proxy._write_status({"running": True})
    assert json.loads((tmp_path / "channel.json").read_text()) == {"running": False}
