"""Who may do what: names, tokens, certificates, and the role table's cells of gRPC."""

import asyncio
import base64

import grpc
import grpc.aio

from freshfield.access import ANYBODY, CALLS, LOOK, Access, Caller, HttpDoor, HttpRefused
from freshfield.frame import FrameRejected
from freshfield.streams import ServedCall, SessionStreams
from freshfield.transport import Transport
from freshfield.v1 import channel_pb2, clock_pb2, edge_pb2, frames_pb2
from tests.freshfield.serving import serving
from tests.role_table import TOKENS, cells_of
from tests.support import refused

STREAMS = ("Push", "WatchDecisions", "ServerReflectionInfo")


async def echo(request: bytes, context: grpc.aio.ServicerContext) -> bytes:
    return request


async def cameras(_: object, context: grpc.aio.ServicerContext) -> None:
    """As ingest and emulator do: each message is a camera's id, answered by whether it may be pushed."""
    sessions = SessionStreams(["cam00", "cam01"])
    async with ServedCall(context) as call:
        while (message := await context.read()) is not grpc.aio.EOF:
            try:
                sessions.claim(message.decode(), "s", call, 0)
                await context.write(b"taken")
            except FrameRejected as error:
                await context.write(error.reason.encode())


async def one_answer(_: object, context: grpc.aio.ServicerContext):
    yield b""


class Every(grpc.GenericRpcHandler):
    """A handler of every method. push: of streams of frames."""

    def __init__(self, push=cameras) -> None:
        self._push = push

    def service(self, details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler:
        if details.method.endswith("Push"):
            return grpc.stream_stream_rpc_method_handler(self._push)
        if details.method.endswith(STREAMS):
            return grpc.stream_stream_rpc_method_handler(one_answer)
        return grpc.unary_unary_rpc_method_handler(echo)


async def outcome(port: int, method: str, token: str | None, message: bytes = b"") -> str:
    """The status of a call, or the answer to a camera's frame."""
    metadata = (("authorization", f"Bearer {token}"),) if token else ()
    async with Transport().aio_channel(f"localhost:{port}") as channel:
        try:
            if not method.endswith(STREAMS):
                await channel.unary_unary(method)(b"", metadata=metadata, timeout=5)
                return "OK"
            call = channel.stream_stream(method)(metadata=metadata, timeout=5)
            # Nothing is written to a stream that is refused: see ``test_transport.push``.
            if message and token == TOKENS["camera:cam00"]:
                await call.write(message)
                return (await call.read()).decode()
            await call.read()
            return "OK"
        except grpc.aio.AioRpcError as error:
            return error.code().name


def asked(*calls: tuple) -> list[str]:
    """The outcomes of calls at a server with the tokens of the table."""

    async def scene() -> list[str]:
        async with serving(Transport(tokens=TOKENS), Every()) as port:
            return [await outcome(port, *call) for call in calls]

    return asyncio.run(scene())


def expected(camera: str, who: str, may: bool) -> str:
    if may:
        return "taken" if camera else "OK"
    if who == "nobody":
        return "UNAUTHENTICATED"
    return "forbidden_camera" if camera and "cam" in who else "PERMISSION_DENIED"


def test_every_cell_of_the_role_table():
    cells = [(*what.replace("`", "").partition(" of "), who, may) for what, who, may in cells_of("`/")]
    messages = {"its own camera": b"cam00", "another camera": b"cam01", "": b""}
    found = asked(*((method, TOKENS.get(who), messages[camera]) for method, _, camera, who, _ in cells))
    assert len(cells) > 20
    for cell, outcome_of_cell in zip(cells, found):
        _, _, camera, who, may = cell
        assert outcome_of_cell == expected(camera, who, may), cell


def test_every_method_has_its_row_and_others_are_the_operators():
    ours = {
        f"/{service.full_name}/{method.name}"
        for module in (frames_pb2, clock_pb2, channel_pb2, edge_pb2)
        for service in module.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    }
    rows = {what.replace("`", "").partition(" of ")[0] for what, *_ in cells_of("`/")}
    assert ours < CALLS.keys() and rows == {*CALLS, "/grpc.health.v1.Health/Check"}
    other = "/your.Tracker/Follow"
    assert asked((other, TOKENS["operator"]), (other, TOKENS["viewer"])) == ["OK", "PERMISSION_DENIED"]


def test_a_name_says_role_and_cameras():
    assert Caller.named("camera:a,b").may_push("b") and not Caller.named("camera:a,b").may_push("c")
    assert Caller.named("camera:*").may_push("c") and not Caller.named("camera:*").may(LOOK)
    assert not Caller.named("operator").may_push("a") and ANYBODY.may_push("a")
    for wrong in ("", "camera", "camera:", "camera:a,", "camera:../x", "viewer:a", "root", "Operator"):
        refused(ValueError, "expected operator", Caller.named, wrong)


def test_a_browsers_login_is_the_token_as_password():
    access = Access(TOKENS, certificates=False)
    for name, token in TOKENS.items():
        basic = base64.b64encode(f"whoever:{token}".encode()).decode()
        assert access.of_header(f"Basic {basic}") == access.of_header(f"bearer {token}") == Caller.named(name)
    for wrong in ("Basic é", "Basic ====", "Basic", f"Digest {TOKENS['viewer']}", TOKENS["viewer"], "Bearer ", ""):
        assert access.of_header(wrong) is None
    # Who gives tokens has everybody asked, on loopback too. An authority alone lets nobody log in.
    for tokens, host in ((TOKENS, "127.0.0.1"), ({}, "0.0.0.0")):
        refused(HttpRefused, "log in", HttpDoor(Access(tokens, certificates=True), host).caller, None)
    for certificates in (False, True):
        assert HttpDoor(Access({}, certificates), "127.0.0.1").caller(None) == ANYBODY


def test_a_page_answers_its_own_names_and_origins_alone():
    door = HttpDoor(Access({}, certificates=False), "127.0.0.1")
    for host in ("localhost", "localhost:9090", "127.0.0.1:1", "[::1]:80", "192.0.2.7"):
        door.check_origin(host, None)
        door.check_origin(host, f"http://{host}")
        for foreign in ("http://evil.example", "null", f"http://{host}.evil.example", f"http://{host}0", ""):
            refused(HttpRefused, "", door.check_origin, host, foreign)
    for host in (None, "", "evil.example:8080", "localhost.evil.example", "127.0.0.1.nip.io"):
        refused(HttpRefused, "Host", door.check_origin, host, None)
        HttpDoor(Access(TOKENS, certificates=False), "0.0.0.0").check_origin(host, None)  # its cookie is not sent
