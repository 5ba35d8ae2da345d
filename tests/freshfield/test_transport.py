"""Channels and servers: token, TLS, ports, message limits."""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import shutil
import subprocess
from contextlib import asynccontextmanager
from pathlib import Path

import grpc
import grpc.aio
import numpy as np
import pytest

from freshfield import transport
from freshfield.limits import MAX_PAYLOAD_BYTES
from freshfield.transport import (
    Transport,
    TransportError,
    add_arguments,
    backoff_s,
    from_arguments,
    host_port,
    peer_text,
)
from freshfield.v1 import clock_pb2, clock_pb2_grpc, frames_pb2_grpc
from freshfield.v1 import frames_pb2 as pb


class Clock(clock_pb2_grpc.ClockServiceServicer):
    async def Exchange(self, request, context):
        return clock_pb2.ExchangeResponse(client_sent_ns=request.client_sent_ns)


class Frames(frames_pb2_grpc.FrameStreamServiceServicer):
    async def Push(self, request_iterator, context):
        async for request in request_iterator:
            yield pb.PushResponse(sequence=len(request.payload))


@asynccontextmanager
async def serving(transport: Transport, frames: frames_pb2_grpc.FrameStreamServiceServicer | None = None):
    """A server of both services; gives its port."""
    server = transport.aio_server()
    clock_pb2_grpc.add_ClockServiceServicer_to_server(Clock(), server)
    frames_pb2_grpc.add_FrameStreamServiceServicer_to_server(frames or Frames(), server)
    port = transport.bind(server, "localhost:0")
    await server.start()
    try:
        yield port
    finally:
        await server.stop(None)


async def ask(transport: Transport, port: int) -> int:
    async with transport.aio_channel(f"localhost:{port}") as channel:
        call = clock_pb2_grpc.ClockServiceStub(channel).Exchange(
            clock_pb2.ExchangeRequest(client_sent_ns=42), metadata=transport.metadata(), timeout=5
        )
        return (await call).client_sent_ns


async def push(transport: Transport, port: int, size: int) -> int:
    async with transport.aio_channel(f"localhost:{port}") as channel:
        call = frames_pb2_grpc.FrameStreamServiceStub(channel).Push(metadata=transport.metadata(), timeout=20)
        await call.write(pb.PushRequest(payload=bytes(size)))
        return (await call.read()).sequence


def refusal(work) -> grpc.StatusCode:
    with pytest.raises(grpc.aio.AioRpcError) as error:
        asyncio.run(work)
    return error.value.code()


async def test_plain_text_and_messages_up_to_the_limit():
    """Larger ones are refused by who sends them, and where that is a stranger by the server, which lives on."""
    async with (
        serving(Transport()) as port,
        grpc.aio.insecure_channel(f"localhost:{port}", options=[("grpc.max_send_message_length", -1)]) as of_stranger,
    ):
        assert await ask(Transport(), port) == 42
        assert await push(Transport(), port, MAX_PAYLOAD_BYTES) == MAX_PAYLOAD_BYTES
        with pytest.raises(grpc.aio.AioRpcError):
            await push(Transport(), port, MAX_PAYLOAD_BYTES + 8192)
        call = frames_pb2_grpc.FrameStreamServiceStub(of_stranger).Push(timeout=20)
        await call.write(pb.PushRequest(payload=bytes(4 * MAX_PAYLOAD_BYTES)))
        with pytest.raises(grpc.aio.AioRpcError) as refused:
            await call.read()
        assert refused.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
        assert await ask(Transport(), port) == 42


RIGHT = Transport(tokens={"camera:*": "right"})


async def test_a_port_in_use_is_not_shared():
    async with serving(Transport()) as port:
        with pytest.raises(TransportError, match=f"localhost:{port}"):
            Transport().bind(Transport().aio_server(), f"localhost:{port}")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("emu:7001", ("emu", 7001)),
        (":7001", ("127.0.0.1", 7001)),
        ("0.0.0.0:0", ("0.0.0.0", 0)),
        ("[::1]:65535", ("[::1]", 65535)),
    ],
)
def test_host_and_port_are_told_apart(text, expected):
    assert host_port(text) == expected


NO_ADDRESSES = ["", "host", "7001", "host:", "host:-1", "host:65536", "host:\u00b2", "::1:7001", "unix:/tmp/s"]


@pytest.mark.parametrize("text", NO_ADDRESSES)
def test_what_is_no_address_is_refused_by_name(text):
    with pytest.raises(TransportError, match="expected HOST:PORT"):
        host_port(text)


