"""A TCP relay on loopback between two processes, with faults of a network on request."""

from __future__ import annotations

import asyncio
import contextlib
import threading

from freshfield.transport import host_port
from freshfield_up.net import LOOPBACK

FAULTS = ("black hole", "corrupted bytes")
_CHUNK = 1 << 16


class TcpFaultProxy:
    """Relays every connection at ``address`` to ``to`` (HOST:PORT), in its own thread until ``close``.

    ``fault`` starts one of FAULTS, ``mend`` ends it:

    - black hole: nothing passes; sent data waits in the TCP buffers.
    - corrupted bytes: one byte of every chunk of at most 64 kB is changed.
    """

    address: str

    def __init__(self, to: str) -> None:
        self._to = host_port(to)
        self._corrupts = False
        started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(started)), daemon=True)
        self._thread.start()
        started.wait()

    def fault(self, kind: str) -> None:
        if kind == "corrupted bytes":
            self._corrupts = True
        else:
            self._loop.call_soon_threadsafe(self._passes.clear)

    def mend(self) -> None:
        self._corrupts = False
        self._loop.call_soon_threadsafe(self._passes.set)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join()

    async def _serve(self, started: threading.Event) -> None:
        self._loop, self._passes, self._closing = asyncio.get_running_loop(), asyncio.Event(), asyncio.Event()
        self._passes.set()
        server = await asyncio.start_server(self._relay, LOOPBACK, 0)
        self.address = f"{LOOPBACK}:{server.sockets[0].getsockname()[1]}"
        started.set()
        await self._closing.wait()

    async def _relay(self, reader: asyncio.StreamReader, near: asyncio.StreamWriter) -> None:
        await self._passes.wait()
        try:
            far_reader, far = await asyncio.open_connection(*self._to)
        except OSError:
            near.transport.abort()
            return
        await asyncio.gather(self._pump(reader, far), self._pump(far_reader, near))

    async def _pump(self, reader: asyncio.StreamReader, to: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(_CHUNK):
                await self._passes.wait()
                if self._corrupts:
                    middle = len(data) // 2
                    data = data[:middle] + bytes([(data[middle] + 1) % 256]) + data[middle + 1 :]
                to.write(data)
                await to.drain()
        to.transport.abort()
