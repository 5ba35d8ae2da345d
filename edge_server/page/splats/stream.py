"""Serves the splat stream and the page that draws it, on the port of the live page and behind the same guard.

One thread polls publications and composes each visitor's messages; the event loop of the connections sends them.
Nothing is computed without visitors.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Response

from edge_server.live.state import CameraView, EdgeState
from edge_server.page.colors import HELD_OUT, age_color
from edge_server.page.page_thread import PageThread
from edge_server.page.splats.splat_stream_constants import IDLE_S, TICK_S
from edge_server.page.viewpoint import VERTICAL_FOV_RAD, Viewpoint

if TYPE_CHECKING:  # with the kernels of Gaussians, which another field does not need
    from edge_server.page.splats.published import Publisher
    from edge_server.page.splats.visitor import Visitor

PATH = "/splats/"
STREAM = PATH + "stream"
_WEB = Path(__file__).parent / "web"
_FILES = {
    "": ("index.html", "text/html; charset=utf-8"),
    "style.css": ("style.css", "text/css; charset=utf-8"),
    **{name: (name, "text/javascript; charset=utf-8") for name in ("viewer.js", "splats.js", "reader.js", "orbit.js")},
}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "frame-ancestors 'self'"
)


def file_response(path: str) -> Response | None:
    """A file of the page; None if it does not exist. path: of the request."""
    path = path.partition("?")[0]
    if path == PATH.rstrip("/"):
        return Response(301, "Moved Permanently", Headers({"Location": "splats/", "Content-Length": "0"}), b"")
    found = _FILES.get(path.removeprefix(PATH)) if path.startswith(PATH) else None
    if found is None:
        return None
    name, kind = found
    body = (_WEB / name).read_bytes()
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Content-Security-Policy": _POLICY,
            "Cache-Control": "no-cache",
            "X-Content-Type-Options": "nosniff",
        }
    )
    return Response(200, "OK", headers, body)


@dataclass(eq=False)
class _Connected:
    """A visitor, their event loop, and their queue of messages."""

    loop: asyncio.AbstractEventLoop
    visitor: Visitor
    queue: asyncio.Queue[bytes] = field(default_factory=asyncio.Queue)
    lock: threading.Lock = field(default_factory=threading.Lock)


class SplatStream(PageThread):
    """The stream of one run.

    viewpoint: where visitors begin; None while it is not known.
    """

    def __init__(self, state: EdgeState, viewpoint: Callable[[], Viewpoint | None]) -> None:
        super().__init__("page-splats", "composing splats")
        self._state, self._viewpoint = state, viewpoint
        self._publisher: Publisher | None = None
        self._connected: list[_Connected] = []

    async def serve(self, connection: ServerConnection) -> None:
        """Send a visitor the stream until they leave. What they send: the number of the newest message that they have
        read, four bytes."""
        from edge_server.page.splats.visitor import Visitor

        connected = _Connected(asyncio.get_running_loop(), Visitor())
        with self._wake:
            self._connected.append(connected)
            self.wake()
        sending = asyncio.create_task(_send(connection, connected.queue))
        try:
            async for message in connection:
                if isinstance(message, bytes):
                    with connected.lock:
                        connected.visitor.acknowledged(int.from_bytes(message, "little"), monotonic())
        except ConnectionClosed:
            pass
        finally:
            with self._wake:
                self._connected.remove(connected)
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await sending

    def _step(self) -> float:
        with self._wake:
            connected = list(self._connected)
        if not connected:
            return IDLE_S
        began = perf_counter()
        self._tick(connected)
        spent = perf_counter() - began
        return max(TICK_S - spent, spent)

    def _tick(self, connected: list[_Connected]) -> None:
        from edge_server.page.splats.published import Publisher

        self._publisher = self._publisher or Publisher(self._state.start_ns)
        snapshot = self._state.renderer
        published = None if snapshot is None else self._publisher.take(snapshot, monotonic())
        status = self._status(snapshot is not None and published is None)
        for each in connected:
            if not each.queue.empty():  # the connection has not taken the last message yet
                continue
            with each.lock:
                data = each.visitor.message(published, self._state.now_s(), status, monotonic())
            if data is not None:
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    each.loop.call_soon_threadsafe(each.queue.put_nowait, data)

    def _status(self, other: bool) -> dict[str, Any]:
        """The status for all visitors. other: the field does not consist of Gaussians."""
        state, newest = self._state, self._state.newest(scored=True)
        line = state.status_line
        if other:
            line = f"{state.field_name} does not consist of Gaussians: the live page shows it"
        elif newest is not None and newest.psnr_db is not None:
            line = f"{newest.psnr_db:.1f} dB on {newest.scored_on}, frames {newest.aaoi_ms:.0f} ms old"
        view = self._viewpoint()
        start = None
        if view is not None:
            start = {
                "position": np.round(view.position, 4).tolist(),
                "look_at": np.round(view.look_at, 4).tolist(),
                "up": np.round(view.up, 4).tolist(),
                "fov": VERTICAL_FOV_RAD,
                "radius": round(view.radius_m, 4),
            }
        cameras = [found for camera in state.cameras() if (found := _camera(camera)) is not None]
        return {"scenario": state.scenario, "line": line, "start": start, "cameras": cameras}


def _camera(camera: CameraView) -> dict[str, Any] | None:
    frame = camera.newest
    if frame is None:
        return None
    k = frame.intrinsics
    return {
        "name": camera.camera,
        "held_out": camera.held_out,
        "color": HELD_OUT if camera.held_out else age_color(camera.age_ms),
        "age_ms": None if camera.age_ms is None else round(camera.age_ms),
        "position": np.round(frame.pose.translation_m, 4).tolist(),
        "wxyz": np.round(frame.pose.quaternion, 5).tolist(),
        "fov": round(float(2.0 * np.arctan(0.5 * k.height / k.fy)), 4),
        "aspect": round(k.width / k.height, 4),
    }


async def _send(connection: ServerConnection, queue: asyncio.Queue[bytes]) -> None:
    while True:
        await connection.send(await queue.get())
