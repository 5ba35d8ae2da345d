"""A server's open streams: nobody shuts the others out, and nobody goes on with another's session."""

import asyncio
import gc
from contextlib import asynccontextmanager, suppress

import grpc
import grpc.aio

from freshfield import streams as served
from freshfield.access import ANYBODY
from freshfield.frame import FrameRejected
from freshfield.limits import MAX_SESSIONS_PER_CAMERA, SESSION_IDLE_NS
from freshfield.streams import OpenStreams, SessionStreams
from freshfield.transport import Transport
from tests.freshfield.serving import serving
from tests.support import refused, until


@asynccontextmanager
async def echoing(streams: OpenStreams):
    """A server that answers each message; ``use`` marks a stream that sent b"use". Yields a channel."""

    async def answer(_, context):
        async with streams.open(context) as call:
            await call.send(context.send_initial_metadata, ())
            while (message := await context.read()) is not grpc.aio.EOF:
                if message == b"use":
                    call.use()
                await call.write(message)

    async def pour(_, context):
        async with streams.open(context) as call:
            while True:
                for _ in range(5):
                    await call.write(bytes(2000))
                await asyncio.sleep(0.002)

    async def unary(request, _):
        return request

    handler = {
        "Unary": grpc.unary_unary_rpc_method_handler(unary),
        "Echo": grpc.stream_stream_rpc_method_handler(answer),
        "Pour": grpc.unary_stream_rpc_method_handler(pour),
    }
    async with (
        serving(Transport(), grpc.method_handlers_generic_handler("t", handler), health=True) as port,
        Transport().aio_channel(f"localhost:{port}") as channel,
    ):
        yield channel


async def opened(channel, say: bytes | None = None):
    call = channel.stream_stream("/t/Echo")()
    await call.initial_metadata()
    if say is not None:
        await call.write(say)
        assert await call.read() == say
    return call


async def ended(call) -> grpc.StatusCode:
    """How a call ends whose answers are read."""
    with suppress(grpc.aio.AioRpcError):
        if hasattr(call, "read"):
            while await call.read() is not grpc.aio.EOF:
                pass
    return await call.code()


async def test_a_stream_that_ends_in_the_midst_of_an_answer_is_told_why():
    async with echoing(OpenStreams(8)) as channel:
        calls = [asyncio.create_task(ended(channel.unary_stream("/t/Pour")(b""))) for _ in range(200)]
        await until(lambda: sum(not call.done() for call in calls) <= 8)
        assert [call.result() for call in calls if call.done()] == 192 * [grpc.StatusCode.RESOURCE_EXHAUSTED]
        for call in calls:
            call.cancel()


async def test_silent_streams_shut_nobody_out():
    streams = OpenStreams(4)
    async with echoing(streams) as channel:
        camera = await opened(channel, b"use")
        silent = [await opened(channel) for _ in range(30)]
        late = await opened(channel, b"use")
        assert streams.ended == 28
        for call in (camera, late):  # both still work
            await call.write(b"x")
            assert await call.read() == b"x"
        assert await silent[0].code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "too many are open" in await silent[0].details()


async def test_before_the_server_stops_every_stream_is_told_so_and_nothing_is_logged(caplog):
    streams = OpenStreams(4)
    async with echoing(streams) as channel:
        calls = [await opened(channel, b"use"), await opened(channel)]
        streams.end_all("the server ends")
        calls.append(channel.stream_stream("/t/Echo")())  # opens while the server ends
        assert [await call.code() for call in calls] == 3 * [grpc.StatusCode.UNAVAILABLE]
        assert [await call.details() for call in calls] == 3 * ["the server ends"]
        pouring = channel.unary_stream("/t/Pour")(b"")  # begins with an answer
        assert await ended(pouring) is grpc.StatusCode.UNAVAILABLE
        assert not streams._silent and not streams._used
    # gRPC's poller may wake the closed event loop of an earlier test.
    assert all("PollerCompletionQueue._handle_events" in line for line in caplog.messages)


async def test_among_streams_of_use_the_one_that_is_idle_longest_ends():
    streams = OpenStreams(2)
    async with echoing(streams) as channel:
        first, second = await opened(channel, b"use"), await opened(channel, b"use")
        await first.write(b"use")
        await first.read()
        await opened(channel)
        assert await second.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        await first.write(b"x")
        assert await first.read() == b"x"


class Stream:
    open, caller = True, ANYBODY
    use = staticmethod(lambda: None)


def test_a_session_belongs_to_the_stream_that_sends_it():
    sessions, mine, spoofer = SessionStreams(["cam00"]), Stream(), Stream()
    sessions.claim("cam00", "s", mine, 0)
    error = refused(FrameRejected, "", sessions.claim, "cam00", "s", spoofer, SESSION_IDLE_NS - 1)
    assert error.reason == "session_in_use"
    sessions.claim("cam00", "other", spoofer, 1)
    mine.open = False
    sessions.claim("cam00", "s", spoofer, 2)  # its stream ended
    sessions.claim("cam00", "s", Stream(), 2 + SESSION_IDLE_NS)  # or is gone without a word
    refused(FrameRejected, "", sessions.claim, "cam00", "s", spoofer, 3 + SESSION_IDLE_NS)
    sessions.claim("cam00", "s", spoofer, 0)  # a clock that was set back delays nobody
    for k in range(1000):
        sessions.claim("cam00", f"s{k}", spoofer, k)
    assert len(sessions._sent["cam00"]) == MAX_SESSIONS_PER_CAMERA


async def test_a_call_of_which_no_message_comes_ends(monkeypatch):
    monkeypatch.setattr(served, "FIRST_MESSAGE_TIMEOUT_S", 0.1)
    async with echoing(OpenStreams(4)) as channel, asyncio.timeout(20):
        assert await ended(channel.stream_unary("/t/Unary")()) is grpc.StatusCode.DEADLINE_EXCEEDED


async def test_calls_that_only_begin_and_watches_of_health_are_bounded(monkeypatch):
    """Headers without a message reach no handler, Health/Watch never ends: neither shuts a camera out."""
    most, made = 20, []
    monkeypatch.setattr(served, "OpenStreams", lambda _: made.append(OpenStreams(most)) or made[-1])
    async with echoing(OpenStreams(4)) as channel:
        (calls,) = made
        camera = await opened(channel, b"use")
        begun, watches = [], []
        for _ in range(3 * most):
            begun.append(channel.stream_unary("/t/Unary")())
            watches.append(channel.unary_stream("/grpc.health.v1.Health/Watch")(b""))
            await asyncio.sleep(0)
        async with asyncio.timeout(20):
            for call in (begun[0], watches[0]):
                assert await ended(call) is grpc.StatusCode.RESOURCE_EXHAUSTED
            await until(lambda: calls.ended >= 5 * most)
        assert len(calls._silent) + len(calls._used) <= most
        await camera.write(b"still here")
        assert await camera.read() == b"still here"
        assert await channel.unary_unary("/t/Unary")(b"new") == b"new"
        assert not any(type(o).__name__ == "AbortError" for o in gc.get_objects())  # it keeps a call's memory
        for call in (*begun, *watches):
            call.cancel()
        camera.cancel()
        await until(lambda: not (calls._silent or calls._used))
