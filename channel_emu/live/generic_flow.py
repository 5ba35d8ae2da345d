"""One direction of one call on its way through a link, whatever the messages mean (``generic``)."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import grpc
import grpc.aio

from channel_emu.live.event_queue import Agenda
from channel_emu.live.histogram import Histogram
from channel_emu.live.replay_link import ReplayLink
from channel_emu.model.ages import RunningAge
from channel_emu.model.link import Event, Kind, Link, Transit
from channel_emu.model.trace import TraceWriter

# Messages of one direction of a call that are held once the first can be written: beyond it the sender waits.
# Behind a first one that is still in the link any number come in, for the link decides about each at once;
# what it drops is held without its bytes.
_MOST_READY = 64
ENDED = (grpc.RpcError, grpc.aio.BaseError, asyncio.InvalidStateError)

Read = Callable[[], Awaitable[Any]]
Write = Callable[[bytes], Awaitable[None]]


@dataclass(slots=True)
class Message:
    """number: its place in its direction of the call, from 0. kept: None until the link has decided."""

    raw: bytes
    flow: Flow
    number: int
    kept: bool | None = None
    doubled: bool = False
    traced: bool = False
    transit: Transit | None = None


class Tally:
    """Figures of one line, or of all together, in fixed memory."""

    def __init__(self) -> None:
        self.drawn = Histogram()
        self.latency = Histogram()
        self.late = Histogram()


class Line:
    """A link, what passed it, and who is on it. Same link object as everywhere; this gives it the wall clock.

    name: decides the link's draws, with the channel's seed. tallies: where its messages are counted. late:
    told (name, message, ms) of each message's lateness.
    """

    def __init__(
        self,
        name: str,
        link: Link | ReplayLink,
        agenda: Agenda,
        tallies: tuple[Tally, ...],
        late: Callable[[str, Message, float], None],
        trace: TraceWriter | None = None,
    ) -> None:
        self.name = name
        self.link = link
        self.armed_ns = -1
        self.counts: Counter[str] = Counter()
        """What became of messages, by ``link.Kind``; ``forwarded`` were handed on, ``cancelled`` came out
        after their call was over."""
        self.flows: dict[int, Flow] = {}
        self.tallies = tallies
        self.age = RunningAge()
        self.last_ns = 0
        """When a message last came in or was handed on."""
        self._agenda = agenda
        self._late = late
        self._trace = trace
        self._resets = 0

    def take(self, message: Message) -> None:
        """A message came in: let the link decide, and act on it."""
        self.last_ns = self._agenda.now_ns()
        transit, events = self.link.offer(self.last_ns, message, len(message.raw))
        message.transit = transit
        self._act(events)
        self._agenda.arm_touched(self)

    def advance(self, now_ns: int) -> None:
        self._act(self.link.advance(now_ns))

    def left(self, message: Message) -> None:
        """The message is being handed to gRPC: the moment that counts as its actual delivery."""
        transit = message.transit
        assert transit is not None and transit.ended_ns is not None
        self.last_ns = now_ns = self._agenda.now_ns()
        self.counts["forwarded"] += 1
        late_ms = (now_ns - transit.ended_ns) / 1e6
        for tally in self.tallies:
            tally.latency.add((now_ns - transit.offered_ns) / 1e6)
            tally.late.add(late_ms)
        self.age.add(now_ns, transit.offered_ns)
        self._note(message, now_ns)
        self._late(self.name, message, late_ms)

    def came_late(self, message: Message) -> None:
        """The link let the message out, and its call was over."""
        self.counts["cancelled"] += 1
        self._note(message)

    def close(self) -> None:
        """Note in the trace what is still inside."""
        for transit in self.link.pending():
            self._note(transit.item)

    def _act(self, events: list[Event]) -> None:
        for event in events:
            message: Message = event.transit.item
            message.transit = event.transit
            if event.kind is Kind.STARTED:
                for tally in self.tallies:
                    tally.drawn.add((event.transit.drawn_ns or 0) / 1e6)
                continue
            self.counts[str(event.kind)] += 1
            if event.kind is Kind.DUPLICATED:
                message.doubled = True
                continue
            if event.kind is Kind.DELIVERED:
                if message.flow.closed:
                    self.came_late(message)
                message.raw = _damaged(message.raw, event.transit)
            else:
                self._note(message)
            message.flow.settle(message, event.kind is Kind.DELIVERED)
        if self.link.resets != self._resets:
            self._resets = self.link.resets
            for flow in list(self.flows.values()):
                flow.cut()

    def _note(self, message: Message, actual_ns: int | None = None) -> None:
        if self._trace is not None and message.transit is not None and not message.traced:
            message.traced = True
            session = f"call{message.flow.call}"
            self._trace.write(self.name, session, message.number, message.transit, actual_ns, message.doubled)


class Flow:
    """Reads one side's messages, passes them through a line (None: straight on) and writes them to the other
    side, in order: on one stream nothing overtakes, so a message that is due before its predecessor waits.

    call: its number. cut: ends the call as a reset of the network does.
    """

    def __init__(self, call: int, line: Line | None, cut: Callable[[], None]) -> None:
        self.call = call
        self.cut = cut
        self.closed = False
        self._line = line
        self._messages: deque[Message] = deque()
        self._read = 0
        self._missing = 0
        self._ended = False
        self._wake = asyncio.Event()
        self._room = asyncio.Event()
        self._room.set()
        if line is not None:
            line.flows[call] = self

    @property
    def lost_its_only_message(self) -> bool:
        """The sender said all it had to say in one message, and that was dropped."""
        return self._ended and self._read == 1 and self._missing == 1

    async def carry(self, read: Read, write: Write) -> None:
        """Until the sender is done and everything has been written or dropped."""
        reader = asyncio.create_task(self._fill(read))
        try:
            while not (self._ended and not self._messages):
                if self._messages and self._messages[0].kept is not None:
                    await self._pass(self._messages.popleft(), write)
                    continue
                if reader.done():
                    reader.result()
                self._wake.clear()
                await self._wake.wait()
        finally:
            self.close()
            reader.cancel()

    def settle(self, message: Message, kept: bool) -> None:
        """The link has decided about a message."""
        message.kept = kept
        if not kept:
            message.raw = b""
        self._wake.set()

    def close(self) -> None:
        """What still comes out of the link is for nobody."""
        self.closed = True
        if self._line is not None:
            self._line.flows.pop(self.call, None)
            for message in self._messages:
                if message.kept:
                    self._line.came_late(message)
        self._messages.clear()

    async def _fill(self, read: Read) -> None:
        try:
            while True:
                try:
                    raw = await read()
                except ENDED:  # how it ended is the call's to say
                    break
                if raw is grpc.aio.EOF:
                    break
                message = Message(raw, self, self._read)
                self._read += 1
                self._messages.append(message)
                if self._line is None:
                    self.settle(message, True)
                else:
                    self._line.take(message)
                if len(self._messages) >= _MOST_READY and self._messages[0].kept is not None:
                    self._room.clear()
                    await self._room.wait()
            self._ended = True
        finally:
            self._wake.set()

    async def _pass(self, message: Message, write: Write) -> None:
        if not message.kept:
            self._missing += 1
        else:
            if self._line is not None:
                self._line.left(message)
            await write(message.raw)
            # The only message of a call has no second place to go to: a unary method takes one.
            if message.doubled and self._read > 1:
                await write(message.raw)
        if len(self._messages) < _MOST_READY:
            self._room.set()


def _damaged(raw: bytes, transit: Transit) -> bytes:
    if not transit.flips:
        return raw
    from channel_emu.model.faults.corruption import damage

    return damage(raw, transit.flips)
