"""A live emulator between real cameras' streams and the edge's real ingest, on one event loop."""

import asyncio
import contextlib
import itertools
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import grpc.aio

from channel_emu.live.camera_stream import CameraStream
from channel_emu.live.frame_proxy import FrameProxy
from channel_emu.live.proxy import ProxyOptions
from channel_emu.model.settings import channel_from_mapping
from edge_server.live.buffer import FrameBuffer
from edge_server.live.grpc_services import ClockService
from edge_server.live.ingest import Ingest
from freshfield.clock import WallClock
from freshfield.frame import Frame, to_request
from freshfield.ledger import Ledger
from freshfield.transport import Transport
from freshfield.v1 import clock_pb2_grpc, frames_pb2_grpc
from freshfield.v1 import frames_pb2 as pb
from tests.edge_server.frames import frame
from tests.support import until

CAMERAS = ("cam00", "cam01", "cam02", "cam03")
_sessions = itertools.count()


def make(out: Path, to: str, section: dict, cameras=("cam00",), **options) -> tuple[FrameProxy, list[CameraStream]]:
    """A proxy for the frame stream, not started, and its cameras' flows."""
    chosen = ProxyOptions("127.0.0.1:0", to, options.pop("transport", Transport()), **options)
    proxy = FrameProxy(channel_from_mapping(section), 5, chosen, cameras, out)
    return proxy, list(proxy.flows.values())


def offer(flow: CameraStream, sequence: int) -> None:
    """A frame comes in."""
    request = to_request(frame(flow.camera, sequence, sequence))
    flow.take(request.SerializeToString(), request.header)


class Edge:
    """The edge's own ingest and clock on a port of its own; ``stop`` and ``start`` make a restart."""

    def __init__(self, out: Path, cameras: tuple[str, ...], held_out: tuple[str, ...], transport: Transport):
        self._out, self._cameras, self._held_out, self._transport = out, cameras, held_out, transport
        self.port = 0
        self.truth: list[tuple[Frame, int]] = []

    async def start(self) -> None:
        clock = WallClock()
        training = tuple(c for c in self._cameras if c not in self._held_out)
        self._ledger = Ledger(self._out, "edge", "edge", clock.now_ns())
        self._clock = clock
        self.ingest = Ingest(
            clock, FrameBuffer(training), self._held_out, self._ledger, lambda f: self.truth.append((f, clock.now_ns()))
        )
        self._server = self._transport.aio_server()
        self.ingest.add_to_server(self._server)
        clock_pb2_grpc.add_ClockServiceServicer_to_server(ClockService(clock), self._server)
        self.port = self._transport.bind(self._server, f"127.0.0.1:{self.port}")
        await self._server.start()

    async def stop(self) -> None:
        """As if killed: no stream is ended politely."""
        await self._server.stop(None)
        self._ledger.close(self._clock.now_ns())


class Camera:
    """One stream of frames to the emulator, one unanswered at a time; keeps every answer and a ledger."""

    def __init__(self, name: str, port: int, transport: Transport, held_out: bool, ledger: Ledger) -> None:
        self.name, self.held_out = name, held_out
        self.session = f"s{next(_sessions)}"
        self.answers: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.sequence = 0
        self.call: Any = None
        self._clock = WallClock()
        self._channel = transport.aio_channel(f"127.0.0.1:{port}")
        self._metadata = transport.metadata()
        self._ledger = ledger

    async def connect(self) -> None:
        await self._channel.channel_ready()
        self.call = frames_pb2_grpc.FrameStreamServiceStub(self._channel).Push(metadata=self._metadata)
        await self.call.wait_for_connection()

    async def push(self) -> pb.PushResponse:
        """Send one frame and wait for its answer."""
        if self.call is None:
            await self.connect()
        number, now_ns = self.sequence, self._clock.now_ns()
        sent = frame(self.name, number, now_ns, session=self.session, held_out=self.held_out)
        self._write(number, "captured")
        self._write(number, "sent")
        self.sequence += 1
        await self.call.write(to_request(sent))
        response = await self.call.read()
        assert response.sequence == number
        name = pb.Outcome.Name(response.outcome).removeprefix("OUTCOME_").lower()
        self._write(number, "answered", f"{name}:{response.reason}" if response.reason else name)
        self.answers[name] += 1
        self.reasons[response.reason] += 1
        return response

    async def stream(self, frames: int, period_s: float = 0.0) -> None:
        for _ in range(frames):
            await self.push()
            await asyncio.sleep(period_s)

    async def close(self) -> None:
        await self._channel.close()

    def _write(self, sequence: int, event: str, detail: str = "") -> None:
        self._ledger.write(self._clock.now_ns(), self.name, self.session, sequence, event, detail)


@dataclass
class Emulation:
    """Edge, emulator and cameras in one folder."""

    edge: Edge
    proxy: FrameProxy
    cameras: dict[str, Camera]

    async def stream(self, frames: int, period_s: float) -> None:
        """All cameras together."""
        await asyncio.gather(*(c.stream(frames, period_s) for c in self.cameras.values()))

    async def connected(self) -> None:
        """Wait until every stream to the edge is open."""
        await until(lambda: all(flow.connected for flow in self.proxy.flows.values()))

    async def settled(self) -> None:
        """Wait until nothing is inside the emulator any more."""
        async with asyncio.timeout(30):
            await self.proxy.settled()

    def stranger(self) -> grpc.aio.Channel:
        """A channel to the emulator."""
        return Transport().aio_channel(f"127.0.0.1:{self.proxy.port}")


async def answer_to(call: grpc.aio.StreamStreamCall, raw: bytes) -> pb.PushResponse:
    """Send bytes on a stream of PUSH, which a stranger opened."""
    await call.write(raw)
    return pb.PushResponse.FromString(await call.read())


@contextlib.asynccontextmanager
async def emulate(
    out: Path, section: dict, *, cameras=CAMERAS, held_out=(), transport: Transport | None = None, **options
) -> AsyncIterator[Emulation]:
    transport = transport or Transport()
    edge = Edge(out, cameras, held_out, transport)
    await edge.start()
    proxy, _ = make(out, f"127.0.0.1:{edge.port}", section, cameras, transport=transport, **options)
    await proxy.start()
    ledger = Ledger(out, "node", "all", WallClock().now_ns())
    nodes = {c: Camera(c, proxy.port, transport, c in held_out, ledger) for c in cameras}
    made = Emulation(edge, proxy, nodes)
    await made.connected()
    try:
        yield made
    finally:
        for node in nodes.values():
            await node.close()
        await proxy.stop()
        with contextlib.suppress(Exception):
            await edge.stop()
        ledger.close(WallClock().now_ns())
