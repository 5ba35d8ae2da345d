"""Channels and servers: token, TLS, ports, message limits."""

import argparse
import asyncio
import contextlib
import dataclasses
from pathlib import Path

import grpc
import grpc.aio
import numpy as np
import pytest

from edge_server.live.keys_command import _certify, make_keys
from freshfield import transport
from freshfield.limits import MAX_PAYLOAD_BYTES
from freshfield.transport import Transport, TransportError, host_port, peer_text, socket_address
from tests.freshfield.serving import serving, status
from tests.freshfield.test_access import Every
from tests.support import refused

CLOCK, FRAMES = "freshfield.v1.ClockService", "freshfield.v1.FrameStreamService"


async def sizes(_, context):
    while (message := await context.read()) is not grpc.aio.EOF:
        await context.write(str(len(message)).encode())


async def nothing(_, context):
    await asyncio.sleep(30)


async def ask(transport: Transport, port: int) -> bytes:
    async with transport.aio_channel(f"localhost:{port}") as channel:
        return await channel.unary_unary(f"/{CLOCK}/Exchange")(b"42", metadata=transport.metadata(), timeout=5)


async def push(channel: grpc.aio.Channel, size: int) -> int:
    call = channel.stream_stream(f"/{FRAMES}/Push")(timeout=20)
    await call.write(bytes(size))
    return int(await call.read())


async def test_plain_text_and_messages_up_to_the_limit():
    """Larger ones are refused by who sends them, and where that is a stranger by the server, which lives on."""
    unbounded = [("grpc.max_send_message_length", -1)]
    async with (
        serving(Transport(), Every(sizes)) as port,
        Transport().aio_channel(f"localhost:{port}") as channel,
        grpc.aio.insecure_channel(f"localhost:{port}", options=unbounded) as of_stranger,
    ):
        assert await push(channel, MAX_PAYLOAD_BYTES) == MAX_PAYLOAD_BYTES
        await status(push(channel, MAX_PAYLOAD_BYTES + 8192))
        assert await status(push(of_stranger, 4 * MAX_PAYLOAD_BYTES)) == "RESOURCE_EXHAUSTED"
        assert await ask(Transport(), port) == b"42"


RIGHT = Transport(tokens={"camera:*": "right"})


async def test_a_port_in_use_is_not_shared_nor_one_opened_unprotected():
    async with serving(Transport()) as port:
        for address, why in ((f"localhost:{port}", f"localhost:{port}"), ("0.0.0.0:0", "nothing is encrypted")):
            refused(TransportError, why, Transport().bind, Transport().aio_server(), address)


def test_host_and_port_are_told_apart():
    assert host_port("emu:7001") == ("emu", 7001) and host_port(":7001") == ("127.0.0.1", 7001)
    assert host_port("0.0.0.0:0") == ("0.0.0.0", 0) and host_port("[::1]:65535") == ("[::1]", 65535)
    assert socket_address("[::1]:7001") == ("::1", 7001) and socket_address("emu:7001") == ("emu", 7001)
    for wrong in ("", "host", "7001", "host:", "host:-1", "host:65536", "host:\u00b2", "::1:7001", "unix:/tmp/s"):
        refused(TransportError, "expected HOST:PORT", host_port, wrong)


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    """Of a deployment, as ``edge-server keys`` makes them; of one whom it certified and whose name is no caller's; and
    a stranger's."""
    folder = tmp_path_factory.mktemp("keys")
    make_keys(folder / "ours", [], [], [])
    for name, authority in (("nobody", folder / "ours"), ("stranger", None)):
        (folder / name).mkdir()
        _certify(folder / name, name, (), authority)
    return folder


def own(folder: Path) -> dict[str, Path]:
    """A certificate and its key."""
    return {"cert": folder / "cert.pem", "key": folder / "key.pem"}


async def test_tls_and_mutual_tls(keys):
    server_tls, ca = Transport(**own(keys / "ours/edge")), keys / "ours/edge/ca.pem"
    trusting, deceived = Transport(ca=ca), Transport(ca=keys / "stranger/cert.pem")
    known, nobody = (Transport(**own(keys / who), ca=ca) for who in ("ours/viewer", "nobody"))

    async with serving(server_tls, Every(sizes)) as port:
        assert await ask(trusting, port) == b"42"
        for client in (deceived, Transport()):
            assert await status(ask(client, port)) == "UNAVAILABLE"
    async with serving(dataclasses.replace(server_tls, ca=ca), Every(sizes)) as port:
        assert await ask(known, port) == b"42"
        assert await status(ask(trusting, port)) == "UNAVAILABLE"
        assert await status(ask(nobody, port)) == "UNAUTHENTICATED", "its name is no caller's"
        wrong_token = dataclasses.replace(known, tokens={"": "wrong"})
        assert await status(ask(wrong_token, port)) == "UNAUTHENTICATED", "a certificate does not make it good"


