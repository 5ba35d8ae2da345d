"""A gRPC proxy that passes every message through a seeded link, on one event loop woken by an exact timer.

``Proxy`` serves any service and parses nothing. Each method has its own link in each delayed
direction, or one link carries all methods. On the wire all four kinds of call are streams, so one handler
serves them. Metadata, deadline, status, trailers and cancellation are passed on without delay, the status
after the messages that came before it. A dropped message of a stream is left out. If the only message of a
direction is dropped, the call ends UNAVAILABLE: so does a dropped unary request or answer (and a stream of
one message, which is the same on the wire).

``frame_proxy`` is the same for freshfield's frame stream, whose headers it reads.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import grpc
import grpc.aio

from channel_emu.live import live_emulator_constants as tuned
from channel_emu.live.call_flow import CallFlow
from channel_emu.live.event_queue import EventQueue
from channel_emu.live.live_link import STREAM_ENDED, ByteBudget, DelayStats, Flips, LiveLink
from channel_emu.live.replay_link import ReplayLink
from channel_emu.live.report import Report, figures_of
from channel_emu.model.channel import Channel
from channel_emu.model.link import EventKind, Link
from channel_emu.model.settings import ChannelConfig
from channel_emu.model.trace import Trace, TraceWriter
from freshfield.clock import WallClock
from freshfield.streams import ServedCall
from freshfield.transport import CLIENT_OPTIONS, Transport

log = logging.getLogger("channel-emu")

DIRECTIONS = ("up", "down", "both")
_NOT_PASSED_ON = ("user-agent", "content-type", "te")
_OTHERS = "(other methods)"


class EmulatorFailed(RuntimeError):
    """The emulator cannot continue: its trace or ledger cannot be written, or a part of it failed."""


@dataclass(frozen=True)
class ProxyOptions:
    """How a proxy runs. Raises ValueError for an unknown direction.

    listen: HOST:PORT for clients; port 0 takes any free one.
    to: HOST:PORT of the service.
    transport: TLS and tokens of both sides.
    direction: the messages that are delayed: up (to the service), down (its answers) or both.
    trace: record to this file; None: no trace.
    replay: repeat the decisions of this trace instead of making new ones.
    """

    listen: str
    to: str
    transport: Transport = field(default_factory=Transport)
    direction: str = "up"
    trace: Path | None = None
    replay: Trace | None = None

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise ValueError(f"direction: expected one of {', '.join(DIRECTIONS)}, got {self.direction!r}")


class Proxy(grpc.GenericRpcHandler):
    """Usage: ``start``, then ``stop``; or ``run``. Needs a running event loop.

    config, seed: of the emulated channel. most_calls: open at once; each takes 30 kB.
    Raises TransportError if the address cannot be used, OSError if the trace cannot be created,
    TraceError if another emulator writes it.
    """

    streams_last: ClassVar[bool] = False
    """Whether the clients' calls never end by themselves."""
    # Any other service has not agreed to the project's keepalive pings, and would close the connection.
    client_options: ClassVar = [
        (key, value) for key, value in CLIENT_OPTIONS if "keepalive" not in key and "ping" not in key
    ]

    def __init__(
        self, config: ChannelConfig, seed: int, options: ProxyOptions, most_calls: int = tuned.MOST_CALLS
    ) -> None:
        self.options = options
        self.clock = WallClock()
        self.origin_ns = self.clock.now_ns()
        """The clock's reading at the channel's instant zero."""
        self.channel = Channel(config, seed)
        self.stats = DelayStats()
        """Delays of all links together."""
        self._budget = ByteBudget()
        self.links: dict[str, LiveLink] = {}
        self._failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.events = EventQueue(self.clock, self.origin_ns, self.fail, shared=config.server.shared)
        self._server = options.transport.aio_server(most_calls)
        # Before any file: an emulator that has the address already may be writing it.
        self.port = self.bind()
        self._trace = TraceWriter(options.trace, config, seed) if options.trace else None
        self._replayed = options.replay.by_camera() if options.replay else {}
        self._calls = 0
        self._tasks: list[asyncio.Task[None]] = []
        self.service_channel = options.transport.aio_channel(options.to, self.client_options)

    async def start(self) -> int:
        """Start to answer. Returns the port."""
        self._server.add_generic_rpc_handlers((self,))
        self.spawn(self._refresh())
        await self.prepare(self._server)
        await self._server.start()
        return self.port

    async def run(self, stop: asyncio.Event) -> Report:
        """Start, run until ``stop`` is set, and return the report. Raises EmulatorFailed."""
        await self.start()
        log.info("listening on port %d, sending to %s", self.port, self.options.to)
        stopping = asyncio.ensure_future(stop.wait())
        either: set[asyncio.Future[Any]] = {stopping, self._failure}
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        finally:
            stopping.cancel()
            try:
                await self.stop()
            except OSError as error:
                self.fail(error)
        self.check()
        return self.report()

    async def stop(self) -> None:
        """End open calls and close every file, each even if another fails. Messages inside the links remain
        ``in_flight``. Raises OSError if a file cannot be closed. Call it once."""
        with contextlib.ExitStack() as closing:  # runs the callbacks in reverse order
            closing.callback(self.close)
            if self._trace is not None:
                closing.callback(self._trace.close)
            for link in self.links.values():
                closing.callback(link.close)
            closing.callback(self.events.close)
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            # gRPC prints a traceback for each call that it cancels itself, so none is left to it.
            stopping = asyncio.ensure_future(self._server.stop(2 * tuned.STOP_GRACE_S))
            await asyncio.wait((stopping,), timeout=0.0 if self.streams_last else tuned.STOP_GRACE_S)
            for call in {call for link in self.links.values() for call in link.calls}:
                if isinstance(call, ServedCall):
                    call.end(grpc.StatusCode.UNAVAILABLE, "the channel emulator ends")
            await stopping
            await self.service_channel.close()

    def fail(self, error: BaseException) -> None:
        """End ``run`` with this error; the first one counts."""
        if self._failure.done():
            return
        if not isinstance(error, OSError):
            log.error("a part of the emulator broke", exc_info=error)
        self._failure.set_exception(error)
        # Mark the exception as retrieved, or asyncio complains at exit if nobody called ``check``.
        self._failure.exception()

    def check(self) -> None:
        """Raise EmulatorFailed if any part failed."""
        failure = self._failure.exception() if self._failure.done() else None
        if failure is None:
            return
        kind = "" if isinstance(failure, OSError) else f"{type(failure).__name__}: "
        hint = "; is there room on the disk?" if isinstance(failure, OSError) else ""
        raise EmulatorFailed(f"stopped because of an error: {kind}{failure}{hint}") from failure

    async def settled(self) -> None:
        """Wait until no message is inside a link or being handed on. Raises EmulatorFailed."""
        while any(link.model.in_flight for link in self.links.values()) or self.pending:
            self.check()
            await asyncio.sleep(tuned.SETTLED_POLL_S)

    def report(self) -> Report:
        """Outcomes, ages and delays so far."""
        found = {name: figures_of([link], link.stats) for name, link in self.links.items()}
        total = asdict(figures_of(list(self.links.values()), self.stats))
        return Report(
            **total,
            seed=self.channel.seed,
            direction=self.options.direction,
            seconds=self.events.now_ns() / 1e9,
            by_method=found,
        )

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Run ``work`` in the background until the proxy stops; an exception in it ends the proxy."""
        task = asyncio.create_task(work)
        task.add_done_callback(self._ended)
        self._tasks.append(task)

    def link(self, name: str, damage: Callable[[bytes, Flips], bytes] | None = None) -> LiveLink:
        """The link of this name, made at the first call. damage: see ``LiveLink``; None damages any byte."""
        if name in self.links:
            return self.links[name]
        if name in self._replayed:
            model: Link = ReplayLink(name, self._replayed[name])
        else:
            model = self.channel.link(name)
            if self.options.replay is not None:
                log.info("%s: not in the replayed trace (held out?); its link makes new decisions", name)
        link = self.links[name] = LiveLink(
            name, model, self.events, DelayStats(self.stats), damage or _damage_any_byte, self._trace, self._budget
        )
        # A fault may act before the first message.
        self.events.schedule(link)
        return link

    def service(self, details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        """The handler of a method, as gRPC asks for it; None: not served."""

        async def carry(_: Any, context: grpc.aio.ServicerContext) -> None:
            async with ServedCall.of(context) as call:
                await self._carry(details.method, context, call)

        return grpc.stream_stream_rpc_method_handler(carry)

    def bind(self) -> int:
        """Take the address to listen on. Returns the port. Raises TransportError."""
        return self.options.transport.bind(self._server, self.options.listen)

    async def prepare(self, server: grpc.aio.Server) -> None:
        """Called before the server accepts calls."""

    async def refresh(self) -> None:
        """Called twice a second."""

    def close(self) -> None:
        """Called after the last message."""

    @property
    def pending(self) -> int:
        """Number of messages that left their link and are still being handed on."""
        return sum(
            link.model.counts[EventKind.DELIVERED] - link.forwarded - link.cancelled for link in self.links.values()
        )

    async def _carry(self, method: str, context: grpc.aio.ServicerContext, served: ServedCall) -> None:
        """Pass one call of any kind on."""
        self._calls += 1
        name = f"call{self._calls}"
        up = CallFlow(name, served, self._link_of("up", method), self.events.now_ns)
        down = CallFlow(name, served, self._link_of("down", method), self.events.now_ns)
        metadata = _passed_on(context.invocation_metadata())
        call = self.service_channel.stream_stream(method)(metadata=metadata, timeout=context.time_remaining())
        parts = [
            asyncio.create_task(_carry_up(up, context, call)),
            asyncio.create_task(_carry_down(down, context, call, served)),
        ]
        try:
            done, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
            if parts[1] not in done:
                parts[0].result()  # an exception here ends the call
                if up.lost_its_only_message:
                    await context.abort(grpc.StatusCode.UNAVAILABLE, self._dropped("request", "up", method))
            await parts[1]
            code, trailers = await call.code(), _passed_on(await call.trailing_metadata())
            if code is grpc.StatusCode.OK and down.lost_its_only_message:
                await context.abort(grpc.StatusCode.UNAVAILABLE, self._dropped("answer", "down", method), trailers)
            if code is not grpc.StatusCode.OK:
                await context.abort(code, await call.details() or "", trailers)
            context.set_trailing_metadata(trailers)
        finally:
            up.close()
            down.close()
            call.cancel()
            for part in parts:
                part.cancel()
            for outcome in await asyncio.gather(*parts, return_exceptions=True):
                if isinstance(outcome, Exception) and not isinstance(outcome, STREAM_ENDED):
                    self.fail(outcome)

    def _link_of(self, direction: str, method: str) -> LiveLink | None:
        if self.options.direction not in (direction, "both"):
            return None
        name = f"{direction} {method}"
        if name not in self.links and len(self.links) >= tuned.MOST_METHODS:
            name = f"{direction} {_OTHERS}"
        return self.link(name)

    def _dropped(self, what: str, direction: str, method: str) -> str:
        return (
            f"the emulated network dropped the {what} ({direction} {method}, seed {self.channel.seed}, "
            f"discipline {self.channel.config.discipline})"
        )

    def _ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            self.fail(error)

    async def _refresh(self) -> None:
        while True:
            await self.refresh()
            before_ns = self.events.now_ns() - tuned.KEEP_PATH_NS
            for chain in {self.channel.chain, *(link.model.chain for link in self.links.values())}:
                if chain is not None:
                    chain.forget(before_ns)
            await asyncio.sleep(tuned.REFRESH_EVERY_S)


async def _carry_up(flow: CallFlow, context: grpc.aio.ServicerContext, call: grpc.aio.StreamStreamCall) -> None:
    with contextlib.suppress(*STREAM_ENDED):  # the service ended the call; its status is passed on
        await flow.carry(context.read, call.write)
        if not flow.lost_its_only_message:
            await call.done_writing()


async def _carry_down(
    flow: CallFlow, context: grpc.aio.ServicerContext, call: grpc.aio.StreamStreamCall, served: ServedCall
) -> None:
    await served.send(context.send_initial_metadata, _passed_on(await call.initial_metadata()))
    await flow.carry(call.read, served.write)


def _passed_on(metadata: Any) -> tuple[tuple[str, str | bytes], ...]:
    """Metadata without the keys that each hop sets itself."""
    return tuple(
        (key, value)
        for key, value in metadata or ()
        if key not in _NOT_PASSED_ON and not (key.startswith("grpc-") and not key.endswith("-bin"))
    )


def _damage_any_byte(raw: bytes, flips: Flips) -> bytes:
    from channel_emu.model.faults.corruption import damage  # only where a scenario lists it

    return damage(raw, flips)
