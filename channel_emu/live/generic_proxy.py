"""A proxy for any gRPC service: every message of every method passes a seeded link; nothing is parsed.

Each method has a link of its own in each delayed direction (as each camera has), or one link carries all. On
the wire all four kinds of call are streams, so one handler serves them. Metadata, deadline, status, trailers
and cancellation are passed on undelayed, the status after the messages that came before it. A stream's
dropped message is left out. Where the only message of a direction is dropped there would be nothing to pass
on, so the call ends UNAVAILABLE: that is what a dropped unary request or answer looks like (and a stream that
consists of one message: on the wire they are the same).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import grpc
import grpc.aio

from channel_emu.live.camera_lane import HardLimit
from channel_emu.live.event_queue import Agenda
from channel_emu.live.generic_flow import ENDED, Flow, Line, Message, Tally
from channel_emu.live.histogram import Histogram
from channel_emu.live.replay_link import ReplayLink
from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig
from channel_emu.model.link import Kind, Link
from channel_emu.model.trace import Trace, TraceWriter
from freshfield.clock import Clock, WallClock
from freshfield.transport import CLIENT_OPTIONS, Transport

log = logging.getLogger("channel-emu")

DIRECTIONS = ("up", "down", "both")
_NOT_PASSED_ON = ("user-agent", "content-type", "te")
_MOST_LINES = 1000
_STOP_GRACE_S = 0.5
_DROPPED = (Kind.DROPPED_BUSY, Kind.SUPERSEDED, Kind.SKIPPED, Kind.LOST, Kind.BROKEN)
# The service at the other end has not agreed to the project's keepalive pings, and would hang up.
_OPTIONS = [(key, value) for key, value in CLIENT_OPTIONS if "keepalive" not in key and "ping" not in key]


@dataclass(frozen=True)
class Figures:
    """One link's, or all links' together.

    offered = delivered + dropped + in_flight. outcomes: by ``link.Kind``, with ``forwarded`` (handed on) and
    ``cancelled`` (came out after their call was over). mean_age_ms, peak_age_ms: of the newest message handed
    on, counted from when the proxy got it, from the first one handed on to the last that came in or went out;
    the mean over links, None where there is none. delay_ms: what the link drew; latency_ms: from getting to
    handing on; error_ms: how long after the link's decision it was handed on.
    """

    offered: int
    delivered: int
    dropped: int
    in_flight: int
    outcomes: dict[str, int]
    mean_age_ms: float | None
    peak_age_ms: float | None
    delay_ms: dict[str, float | None]
    latency_ms: dict[str, float | None]
    error_ms: dict[str, float | None]


@dataclass(frozen=True)
class Report(Figures):
    """All links together; ``by_method`` has each link's figures under ``up /pkg.Service/Method``."""

    seed: int
    direction: str
    seconds: float
    by_method: dict[str, Figures] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """As JSON takes it."""
        return asdict(self)


@dataclass(frozen=True)
class GenericOptions:
    """listen, to: HOST:PORT, port 0 takes any. direction: which messages are delayed, up (to the service),
    down (its answers) or both. shared: one link for all methods of a direction. trace: record to this file.
    replay: repeat these decisions."""

    listen: str
    to: str
    transport: Transport = field(default_factory=Transport)
    direction: str = "up"
    shared: bool = False
    trace: Path | None = None
    replay: Trace | None = None

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise ValueError(f"direction: expected one of {', '.join(DIRECTIONS)}, got {self.direction!r}")