@pytest.mark.parametrize("encrypted", [False, True])
async def test_connections_are_few_and_those_that_do_nothing_end(encrypted, keys, monkeypatch):
    """Over TLS four in their handshake take all places, and end with its time-out; else four without a call,
    which have said that they speak HTTP/2."""
    changed = {"grpc.max_allowed_incoming_connections": 4, "grpc.max_connection_idle_ms": 1000}
    changed |= {"grpc.server_handshake_timeout_ms": 1000 if encrypted else 60_000}
    tls = Transport(**own(keys / "ours/edge")) if encrypted else Transport()
    caller = Transport(ca=keys / "ours/edge/ca.pem") if encrypted else Transport()
    fewer = [(name, changed.get(name, value)) for name, value in transport.SERVER_OPTIONS]
    monkeypatch.setattr(transport, "SERVER_OPTIONS", fewer)

    async def ended(reader):
        while await reader.read(4096):
            pass

    async with serving(tls, Every(sizes)) as port:
        kept = [await asyncio.open_connection("localhost", port) for _ in range(4)]
        if not encrypted:
            preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])  # and empty SETTINGS
            for reader, writer in kept:
                writer.write(preface)
                await reader.readexactly(1)
        await asyncio.sleep(0.2)
        surplus = [await asyncio.open_connection("localhost", port) for _ in range(20)]
        assert await asyncio.wait_for(asyncio.gather(*(r.read(1) for r, _ in surplus)), 5.0) == [b""] * 20
        await asyncio.wait_for(asyncio.gather(*(ended(reader) for reader, _ in kept)), 10.0)
        assert await ask(caller, port) == b"42"
        for _, writer in kept + surplus:
            writer.close()


def test_a_server_refuses_to_listen_unprotected_beyond_this_machine():
    tls = {"cert": Path("c"), "key": Path("k")}
    for given, host, why in (
        (Transport(ca=Path("ca")), "127.0.0.1", "--tls-ca .* needs --tls-cert"),
        (Transport(tokens={"": "x"}), "127.0.0.1", "NAME TOKEN"),
        (RIGHT, "0.0.0.0", "nothing is encrypted"),
        (Transport(**tls), "0.0.0.0", "callers are not authenticated"),
        (Transport(), "[::]", "nothing is encrypted .* and callers are not authenticated"),
    ):
        refused(TransportError, why, given.guard, host, "gRPC")
    with pytest.raises(TransportError, match="machines, and nobody can log in"):
        Transport(**tls, ca=Path("ca")).guard("0.0.0.0", "page", http=True)
    assert Transport(**tls, tokens={"viewer": "x"}).guard("0.0.0.0", "page", http=True) == ""
    assert Transport(**tls, ca=Path("ca")).guard("0.0.0.0", "gRPC") == ""
    for host in ("127.0.0.1", "127.1.2.3", "::1", "[::1]", "localhost"):
        assert Transport().guard(host, "page") == ""
    words = Transport(insecure=True).guard("0.0.0.0", "page")
    assert "nothing is encrypted" in words and "callers are not authenticated" in words


async def test_a_token_does_not_leave_the_machine_in_plain_text():
    refused(TransportError, "plain text", RIGHT.aio_channel, "edge:7000")
    await dataclasses.replace(RIGHT, insecure=True).aio_channel("edge:7000").close()


def parsed(*arguments: str) -> Transport:
    parser = argparse.ArgumentParser()
    transport.add_arguments(parser)
    return transport.from_arguments(parser.parse_args(arguments))


def test_options_become_a_transport(keys, tmp_path):
    token, damaged = tmp_path / "token", tmp_path / "damaged.pem"
    token.write_text("  secret\n")
    assert parsed() == Transport()
    assert parsed("--token-file", str(token)).metadata() == (("authorization", "Bearer secret"),)
    token.write_text("camera:cam00 one\n\noperator two\n")
    assert parsed("--token-file", str(token)).tokens == {"camera:cam00": "one", "operator": "two"}
    for wrong in ("viewer a\nviewer b", "viewer a\noperator a", "a\nb", "viewer a b", "\n"):
        token.write_text(wrong)
        refused(TransportError, r"NAME TOKEN|is empty", parsed, "--token-file", str(token))
    damaged.write_text("-----BEGIN CERTIFICATE-----\nMIIB\n")
    for words, why in (
        (("--tls-ca", str(tmp_path / "none.pem")), "cannot read"),
        (("--tls-cert", str(token)), "go together"),
        (("--tls-ca", str(damaged)), r"damaged\.pem holds no certificate"),
        (("--tls-cert", str(damaged), "--tls-key", str(damaged)), r"cannot use --tls-cert .*damaged\.pem"),
    ):
        refused(TransportError, why, parsed, *words)


async def test_a_slow_reader_is_felt_at_once():
    """bdp_probe=0: a client cannot bury a stalled reader under megabytes of frames, which are age."""

    written = 0
    plain = Transport()
    async with serving(plain, Every(nothing)) as port, plain.aio_channel(f"localhost:{port}") as channel:
        call = channel.stream_stream(f"/{FRAMES}/Push")()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(2):
                while written < 100:
                    await call.write(bytes(100_000))
                    written += 1
        call.cancel()
    assert written < 20


def test_the_back_off_doubles_to_its_bound_and_draws_once_each_time():
    jitter, same = np.random.default_rng(4), np.random.default_rng(4)
    pauses = [transport.backoff_s(failures, 0.2, 3.0, jitter) for failures in (0, 1, 2, 3, 4, 5, 10_000)]
    expected = [0.2, 0.4, 0.8, 1.6, 3.0, 3.0, 3.0]
    assert pauses == [pause * same.uniform(0.5, 1.0) for pause in expected]


def test_what_a_peer_says_stays_on_one_line_of_a_log():
    assert peer_text(None) == "" and peer_text("a b") == "a b"
    assert peer_text("\x1b[2J\r\nWARNING all is well\u202e") == r"\x1b[2J\r\nWARNING all is well\u202e"
    assert len(peer_text("x" * 10**6)) == 200
