"""A proxy for any protocol over TCP: bytes pass the emulated link in pieces, in order and without loss.

TCP retransmits, so losses cost time: a piece that the link loses or damages is sent again after a timeout, and later
ones wait for it. Each direction has one link, of discipline fcfs, for all connections, which share its capacity. The
proxy reads a sender at most PIECES_BEHIND pieces ahead of what has arrived, like a TCP receive window.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import struct
from collections.abc import Callable, Iterator
from typing import Any

import grpc.aio
from msgspec.structs import replace

from channel_emu.live import live_emulator_constants as tuned
from channel_emu.live.call_flow import CallFlow
from channel_emu.live.live_link import Flips, LiveLink, Message
from channel_emu.live.proxy import Proxy, ProxyOptions
from channel_emu.model.link import EventKind
from channel_emu.model.settings import ChannelConfig
from freshfield.transport import TransportError, socket_address

log = logging.getLogger("channel-emu")

_RESET_AT_CLOSE = struct.pack("ii", 1, 0)


class Connection:
    """Two sockets that a reset of the link closes. writers: to the service and to its client."""

    def __init__(self, *writers: asyncio.StreamWriter) -> None:
        self._writers = writers

    def use(self) -> None:
        """Connections are not ended for lack of use."""

    def end(self, *_: Any) -> None:
        """Break the connection: both sides see a reset, since a normal close would look as if nothing were missing."""
        for writer in self._writers:
            with contextlib.suppress(OSError):  # closed already
                writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_AT_CLOSE)
            writer.transport.abort()


class Pipe(CallFlow):
    """One direction of one connection."""

    most_ready = most_behind = tuned.PIECES_BEHIND

    def settle(self, message: Message, kind: EventKind) -> None:
        """Offer a lost or damaged piece again after a while, and discard a copy, as TCP does."""
        damaged = message.transit is not None and bool(message.transit.flips)
        if kind is EventKind.DUPLICATED or (kind is EventKind.DELIVERED and not damaged):
            message.duplicated = False
            super().settle(message, kind)
            return
        if damaged and self._link is not None:
            self._link.record(message)  # as it is not handed on
        if not self._closed:
            asyncio.get_running_loop().call_later(tuned.RESEND_AFTER_S, self._again, message)

    def _again(self, lost: Message) -> None:
        if not self._closed:
            piece = Message(lost.raw, lost.session, lost.sequence, self)
            self._messages[self._messages.index(lost)] = piece
            self._offer(piece)

    async def pass_on(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass on what ``reader`` brings, until its end has been passed on too."""

        async def read() -> Any:
            with _as_reset():
                return await reader.read(tuned.PIECE_BYTES) or grpc.aio.EOF

        async def write(piece: bytes) -> None:
            with _as_reset():
                writer.write(piece)
                await writer.drain()

        # ``drain`` waits for every byte, so that none is left here when the connection is closed.
        writer.transport.set_write_buffer_limits(0)
        await self.carry(read, write)
        with contextlib.suppress(OSError):
            writer.write_eof()


class TcpProxy(Proxy):
    """As ``Proxy``, for bytes instead of calls. TLS passes through unchanged: certificates and tokens are not used."""

    def __init__(self, config: ChannelConfig, seed: int, options: ProxyOptions) -> None:
        super().__init__(replace(config, discipline="fcfs"), seed, options)
        self._connections = 0
        self._open: set[asyncio.Task[None]] = set()
        self._listening: asyncio.Server | None = None

    def bind(self) -> int:
        """See ``Proxy``."""
        host, port = socket_address(self.options.listen)
        if words := self.options.transport.guard(host, "TCP"):
            log.warning("--insecure: %s", words)
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._socket = socket.create_server((host, port), family=family)
        except OSError as error:
            raise TransportError(f"cannot listen on {self.options.listen}: {error.strerror or error}") from None
        return int(self._socket.getsockname()[1])

    async def start(self) -> int:
        """Start to answer. Returns the port."""
        self._listening = await asyncio.start_server(self._accept, sock=self._socket)
        self.spawn(self._refresh())
        return self.port

    def link(self, name: str, damage: Callable[[bytes, Flips], bytes] | None = None) -> LiveLink:
        """See ``Proxy``. Damaged pieces are sent again undamaged, because TCP's checksums detect damage."""
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
        if len(self._open) >= tuned.MOST_CONNECTIONS:
            log.warning("refused a connection: %d are open already", tuned.MOST_CONNECTIONS)
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
        name = f"connection{self._connections}"
        try:
            async with asyncio.timeout(tuned.CONNECT_TIMEOUT_S):
                there, back = await asyncio.open_connection(*socket_address(self.options.to))
        except OSError as error:  # TimeoutError is one
            log.warning("%s does not answer: %s", self.options.to, str(error) or "timeout")
            return
        both = Connection(back, writer)
        up = Pipe(name, both, self._link_of("up", "bytes"), self.events.now_ns)
        down = Pipe(name, both, self._link_of("down", "bytes"), self.events.now_ns)
        parts = [asyncio.create_task(up.pass_on(reader, back)), asyncio.create_task(down.pass_on(there, writer))]
        try:
            with contextlib.suppress(ConnectionError):
                await asyncio.gather(*parts)
        finally:
            up.close()
            down.close()
            for part in parts:
                part.cancel()
            if any(await asyncio.gather(*parts, return_exceptions=True)):  # at least one failed
                both.end()
            back.transport.abort()


@contextlib.contextmanager
def _as_reset() -> Iterator[None]:
    """Treat a peer that no longer answers or is unreachable as a reset of its connection only."""
    try:
        yield
    except OSError as error:
        raise ConnectionResetError(str(error)) from error