class GenericProxy:
    """``start``, then ``stop``; or ``run`` until told. Must be made with an event loop running."""

    def __init__(
        self, config: ChannelConfig, seed: int, options: GenericOptions, clock: Clock | None = None
    ) -> None:
        self.options = options
        self.channel = Channel(config, seed)
        self.port = 0
        self.lines: dict[str, Line] = {}
        clock = clock or WallClock()
        self._total = Tally()
        self._tallies: dict[str, Tally] = {}
        self._failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._agenda = Agenda(clock, clock.now_ns(), self._fail, shared=config.server.shared)
        self._trace = TraceWriter(options.trace, config, seed) if options.trace else None
        self._replayed = options.replay.by_camera() if options.replay else {}
        self._calls = 0
        self._service = options.transport.aio_channel(options.to, _OPTIONS)
        self._server = options.transport.aio_server()
        self._server.add_generic_rpc_handlers((_AnyMethod(self),))

    async def start(self) -> int:
        """Listen; the port. Raises TransportError if the address cannot be had."""
        self.port = self.options.transport.bind(self._server, self.options.listen)
        await self._server.start()
        return self.port

    async def run(self, stop: asyncio.Event) -> Report:
        """From start to ``stop``; the report. Raises HardLimit where the channel sets one, and what broke."""
        await self.start()
        log.info("listening on port %d, sending to %s", self.port, self.options.to)
        stopping = asyncio.ensure_future(stop.wait())
        either: set[asyncio.Future[Any]] = {stopping, self._failure}
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        finally:
            stopping.cancel()
            await self.stop()
        self.check()
        return self.report()

    async def stop(self) -> None:
        """End what is open and close the trace. Once is enough."""
        await self._server.stop(_STOP_GRACE_S)
        await self._service.close()
        self._agenda.close()
        if self._trace is not None:
            for line in self.lines.values():
                line.close()
            self._trace.close()
            self._trace = None

    def check(self) -> None:
        """Raise what broke, if anything did."""
        if self._failure.done():
            self._failure.result()

    async def settled(self) -> None:
        """Until no message is inside a link, nor on its way out of one."""
        while any(line.link.in_flight or _unwritten(line) for line in self.lines.values()):
            self.check()
            await asyncio.sleep(0.002)

    def report(self) -> Report:
        """Everything so far."""
        lines = self.lines
        found = {name: _figures([line], self._tallies[name]) for name, line in lines.items()}
        whole = asdict(_figures(list(lines.values()), self._total))
        return Report(**whole, seed=self.channel.seed, direction=self.options.direction,
                      seconds=self._agenda.now_ns() / 1e9, by_method=found)  # fmt: skip

    async def carry(self, method: str, context: grpc.aio.ServicerContext) -> None:
        """One call, of any kind."""
        self._calls += 1
        task = asyncio.current_task()
        assert task is not None
        reset = False

        def cut() -> None:
            nonlocal reset
            reset = True
            task.cancel()

        up = Flow(self._calls, self._line("up", method), cut)
        down = Flow(self._calls, self._line("down", method), cut)
        metadata = _passed_on(context.invocation_metadata())
        call = self._service.stream_stream(method)(metadata=metadata, timeout=context.time_remaining())
        parts = [
            asyncio.create_task(_carry_up(up, context, call)),
            asyncio.create_task(_carry_down(down, context, call)),
        ]
        try:
            done, _ = await asyncio.wait(parts, return_when=asyncio.FIRST_COMPLETED)
            if parts[1] not in done:
                parts[0].result()  # what broke here ends the call
                if up.lost_its_only_message:
                    await context.abort(grpc.StatusCode.UNAVAILABLE, self._told("request", "up", method))
            await parts[1]
            code, trailers = await call.code(), _passed_on(await call.trailing_metadata())
            if code is grpc.StatusCode.OK and down.lost_its_only_message:
                await context.abort(
                    grpc.StatusCode.UNAVAILABLE, self._told("answer", "down", method), trailers
                )
            if code is not grpc.StatusCode.OK:
                await context.abort(code, await call.details() or "", trailers)
            context.set_trailing_metadata(trailers)
        except asyncio.CancelledError:
            if not reset:
                raise
            task.uncancel()
            await context.abort(grpc.StatusCode.UNAVAILABLE, "the emulated network reset this stream")
        finally:
            up.close()
            down.close()
            call.cancel()
            for part in parts:
                part.cancel()
            for outcome in await asyncio.gather(*parts, return_exceptions=True):
                if isinstance(outcome, Exception) and not isinstance(outcome, ENDED):
                    self._fail(outcome)

    def _line(self, direction: str, method: str) -> Line | None:
        if self.options.direction not in (direction, "both"):
            return None
        name = direction if self.options.shared else f"{direction} {method}"
        if name not in self.lines:
            if len(self.lines) >= _MOST_LINES:
                raise RuntimeError(f"more than {_MOST_LINES} methods were called")
            link: Link | ReplayLink = self.channel.link(name)
            if name in self._replayed:
                link = ReplayLink(name, self._replayed[name])
            tally = self._tallies[name] = Tally()
            self.lines[name] = Line(
                name, link, self._agenda, (tally, self._total), self._check_late, self._trace
            )
            # A fault may act before the first message.
            self._agenda.arm(self.lines[name])
        return self.lines[name]

    def _told(self, what: str, direction: str, method: str) -> str:
        return (
            f"the emulated network dropped the {what} ({direction} {method}, seed {self.channel.seed}, "
            f"discipline {self.channel.config.discipline})"
        )

    def _check_late(self, name: str, message: Message, late_ms: float) -> None:
        limit_ms = self.channel.config.hard_limit_ms
        if limit_ms is not None and late_ms > limit_ms:
            self._fail(HardLimit(
                f"message {message.number} of call {message.flow.call} on {name!r} left {late_ms:.2f} ms "
                f"after it was due; hard_limit_ms is {limit_ms:g}"
            ))  # fmt: skip

    def _fail(self, error: BaseException) -> None:
        if not self._failure.done():
            self._failure.set_exception(error)
            # Whoever runs the proxy asks; where nobody does, asyncio need not complain at exit.
            self._failure.exception()


