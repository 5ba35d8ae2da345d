"""Bytes of any protocol through a link: in order and whole, later where the link is slow, loses or damages."""

import asyncio
import contextlib
import socket
import time
from collections import Counter
from collections.abc import AsyncIterator

import numpy as np
import pytest

from channel_emu.live.live_emulator_constants import PIECE_BYTES, PIECES_BEHIND, RESEND_AFTER_S
from channel_emu.live.proxy import Proxy, ProxyOptions
from channel_emu.live.tcp_proxy import TcpProxy
from channel_emu.model import trace
from channel_emu.model.settings import channel_from_mapping
from freshfield.transport import TransportError
from tests.support import free_port, until

DATA = np.random.default_rng(0).integers(0, 256, 20 * PIECE_BYTES + 5, np.uint8).tobytes()


@contextlib.asynccontextmanager
async def echo(section: dict, host: str = "127.0.0.1", **options) -> AsyncIterator[TcpProxy]:
    """A proxy before a service that sends back what it gets."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(PIECE_BYTES):
            writer.write(data)
            await writer.drain()
        writer.write_eof()

    service = await asyncio.start_server(answer, host.strip("[]"), 0)
    to = f"{host}:{service.sockets[0].getsockname()[1]}"
    proxy = TcpProxy(channel_from_mapping(section), 3, ProxyOptions(f"{host}:0", to, **options))
    await proxy.start()
    try:
        yield proxy
        proxy.check()
    finally:
        await proxy.stop()
        service.close()


async def through(proxy: TcpProxy, data: bytes) -> bytes:
    """What comes back for ``data``."""
    reader, writer = await asyncio.open_connection(*proxy._listening.sockets[0].getsockname()[:2])
    writer.write(data)
    writer.write_eof()
    try:
        return await reader.read(-1)
    finally:
        writer.close()


@pytest.mark.parametrize(
    ("direction", "faults"), [("up", {}), ("both", {"loss": 0.2, "corruption": 0.2, "duplication": 0.5})]
)
async def test_everything_arrives_in_order(faults, direction, tmp_path):
    recorded = tmp_path / "trace.jsonl"
    async with echo({"service": "exp:2ms", "faults": faults}, direction=direction, trace=recorded) as proxy:
        both = await asyncio.gather(through(proxy, DATA), through(proxy, DATA[::-1]))
        assert both == [DATA, DATA[::-1]]
        report = proxy.report()
        assert set(report.by_method) == {"up bytes"} | ({"down bytes"} if direction == "both" else set())
        up = report.by_method["up bytes"]
        assert up.outcomes["forwarded"] >= 2 * 21 and up.in_flight == 0
        assert (up.dropped > 0) == ("loss" in faults)
    records = trace.read(recorded).records
    assert len(records) == report.offered
    due_ns: Counter[tuple[str, str]] = Counter()
    late_ms = []
    for r in sorted((r for r in records if r.actual_ns is not None), key=lambda r: r.sequence):
        due_ns[r.camera, r.session] = max(due_ns[r.camera, r.session], r.ended_ns)
        late_ms.append((r.actual_ns - due_ns[r.camera, r.session]) / 1e6)
    # A piece that waits for one before it is not late by the emulator's error.
    assert report.error_ms["mean"] == pytest.approx(np.mean(late_ms))


async def test_each_piece_takes_a_service_time_and_a_lost_one_a_timeout():
    async with echo({"service": "det:20ms"}) as proxy:
        began = time.monotonic()
        assert await through(proxy, DATA[: 10 * PIECE_BYTES]) == DATA[: 10 * PIECE_BYTES]
        assert time.monotonic() - began > 0.2
        assert proxy.report().delay_ms["mean"] == pytest.approx(20.0, abs=0.5)
    async with echo({"service": "det:1ms", "faults": {"blackout": {"windows_ms": [[0.0, 300.0]]}}}) as proxy:
        began = time.monotonic()
        assert await through(proxy, b"once") == b"once"
        assert time.monotonic() - began > RESEND_AFTER_S
        assert proxy.report().by_method["up bytes"].outcomes["lost"] >= 1


@pytest.mark.stability
async def test_a_sender_waits_for_a_slow_link():
    async with echo({"service": "det:60s"}) as proxy:
        _, writer = await asyncio.open_connection("127.0.0.1", proxy.port)
        writer.write(bytes(100 * PIECE_BYTES))
        await until(lambda: "up bytes" in proxy.links and proxy.links["up bytes"].model.offered >= PIECES_BEHIND)
        await asyncio.sleep(0.2)
        assert proxy.links["up bytes"].model.offered == PIECES_BEHIND
        writer.close()


@pytest.mark.stability
async def test_a_reader_slower_than_all_others_gets_the_end_too():
    async with echo({}) as proxy:
        proxy._listening.sockets[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        client = socket.socket()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", proxy.port))
        reader, writer = await asyncio.open_connection(sock=client, limit=1)
        writer.write(DATA[: 4 * PIECE_BYTES])
        writer.write_eof()
        await asyncio.sleep(0.3)
        assert await reader.read(-1) == DATA[: 4 * PIECE_BYTES]
        writer.close()


@pytest.mark.stability
async def test_a_reset_breaks_connections_and_the_next_one_works():
    async with echo({"service": "det:5ms", "faults": {"reset": {"at_ms": [400.0]}}}) as proxy:
        reader, writer = await asyncio.open_connection("127.0.0.1", proxy.port)
        with pytest.raises(ConnectionError):
            while True:
                writer.write(b"more")
                await writer.drain()
                assert await reader.read(4)  # a reset, not an end
        assert await through(proxy, b"again") == b"again"
        silent = asyncio.StreamReader()
        silent.set_exception(TimeoutError(110, "Connection timed out"))
        await asyncio.create_task(proxy._accept(silent, writer))  # ends its connection, not the proxy: ``echo`` checks


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="this system has no IPv6")
async def test_ipv6_addresses_stand_in_brackets():
    async with echo({}, "[::1]") as proxy:
        assert await through(proxy, b"once") == b"once"


@pytest.mark.stability
async def test_no_service_and_no_port(tmp_path):
    proxy = TcpProxy(channel_from_mapping({}), 0, ProxyOptions("127.0.0.1:0", f"127.0.0.1:{free_port()}"))
    await proxy.start()
    assert await through(proxy, b"anybody?") == b""
    for listen in (f"127.0.0.1:{proxy.port}", "0.0.0.0:0"):
        options = ProxyOptions(listen, "127.0.0.1:1", trace=tmp_path / "t.jsonl")
        for kind in (Proxy, TcpProxy):
            with pytest.raises(TransportError, match="cannot listen"):
                kind(channel_from_mapping({}), 0, options)
        assert not options.trace.exists()  # whoever has the port may be writing it
    await proxy.stop()