@pytest.fixture(scope="module")
def pem(tmp_path_factory):
    """An authority, a server's and a client's certificate, and a stranger's."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    folder = tmp_path_factory.mktemp("pem")

    def openssl(line: str) -> None:
        subprocess.run(["openssl", *line.split()], check=True, capture_output=True, cwd=folder)

    for name in ("ca", "stranger"):
        openssl(f"req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN={name} -keyout {name}.key -out {name}.pem")
    (folder / "ext").write_text("subjectAltName=DNS:localhost")
    for name, subject in (("server", "server"), ("client", "viewer")):
        openssl(f"req -newkey rsa:2048 -nodes -subj /CN={subject} -keyout {name}.key -out {name}.csr")
        signing = "-CA ca.pem -CAkey ca.key -days 2 -CAcreateserial -extfile ext"
        openssl(f"x509 -req -in {name}.csr {signing} -out {name}.pem")
    return folder


def test_tls_and_mutual_tls(pem):
    server_tls = Transport(cert=pem / "server.pem", key=pem / "server.key")
    mutual = Transport(cert=pem / "server.pem", key=pem / "server.key", ca=pem / "ca.pem")
    trusting = Transport(ca=pem / "ca.pem")
    known = Transport(cert=pem / "client.pem", key=pem / "client.key", ca=pem / "ca.pem")
    deceived = Transport(ca=pem / "stranger.pem")

    async def scene(server_side, client):
        async with serving(server_side) as port:
            return await ask(client, port)

    assert asyncio.run(scene(server_tls, trusting)) == 42
    assert asyncio.run(scene(mutual, known)) == 42
    for server_side, client in ((server_tls, deceived), (server_tls, Transport()), (mutual, trusting)):
        assert refusal(scene(server_side, client)) == grpc.StatusCode.UNAVAILABLE
    other = Transport(cert=pem / "server.pem", key=pem / "server.key", ca=pem / "ca.pem")
    assert refusal(scene(mutual, other)) == grpc.StatusCode.UNAUTHENTICATED  # its name is no caller's


async def test_a_connection_without_its_tls_handshake_ends(pem, monkeypatch):
    sooner = [(name, 500 if "handshake" in name else value) for name, value in transport.SERVER_OPTIONS]
    monkeypatch.setattr(transport, "SERVER_OPTIONS", sooner)
    async with serving(Transport(cert=pem / "server.pem", key=pem / "server.key")) as port:
        reader, writer = await asyncio.open_connection("localhost", port)
        assert await asyncio.wait_for(reader.read(1), 10.0) == b""
        writer.close()


PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])  # and empty SETTINGS


@pytest.mark.parametrize("encrypted", [False, True])
async def test_connections_are_few_and_those_that_do_nothing_end(encrypted, pem, monkeypatch):
    """Over TLS four in their handshake take all places, and end with its time-out; else four without a call,
    which have said that they speak HTTP/2."""
    changed = {"grpc.max_allowed_incoming_connections": 4, "grpc.max_connection_idle_ms": 1000}
    changed |= {"grpc.server_handshake_timeout_ms": 1000 if encrypted else 60_000}
    tls = Transport(cert=pem / "server.pem", key=pem / "server.key") if encrypted else Transport()
    caller = Transport(ca=pem / "ca.pem") if encrypted else Transport()
    fewer = [(name, changed.get(name, value)) for name, value in transport.SERVER_OPTIONS]
    monkeypatch.setattr(transport, "SERVER_OPTIONS", fewer)

    async def ended(reader):
        while await reader.read(4096):
            pass

    async with serving(tls) as port:
        kept = [await asyncio.open_connection("localhost", port) for _ in range(4)]
        if not encrypted:
            for reader, writer in kept:
                writer.write(PREFACE)
                await reader.readexactly(1)
        await asyncio.sleep(0.2)
        surplus = [await asyncio.open_connection("localhost", port) for _ in range(20)]
        assert await asyncio.wait_for(asyncio.gather(*(r.read(1) for r, _ in surplus)), 5.0) == [b""] * 20
        await asyncio.wait_for(asyncio.gather(*(ended(reader) for reader, _ in kept)), 10.0)
        assert await ask(caller, port) == 42
        for _, writer in kept + surplus:
            writer.close()


LISTENING = {
    "an authority alone": (Transport(ca=Path("ca")), "127.0.0.1", "--tls-ca .* needs --tls-cert"),
    "a token without a name": (Transport(tokens={"": "x"}), "127.0.0.1", "NAME TOKEN"),
    "plain text": (RIGHT, "0.0.0.0", "nothing is encrypted"),
    "nobody asked": (Transport(cert=Path("c"), key=Path("k")), "0.0.0.0", "nobody is asked"),
    "no address": (Transport(), "[::]", "nothing is encrypted .* and nobody is asked"),
}


@pytest.mark.parametrize("what", LISTENING)
async def test_a_server_refuses_to_listen_unprotected(what):
    transport, host, why = LISTENING[what]
    with pytest.raises(TransportError, match=why):
        transport.bind(Transport().aio_server(), f"{host}:0")


def test_what_protects_a_port_beyond_this_machine():
    tls = {"cert": Path("c"), "key": Path("k")}
    assert Transport(**tls, tokens={"viewer": "x"}).guard("0.0.0.0", "page", http=True) == ""
    assert Transport(**tls, ca=Path("ca")).guard("0.0.0.0", "gRPC") == ""
    with pytest.raises(TransportError, match="machines, and nobody can log in"):
        Transport(**tls, ca=Path("ca")).guard("0.0.0.0", "page", http=True)
    for host in ("127.0.0.1", "127.1.2.3", "::1", "[::1]", "localhost"):
        assert Transport().guard(host, "page") == ""
    words = Transport(insecure=True).guard("0.0.0.0", "page")
    assert "nothing is encrypted" in words and "nobody is asked" in words


async def test_a_token_does_not_leave_the_machine_in_plain_text():
    with pytest.raises(TransportError, match="plain text"):
        RIGHT.aio_channel("edge:7000")
    await dataclasses.replace(RIGHT, insecure=True).aio_channel("edge:7000").close()


def parsed(*arguments: str) -> Transport:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return from_arguments(parser.parse_args(arguments))


def test_options_become_a_transport(tmp_path):
    token = tmp_path / "token"
    token.write_text("  secret\n")
    transport = parsed("--token-file", str(token))
    assert transport.metadata() == (("authorization", "Bearer secret"),)
    assert parsed() == Transport()
    token.write_text("camera:cam00 one\n\noperator two\n")
    assert parsed("--token-file", str(token)).tokens == {"camera:cam00": "one", "operator": "two"}
    for wrong in ("viewer a\nviewer b", "viewer a\noperator a", "a\nb", "viewer a b"):
        token.write_text(wrong)
        with pytest.raises(TransportError, match="NAME TOKEN"):
            parsed("--token-file", str(token))
    token.write_text("\n")
    with pytest.raises(TransportError, match="empty"):
        parsed("--token-file", str(token))
    with pytest.raises(TransportError, match="cannot read"):
        parsed("--tls-ca", str(tmp_path / "none.pem"))
    with pytest.raises(TransportError, match="go together"):
        parsed("--tls-cert", str(token))


@pytest.mark.parametrize("text", ["", "no certificate", "-----BEGIN CERTIFICATE-----\nMIIB\n"])
def test_files_that_hold_no_certificate_are_refused_by_name(pem, tmp_path, text):
    (damaged := tmp_path / "damaged.pem").write_text(text)
    with pytest.raises(TransportError, match=r"--tls-ca .*damaged\.pem holds no certificate"):
        parsed("--tls-ca", str(damaged))
    with pytest.raises(TransportError, match=r"cannot use --tls-cert .*damaged\.pem"):
        parsed("--tls-cert", str(damaged), "--tls-key", str(pem / "server.key"))


async def test_a_slow_reader_is_felt_at_once():
    """bdp_probe=0: a client cannot bury a stalled reader under megabytes of frames, which are age."""

    class Stalled(frames_pb2_grpc.FrameStreamServiceServicer):
        async def Push(self, request_iterator, context):
            await asyncio.sleep(30)
            yield pb.PushResponse()

    written = 0
    async with serving(Transport(), Stalled()) as port, Transport().aio_channel(f"localhost:{port}") as channel:
        call = frames_pb2_grpc.FrameStreamServiceStub(channel).Push()
        try:
            async with asyncio.timeout(2):
                while written < 100:
                    await call.write(pb.PushRequest(payload=bytes(100_000)))
                    written += 1
        except TimeoutError:
            pass
        call.cancel()
    assert written < 20


def test_the_back_off_doubles_to_its_bound_and_draws_once_each_time():
    jitter, same = np.random.default_rng(4), np.random.default_rng(4)
    pauses = [backoff_s(failures, 0.2, 3.0, jitter) for failures in (0, 1, 2, 3, 4, 5, 10_000)]
    expected = [0.2, 0.4, 0.8, 1.6, 3.0, 3.0, 3.0]
    assert pauses == [pause * same.uniform(0.5, 1.0) for pause in expected]


def test_what_a_peer_says_stays_on_one_line_of_a_log():
    assert peer_text(None) == "" and peer_text("a b") == "a b"
    assert peer_text("\x1b[2J\r\nWARNING all is well\u202e") == r"\x1b[2J\r\nWARNING all is well\u202e"
    assert len(peer_text("x" * 10**6)) == 200
