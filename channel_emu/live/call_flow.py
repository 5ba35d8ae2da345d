"""Passes the messages of one direction of a call, or of a connection, through a link, without parsing them."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any

import grpc.aio

from channel_emu.live.live_emulator_constants import MOST_BEHIND, MOST_READY
from channel_emu.live.live_link import STREAM_ENDED, Ends, LiveLink, Message
from channel_emu.model.link import EventKind

Read = Callable[[], Awaitable[Any]]
Write = Callable[[bytes], Awaitable[None]]


class CallFlow:
    """Reads one side's messages, passes them through a link and writes them to the other side.

    Messages of one stream keep their order: one that is due before its predecessor waits for it.

    name: of the call. call: ended by a reset of the link. link: None passes all messages on at once.
    now_ns: the channel's clock.
    """

    most_ready, most_behind = MOST_READY, MOST_BEHIND

    def __init__(self, name: str, call: Ends, link: LiveLink | None, now_ns: Callable[[], int]) -> None:
        self._name = name
        self._call = call
        self._link = link
        self._now_ns = now_ns
        self._closed = False
        self._messages: deque[Message] = deque()
        self._read = 0
        self._dropped = 0
        self._due_ns = 0  # of the latest message that was passed on or dropped
        self._ended = False
        self._wake = asyncio.Event()
        self._not_full = asyncio.Event()
        self._not_full.set()
        if link is not None:
            link.calls.add(call)

    @property
    def lost_its_only_message(self) -> bool:
        """Whether the sender sent exactly one message and the link dropped it."""
        return self._ended and self._read == 1 and self._dropped == 1

    async def carry(self, read: Read, write: Write) -> None:
        """Run until the sender is done and every message has been written or dropped. Raises what ``read`` or
        ``write`` raises, except that a broken read ends the messages."""
        reader = asyncio.create_task(self._fill(read))
        try:
            while not (self._ended and not self._messages):
                if self._messages and self._messages[0].delivered is not None:
                    await self._pass(self._messages.popleft(), write)
                    continue
                if reader.done():
                    reader.result()
                self._wake.clear()
                await self._wake.wait()
        finally:
            self._stop()
            reader.cancel()

    def settle(self, message: Message, kind: EventKind) -> None:
        """See ``Receiver``."""
        if kind is EventKind.DUPLICATED:
            return  # ``_pass`` writes the second copy
        message.delivered = kind is EventKind.DELIVERED
        if not message.delivered:
            message.raw = b""
        elif self._closed:
            self._cancel(message)
        self._wake.set()

    def close(self) -> None:
        """End the flow when the call is over. Until then a link reset ends the call, even if this direction is done."""
        self._stop()
        if self._link is not None:
            self._link.calls.discard(self._call)

    def _stop(self) -> None:
        """Messages that the link still delivers are counted as cancelled."""
        self._closed = True
        if self._link is not None:
            for message in self._messages:
                if message.delivered:
                    self._cancel(message)
        self._messages.clear()

    def _cancel(self, message: Message) -> None:
        assert self._link is not None
        self._link.cancelled += 1
        self._link.record(message)

    async def _fill(self, read: Read) -> None:
        try:
            while True:
                try:
                    raw = await read()
                except STREAM_ENDED:  # the call's status says how it ended
                    break
                if raw is grpc.aio.EOF:
                    break
                message = Message(raw, self._name, self._read, self)
                self._read += 1
                self._call.use()
                self._messages.append(message)
                self._offer(message)
                inside = self._messages and self._messages[0].delivered is None
                if len(self._messages) >= (self.most_behind if inside else self.most_ready):
                    self._not_full.clear()
                    await self._not_full.wait()
            self._ended = True
        finally:
            self._wake.set()

    def _offer(self, message: Message) -> None:
        if self._link is None:
            self.settle(message, EventKind.DELIVERED)
        elif not self._link.has_room(message.raw):
            self._link.overfull += 1
            self.settle(message, EventKind.DROPPED_BUSY)
        else:
            self._link.offer(message, self._now_ns())

    async def _pass(self, message: Message, write: Write) -> None:
        if message.transit is not None:
            self._due_ns = max(self._due_ns, message.transit.ended_ns or 0)
        if not message.delivered:
            self._dropped += 1
        else:
            if self._link is not None:
                self._link.hand_on(message, self._now_ns(), self._due_ns)
            await write(message.raw)
            # A unary method takes one message, so the only message of a call is not written twice.
            if message.duplicated and self._read > 1:
                await write(message.raw)
        if len(self._messages) < self.most_ready:
            self._not_full.set()
