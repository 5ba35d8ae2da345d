"""A real gRPC peer for nodes, in the test's own event loop, that can be told to misbehave."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import grpc
import grpc.aio

from freshfield.clock import WallClock
from freshfield.frame import Frame, from_request
from freshfield.transport import Transport
from freshfield.v1 import clock_pb2, clock_pb2_grpc, frames_pb2_grpc
from freshfield.v1 import frames_pb2 as pb
from tests.support import until

Answer = Callable[[pb.PushRequest], Awaitable[pb.PushResponse | None]]


def answer(outcome: pb.Outcome = pb.OUTCOME_ACCEPTED, reason: str = "", after_s: float = 0.0) -> Answer:
    """Answers every frame the same way, after a while."""

    async def give(request: pb.PushRequest) -> pb.PushResponse:
        await asyncio.sleep(after_s)
        return pb.PushResponse(sequence=request.header.sequence, outcome=outcome, reason=reason, detail="a test says")

    return give


async def silence(request: pb.PushRequest) -> None:
    """Never answers."""
    return None


async def wrong_number(request: pb.PushRequest) -> pb.PushResponse:
    return pb.PushResponse(sequence=request.header.sequence + 17, outcome=pb.OUTCOME_ACCEPTED)


class ClockAhead(WallClock):
    """A clock that is wrong."""

    def __init__(self, by_ns: int) -> None:
        super().__init__()
        self._ahead += by_ns


@dataclass
class Peer:
    """frames: every frame that arrived, checked; arrived_ns: when, on ``clock``. most_unanswered: the most
    frames that any stream had waiting for an answer at once. streams: how many were opened."""

    respond: Answer = field(default_factory=answer)
    transport: Transport = field(default_factory=Transport)
    clock: WallClock = field(default_factory=WallClock)
    with_clock_service: bool = True
    clock_delay_s: float = 0.0
    frames: list[Frame] = field(default_factory=list)
    arrived_ns: list[int] = field(default_factory=list)
    most_unanswered: int = 0
    streams: int = 0
    port: int = 0
    _server: grpc.aio.Server | None = None

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    async def start(self) -> "Peer":
        """Listen, after a ``stop`` on the same port again."""
        self._server = self.transport.aio_server()
        frames_pb2_grpc.add_FrameStreamServiceServicer_to_server(_Frames(self), self._server)
        if self.with_clock_service:
            clock_pb2_grpc.add_ClockServiceServicer_to_server(_Clock(self), self._server)
        self.port = self.transport.bind(self._server, f"127.0.0.1:{self.port}")
        await self._server.start()
        return self

    async def stop(self) -> None:
        """As if killed: streams end without an answer."""
        if self._server is not None:
            await self._server.stop(None)
            self._server = None

    async def until(self, frames: int, timeout_s: float = 60.0) -> None:
        """Until so many frames arrived in all; TimeoutError if they do not."""
        await until(lambda: len(self.frames) >= frames, timeout_s)

    async def until_each(self, cameras: list[str], frames: int) -> None:
        """Until so many more frames of each camera arrived."""
        begin = len(self.frames)
        await until(lambda: all(sum(f.camera == c for f in self.frames[begin:]) >= frames for c in cameras), 60.0)


class _Frames(frames_pb2_grpc.FrameStreamServiceServicer):
    def __init__(self, peer: Peer) -> None:
        self.peer = peer

    async def Push(self, request_iterator, context):
        peer = self.peer
        peer.streams += 1
        arrived: asyncio.Queue[pb.PushRequest | None] = asyncio.Queue()
        unanswered = 0

        async def read() -> None:
            # Reads ahead of the answers, so that a node that sends too much is caught.
            nonlocal unanswered
            async for request in request_iterator:
                unanswered += 1
                peer.most_unanswered = max(peer.most_unanswered, unanswered)
                peer.arrived_ns.append(peer.clock.now_ns())
                peer.frames.append(from_request(request))
                arrived.put_nowait(request)
            arrived.put_nowait(None)

        reader = asyncio.ensure_future(read())
        try:
            while (request := await arrived.get()) is not None:
                response = await peer.respond(request)
                if response is not None:
                    unanswered -= 1
                    yield response
        finally:
            reader.cancel()


class _Clock(clock_pb2_grpc.ClockServiceServicer):
    def __init__(self, peer: Peer) -> None:
        self.peer = peer

    async def Exchange(self, request, context):
        await asyncio.sleep(self.peer.clock_delay_s)
        now = self.peer.clock.now_ns()
        return clock_pb2.ExchangeResponse(
            client_sent_ns=request.client_sent_ns, server_received_ns=now, server_sent_ns=self.peer.clock.now_ns()
        )
