"""The development authority: what it makes lets every process do its own part, and no more."""

import asyncio
import stat

import grpc
import grpc.aio
import pytest

from edge_server.cli import main
from edge_server.live.keys_command import make_keys
from freshfield.transport import Transport, TransportError
from tests.deploy.test_up import healthy
from tests.freshfield.serving import serving
from tests.freshfield.test_access import Every
from tests.freshfield.test_transport import parsed
from tests.support import refusal, refused


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    out = tmp_path_factory.mktemp("keys") / "new"
    assert main(["keys", "tile", "--out", str(out), "--edge", "edge", "--emulator", "192.0.2.7"]) == 0
    return out


def of(folder, *more: str) -> Transport:
    files = ["--tls-cert", "cert.pem", "--tls-key", "key.pem", "--tls-ca", "ca.pem", *more]
    return parsed(*(w if w[0] == "-" else str(folder / w) for w in files))


async def test_a_certificate_lets_its_process_do_its_own_part(keys):
    push, status = "/freshfield.v1.FrameStreamService/Push", "/freshfield.v1.EdgeService/GetStatus"
    edge = of(keys / "edge", "--token-file", "tokens.txt")
    server = edge.aio_server()
    server.add_generic_rpc_handlers((Every(),))
    port = edge.bind(server, "0.0.0.0:0")  # beyond this machine, and nothing is amiss
    await server.start()
    found = {}
    for name in ("cam00", "emulator", "viewer", "edge"):
        async with of(keys / name).aio_channel(f"localhost:{port}") as channel:
            try:
                await channel.unary_unary(status)(b"", timeout=5)
                found[name] = "looks"
            except grpc.aio.AioRpcError as error:
                found[name] = error.code().name
            if name in ("cam00", "emulator"):
                call = channel.stream_stream(push)(timeout=5)
                await call.write(b"cam01")
                found[name] = (await call.read()).decode()
    tokens = dict(line.split() for line in (keys / "edge" / "tokens.txt").read_text().splitlines())
    async with Transport(ca=keys / "edge" / "ca.pem").aio_channel(f"localhost:{port}") as channel:
        with pytest.raises(grpc.aio.AioRpcError):  # no certificate, no connection
            await channel.unary_unary(status)(b"", timeout=5)
    await server.stop(None)
    assert found == {"cam00": "forbidden_camera", "emulator": "taken", "viewer": "looks", "edge": "looks"}
    assert tokens.keys() == {"operator", "viewer"} and len(set(tokens.values())) == 2


async def test_the_health_check_passes_mutual_tls(keys):
    files = [f"--tls-{part}={keys / 'emulator' / part}.pem" for part in ("cert", "key", "ca")]
    async with serving(of(keys / "emulator"), health=True) as port:
        found = [await asyncio.to_thread(healthy, "--serving", f"localhost:{port}", *more) for more in (files, [])]
    assert found == [True, False]


def test_keys_are_their_owners_alone_and_never_overwritten(keys, tmp_path, capsys):
    assert not any(stat.S_IMODE(path.stat().st_mode) & 0o077 for path in [keys, *keys.rglob("*")])
    assert "exists already: name a new folder" in refusal(capsys, main, "keys", "tile", "--out", keys)


def test_what_cannot_be_certified_is_named_and_leaves_nothing(tmp_path):
    for cameras, hosts, why in (
        (["c" * 60], [], "64 characters"),
        (["cam00", "viewer"], [], "camera .*viewer"),
        ([], ["edge,IP:192.0.2.1"], "'edge,IP:192.0.2.1'"),
        ([], [""], "''"),
    ):
        refused(TransportError, why, make_keys, tmp_path / "new", cameras, hosts, [])
        assert not list(tmp_path.iterdir())