class _AnyMethod(grpc.GenericRpcHandler):
    def __init__(self, proxy: GenericProxy) -> None:
        self._proxy = proxy

    def service(self, details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler:
        async def carry(_: Any, context: grpc.aio.ServicerContext) -> None:
            await self._proxy.carry(details.method, context)

        return grpc.stream_stream_rpc_method_handler(carry)


async def _carry_up(flow: Flow, context: grpc.aio.ServicerContext, call: grpc.aio.StreamStreamCall) -> None:
    with contextlib.suppress(*ENDED):  # the service ended the call: its status says how
        await flow.carry(context.read, call.write)
        if not flow.lost_its_only_message:
            await call.done_writing()


async def _carry_down(flow: Flow, context: grpc.aio.ServicerContext, call: grpc.aio.StreamStreamCall) -> None:
    await context.send_initial_metadata(_passed_on(await call.initial_metadata()))
    await flow.carry(call.read, context.write)


def _passed_on(metadata: Any) -> tuple[tuple[str, str | bytes], ...]:
    """Metadata without what each hop says for itself."""
    return tuple(
        (key, value)
        for key, value in metadata or ()
        if key not in _NOT_PASSED_ON and not (key.startswith("grpc-") and not key.endswith("-bin"))
    )


def show(report: Report) -> str:
    """The report for a person: every link's figures in two lines."""
    lines = []
    for name, figures in report.by_method.items():
        outcomes = ", ".join(f"{count} {kind}" for kind, count in figures.outcomes.items())
        lines.append(f"  {name}: {figures.offered} offered; {outcomes or 'none settled'}")
        lines.append(
            f"    mean age {_ms(figures.mean_age_ms)}, peak age {_ms(figures.peak_age_ms)}, "
            f"delay mean {_ms(figures.delay_ms['mean'])}, error p99 {_ms(figures.error_ms['p99'])}"
        )
    return "\n".join(lines) or "  no call was made"


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} ms"


def _unwritten(line: Line) -> int:
    """Messages that the link let out, and that are neither handed on nor for nobody."""
    counts = line.counts
    return counts[str(Kind.DELIVERED)] - counts["forwarded"] - counts["cancelled"]


def _figures(lines: Sequence[Line], tally: Tally) -> Figures:
    outcomes: dict[str, int] = {}
    for line in lines:
        for name, count in line.counts.items():
            outcomes[name] = outcomes.get(name, 0) + count
    return Figures(
        offered=sum(line.link.offered for line in lines),
        delivered=outcomes.get(str(Kind.DELIVERED), 0),
        dropped=sum(outcomes.get(str(kind), 0) for kind in _DROPPED),
        in_flight=sum(line.link.in_flight for line in lines),
        outcomes=outcomes,
        mean_age_ms=_mean([line.age.mean_age_ms(line.last_ns) for line in lines]),
        peak_age_ms=_mean([line.age.peak_age_ms() for line in lines]),
        delay_ms=_spread(tally.drawn),
        latency_ms=_spread(tally.latency),
        error_ms=_spread(tally.late),
    )


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _spread(histogram: Histogram) -> dict[str, float | None]:
    found = {f"p{p}": histogram.percentile_ms(p) for p in (50, 95, 99)}
    return {"mean": histogram.mean_ms, **found, "max": histogram.max_ms if histogram.count else None}
