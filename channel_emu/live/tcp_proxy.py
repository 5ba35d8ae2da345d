"""A proxy for any protocol over TCP: what is sent passes the emulated link in pieces, in order and without loss.

TCP repairs what a network does, so here losses cost time: a piece that the link loses or damages is sent again after a
timeout, and what came after it waits. Each direction has one link, of discipline fcfs, for all connections: they share
its capacity. A sender is read no further than BEHIND pieces ahead of what has arrived, as a receiver's window does it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from channel_emu.live.live_link import Flips, LiveLink, Message
from channel_emu.live.proxy import Proxy, ProxyOptions
from channel_emu.model.link import EventKind
from channel_emu.model.settings import ChannelConfig
from freshfield.transport import TransportError, host_port

log = logging.getLogger("channel-emu")

PIECE_BYTES = 16_384
"""Largest piece: each takes one service time of the channel."""
BEHIND = 8
"""Pieces of a direction of a connection inside the link."""
TIMEOUT_S = 0.2
"""After which a lost piece is sent again: the least of TCP's implementations (RFC 6298 asks for 1 s at first)."""
MOST_CONNECTIONS = 256
_CONNECT_TIMEOUT_S = 10.0


class Pipe:
    """One direction of one connection. number: of the connection. link: None passes everything on at once."""

    def __init__(self, number: int, proxy: TcpProxy, link: LiveLink | None, writer: asyncio.StreamWriter) -> None:
        self._name, self._proxy, self._link, self._writer = f"connection{number}", proxy, link, writer
        self._pieces: deque[Message] = deque()
        self._read, self._closed, self._ended = 0, False, False
        self._room = asyncio.Semaphore(BEHIND)
        self._empty = asyncio.Event()
        if link is not None:
            link.calls.add(self)

    async def carry(self, reader: asyncio.StreamReader) -> None:
        """Pass on what ``reader`` brings, until its end has been passed on too."""
        while data := await reader.read(PIECE_BYTES):
            if self._link is None:
                self._writer.write(data)
            else:
                await self._room.acquire()
                piece = Message(data, self._name, self._read, self)
                self._pieces.append(piece)
                self._link.offer(piece, self._proxy.events.now_ns())
            self._read += 1
            await self._writer.drain()
        self._ended = True
        if self._pieces:
            await self._empty.wait()
        with contextlib.suppress(OSError):
            self._writer.write_eof()

    def settle(self, message: Message, kind: EventKind) -> None:
        """See ``Receiver``."""
        if kind is EventKind.DUPLICATED:
            return  # TCP discards a copy
        flips = message.transit is not None and bool(message.transit.flips)
        if kind is not EventKind.DELIVERED or flips:
            if not self._closed:
                asyncio.get_running_loop().call_later(TIMEOUT_S, self._again, message)
            return
        message.delivered = True
        assert self._link is not None
        while self._pieces and self._pieces[0].delivered:
            piece = self._pieces.popleft()
            self._link.hand_on(piece, self._proxy.events.now_ns())
            self._writer.write(piece.raw)
            self._room.release()
        if self._ended and not self._pieces:
            self._empty.set()

    def _again(self, lost: Message) -> None:
        if self._closed or self._link is None:
            return
        piece = Message(lost.raw, lost.session, lost.sequence, self)
        self._pieces[self._pieces.index(lost)] = piece
        self._link.offer(piece, self._proxy.events.now_ns())

    def end(self, *_: Any) -> None:
        """Break the connection: the link was reset."""
        self._writer.transport.abort()

    def close(self) -> None:
        """Forget the link: what it still delivers counts as cancelled."""
        self._closed = True
        if self._link is not None:
            self._link.calls.discard(self)
            self._link.cancelled += sum(bool(piece.delivered) for piece in self._pieces)


class TcpProxy(Proxy):
    """As ``Proxy``, for bytes instead of calls. TLS passes as it is: certificates and tokens are not used."""

    def __init__(self, config: ChannelConfig, seed: int, options: ProxyOptions) -> None:
        super().__init__(replace(config, discipline="fcfs"), seed, options)
        self._connections = 0
        self._open: set[asyncio.Task[None]] = set()
        self._listening: asyncio.Server | None = None

    async def start(self) -> int:
        """Start to listen. Returns the port. Raises TransportError if the address cannot be used."""
        host, port = host_port(self.options.listen)
        if words := self.options.transport.guard(host, "TCP"):
            log.warning("--insecure: %s", words)
        try:
            self._listening = await asyncio.start_server(self._accept, host, port)
        except OSError as error:
            raise TransportError(f"cannot listen on {self.options.listen}: {error.strerror or error}") from None
        self.port = self._listening.sockets[0].getsockname()[1]
        self.spawn(self._refresh())
        return self.port

    def link(self, name: str, damage: Callable[[bytes, Flips], bytes] | None = None) -> LiveLink:
        """See ``Proxy``. What was damaged is sent again as it was: checksums find it."""
        return super().link(name, damage or (lambda raw, flips: raw))

    def close(self) -> None:
        """See ``Proxy``."""
        if self._listening is not None:
            self._listening.close()

    async def stop(self) -> None:
        """See ``Proxy``."""
        for task in self._open:
            task.cancel()
        await asyncio.gather(*self._open, return_exceptions=True)
        await super().stop()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if len(self._open) >= MOST_CONNECTIONS:
            log.warning("refused a connection: %d are open already", MOST_CONNECTIONS)
            writer.transport.abort()
            return
        self._open.add(task)
        task.add_done_callback(self._open.discard)
        try:
            await self._carry_both(reader, writer)
        except asyncio.CancelledError:
            pass  # by ``stop``; asyncio's server would log it as an error
        except Exception as error:
            self.fail(error)
        finally:
            writer.transport.abort()

    async def _carry_both(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        try:
            async with asyncio.timeout(_CONNECT_TIMEOUT_S):
                there, back = await asyncio.open_connection(*host_port(self.options.to))
        except OSError as error:  # TimeoutError is one
            log.warning("%s does not answer: %s", self.options.to, error or "timeout")
            return
        up = Pipe(self._connections, self, self._link_of("up", "bytes"), back)
        down = Pipe(self._connections, self, self._link_of("down", "bytes"), writer)
        parts = [asyncio.create_task(up.carry(reader)), asyncio.create_task(down.carry(there))]
        try:
            with contextlib.suppress(ConnectionError):
                await asyncio.gather(*parts)
        finally:
            for part in parts:
                part.cancel()
            await asyncio.gather(*parts, return_exceptions=True)
            up.close()
            down.close()
            back.transport.abort()
