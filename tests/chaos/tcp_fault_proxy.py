"""A TCP relay on loopback between two processes, with faults of a network on request."""

from __future__ import annotations

import asyncio
import contextlib
import threading

from freshfield.transport import host_port
from freshfield_up.net import LOOPBACK

FAULTS = ("black hole", "half-open", "corrupted bytes")
_CHUNK = 1 << 16


class TcpFaultProxy:
    """Relays every connection at ``address`` to ``to`` (HOST:PORT), in its own thread until ``close``.

    ``fault`` starts one of FAULTS, ``mend`` ends it:

    - black hole: nothing passes; sent data waits in the TCP buffers.
    - half-open: the far ends of existing connections are closed, of which the near ends learn only at
      ``mend``; new connections work.
    - corrupted bytes: one byte of every chunk of at most 64 kB is changed.
    """

    address: str

    def __init__(self, to: str) -> None:
        self._to = host_port(to)
        self._corrupts = False
        self._pairs: list[tuple[asyncio.StreamWriter, asyncio.StreamWriter]] = []
        self._cut: set[asyncio.StreamWriter] = set()
        started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(started)), daemon=True)
        self._thread.start()
        started.wait()

    def fault(self, kind: str) -> None:
        act = {"black hole": self._passes.clear, "half-open": self._halve, "corrupted bytes": self._corrupt}
        self._loop.call_soon_threadsafe(act[kind])

    def mend(self) -> None:
        self._loop.call_soon_threadsafe(self._mend)

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
        self._pairs.append((near, far))
        await asyncio.gather(self._pump(reader, far, near), self._pump(far_reader, near, near))
        if near not in self._cut:
            near.transport.abort()
            far.transport.abort()
        self._pairs.remove((near, far))

    async def _pump(self, reader: asyncio.StreamReader, to: asyncio.StreamWriter, near: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(_CHUNK):
                await self._passes.wait()
                if near in self._cut:
                    continue  # swallowed
                if self._corrupts:
                    middle = len(data) // 2
                    data = data[:middle] + bytes([(data[middle] + 1) % 256]) + data[middle + 1 :]
                to.write(data)
                await to.drain()
        if near not in self._cut:
            to.close()

    def _halve(self) -> None:
        for near, far in self._pairs:
            self._cut.add(near)
            far.transport.abort()

    def _corrupt(self) -> None:
        self._corrupts = True

    def _mend(self) -> None:
        self._passes.set()
        self._corrupts = False
        for near in self._cut:
            near.transport.abort()
        self._cut.clear()
