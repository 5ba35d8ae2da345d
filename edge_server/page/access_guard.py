"""The page's network protection: TLS and login, checks of Host and Origin and of visitors' messages, and limits on
the number of visitors and on how long one may stop reading.

viser listens with the websockets package and has no parameter for any of this. While viser starts, its module
(and no other) gets a ``websockets`` whose ``serve`` has the hooks of an ``AccessGuard``.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import logging
import math
import secrets
import ssl
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from types import SimpleNamespace
from typing import Any

import msgspec
import websockets.asyncio.server
from viser.infra import WebsockServer
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosedError, InvalidMessage
from websockets.http11 import Request, Response

from edge_server.page.branding import branded
from edge_server.page.page_constants import (
    CLOSE_S,
    MAX_CLICKS_HZ,
    MAX_PAGE_CONNECTIONS,
    MAX_VIEW_SIDE_PX,
    MAX_VISITOR_MESSAGE_BYTES,
    MAX_VISITORS,
    SAY_EVERY_S,
    VISITOR_TIMEOUT_S,
)
from edge_server.page.splats.stream import STREAM, file_response
from freshfield.access import ANYBODY, CHANGE, Caller, HttpDoor, HttpRefused
from freshfield.limits import TLS_HANDSHAKE_TIMEOUT_S

log = logging.getLogger(__name__)

Vector = tuple[float, float, float]
Process = Callable[[ServerConnection, Request], Response | None]


class Viewpoint(msgspec.Struct, tag="ViewerCameraMessage"):
    """viser's message about a visitor's camera. Fields that a later viser adds are left to viser to check."""

    wxyz: tuple[float, float, float, float]
    position: Vector
    fov: float
    near: float
    far: float
    image_height: float
    image_width: float
    look_at: Vector
    up_direction: Vector

    def sound(self) -> bool:
        """Whether the camera can be rendered: finite, with a rotation, a field of view and a size."""
        numbers = (*self.wxyz, *self.position, *self.look_at, *self.up_direction)
        sides = (self.image_height, self.image_width)
        return (
            all(map(math.isfinite, numbers))
            and any(self.wxyz)
            and 0.0 < self.fov < math.pi
            and all(1 <= side <= MAX_VIEW_SIDE_PX for side in sides)
        )


class Click(msgspec.Struct, tag="SceneNodeClickMessage"):
    """viser's message about a click on a scene node."""

    name: str
    instance_index: int | None
    ray_origin: Vector
    ray_direction: Vector
    screen_pos: tuple[float, float]
    modifier: str | None
    owner: str = ""


class Update(msgspec.Struct, tag="GuiUpdateMessage"):
    """viser's message about new values of a control."""

    uuid: str
    updates: dict[str, bool | int | float | str]

    def sound(self, controls: dict[str, Any]) -> bool:
        """Whether it is a valid new value of one of ``controls``: of its type, and one that it offers."""
        handle, value = controls.get(self.uuid), self.updates.get("value")
        if handle is None or len(self.updates) != 1 or value is None:
            return False
        options = getattr(handle, "options", None)
        if options is not None:
            return value in options
        return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


_DECODER = msgspec.msgpack.Decoder(Viewpoint | Click | Update)


class AccessGuard:
    """Guards the page's connections.

    access: checks the login and the origin of requests.
    tls: for the port; None: no TLS.
    controls: the controls whose values may be set, by id.
    looks: by visitor, the controls that change only that visitor's view, like ``controls``. Viewers may use them.
    on_refused: called with the connection of a viewer who tried to change something.
    splats: serves visitors whose browser draws splats itself; None: nobody may.
    The last four are set once the page has been made.
    """

    def __init__(self, access: HttpDoor, tls: ssl.SSLContext | None) -> None:
        self.visitors: set[ServerConnection] = set()
        self.refused: Counter[str] = Counter()
        self._quiet_until_s: dict[str, float] = {}
        self.controls: dict[str, Any] = {}
        self.looks: dict[int, dict[str, Any]] = {}
        self.on_refused: Callable[[ServerConnection], None] = lambda connection: None
        self.splats: Callable[[ServerConnection], Awaitable[None]] | None = None
        self._access = access
        self._tls = tls
        self._secret = secrets.token_bytes(32)
        self._handshakes: dict[asyncio.Task[Any], None] = {}
        self._connections: dict[VisitorConnection, None] = {}
        self.used = False

    @contextlib.contextmanager
    def before_viser(self) -> Iterator[None]:
        """Within the context, servers that viser starts are guarded; other servers of the process are not."""
        viser_module = sys.modules[WebsockServer.__module__]

        def guarded(handler: Any, host: Any, port: Any, **options: Any) -> Any:
            self.used = True
            process = options.pop("process_request")
            # A separate logger, which passes on only what ``_worth_a_line`` accepts.
            logger = logging.Logger("websockets.server")
            logger.parent = logging.getLogger(logger.name)
            logger.addFilter(self._worth_a_line)
            options |= {
                "max_size": MAX_VISITOR_MESSAGE_BYTES,
                "max_queue": 4,
                "logger": logger,
                "close_timeout": CLOSE_S,
                "ssl": self._tls,
                "process_request": lambda connection, request: self._answer(connection, request, process),
                "create_connection": self._accepted,
            }
            if self._tls is not None:
                options["ssl_handshake_timeout"] = TLS_HANDSHAKE_TIMEOUT_S

            async def routed(connection: ServerConnection) -> None:
                draws = isinstance(connection, VisitorConnection) and connection.draws
                await (self.splats(connection) if draws and self.splats else handler(connection))

            return websockets.asyncio.server.serve(routed, host, port, **options)

        server = SimpleNamespace(**vars(websockets.asyncio.server) | {"serve": guarded})
        asyncio_package = SimpleNamespace(**vars(websockets.asyncio) | {"server": server})
        package = SimpleNamespace(**vars(websockets) | {"asyncio": asyncio_package})
        original = vars(viser_module).get("websockets")
        setattr(viser_module, "websockets", package)  # noqa: B010 -- no attribute that a type checker knows
        try:
            yield
        finally:
            setattr(viser_module, "websockets", original)  # noqa: B010

    def _accepted(self, *words: Any, **more: Any) -> VisitorConnection:
        """Called in the task that accepts a connection, which over TLS lasts until the end of the handshake.
        If there are too many such tasks, the oldest is cancelled."""
        if self._tls is not None and (task := asyncio.current_task()) is not None:
            self._handshakes[task] = None
            task.add_done_callback(lambda done: self._handshakes.pop(done, None))
            if len(self._handshakes) > MAX_PAGE_CONNECTIONS:
                oldest = next(iter(self._handshakes))
                del self._handshakes[oldest]
                oldest.cancel()
        return VisitorConnection(self, *words, **more)

    def opened(self, connection: VisitorConnection) -> None:
        """Count a connection; if there are too many, the oldest one that is not a visitor's ends."""
        self._connections[connection] = None
        if len(self._connections) > MAX_PAGE_CONNECTIONS:
            oldest = next(c for c in self._connections if c not in self.visitors)
            del self._connections[oldest]  # at once: many may arrive before it is closed
            oldest.transport.abort()

    def closed(self, connection: VisitorConnection) -> None:
        self._connections.pop(connection, None)
        self.visitors.discard(connection)

    def takes(self, connection: VisitorConnection, data: str | bytes) -> bool:
        """Whether a visitor's message may be passed on to viser."""
        try:
            message = _DECODER.decode(data if isinstance(data, bytes) else b"")
        except (msgspec.MsgspecError, RecursionError):
            return self._refuse("a message that visitors do not send")
        if isinstance(message, Viewpoint):
            return message.sound() or self._refuse("a viewpoint that nobody can have")
        if not connection.in_time():
            return self._refuse("more than a person can click")
        if isinstance(message, Update):
            own = next((each for each in self.looks.values() if message.uuid in each), None)
            if own is None and not connection.caller.may(CHANGE):
                self.on_refused(connection)
                return self._refuse("a change by a viewer")
            return message.sound(self.controls if own is None else own) or self._refuse("a value that no control takes")
        return True

    def acknowledges(self, data: str | bytes) -> bool:
        """Whether ``data``, from a visitor whose browser draws splats, is the number of a message."""
        return (isinstance(data, bytes) and len(data) == 4) or self._refuse("a message that visitors do not send")

    def _refuse(self, what: str) -> bool:
        """Count what was refused, and log it, once a minute at most."""
        self.refused[what] += 1
        now_s = time.monotonic()
        if now_s >= self._quiet_until_s.get(what, 0.0):
            self._quiet_until_s[what] = now_s + SAY_EVERY_S
            log.warning("page: refused: %s (%d so far)", what, self.refused[what])
        return False

    def _worth_a_line(self, record: logging.LogRecord) -> bool:
        """Whether websockets may log a record; visitors and refused requests get no line each. Malformed requests,
        which anybody may send, are counted; connections that close without a request are ignored."""
        error = record.exc_info[1] if record.exc_info else None
        if error is None:
            return record.levelno >= logging.WARNING
        if not isinstance(error, InvalidMessage):  # a bug of ours, which viser would not report
            log.error("page: %s", record.getMessage(), exc_info=record.exc_info)
        elif not isinstance(error.__cause__, EOFError):
            self._refuse("a request that is not an HTTP/1.1 GET")
        return False

    def _answer(self, connection: VisitorConnection, request: Request, process: Process) -> Response | None:
        """The response to a request; None lets a visitor in."""
        host, origin = _one(request, "Host"), _one(request, "Origin")
        authorization = _one(request, "Authorization")
        cookie = f"freshfield-{connection.local_address[1]}"
        try:
            self._access.check_origin(host, origin)
            known = self._known(request, cookie) if authorization is None else None
            connection.caller = known or self._access.caller(authorization)
        except HttpRefused as error:
            self._refuse(f"requests with status {error.status}")
            refusal = connection.respond(error.status, f"{error}\n")
            if error.status == 401:
                refusal.headers["WWW-Authenticate"] = 'Basic realm="freshfield", charset="UTF-8"'
            return refusal
        if len(request.path.partition("?")[0]) > 255:  # no file has such a name, and asking for it fails
            self._refuse("a path that is too long")
            return connection.respond(404, "There is no such page.\n")
        if "websocket" in (_one(request, "Upgrade") or "").lower():
            if len(self.visitors) >= MAX_VISITORS:
                self._refuse(f"visitors beyond {MAX_VISITORS}")
                return connection.respond(503, f"{MAX_VISITORS} visitors are here already\n")
            self.visitors.add(connection)
            connection.draws = request.path == STREAM and self.splats is not None
            if connection.draws:
                return None
        response = file_response(request.path) if self.splats else None
        if response is None:
            response = process(connection, request)
            if response is not None and response.headers.get("Content-Type", "").startswith("text/html"):
                _brand(response)
        if response is not None:
            # Other sites may not embed this page in a frame (clickjacking).
            response.headers.setdefault("Content-Security-Policy", "frame-ancestors 'self'")
            if self._access.access is not None and authorization is not None:
                flags = "; Secure" if self._tls is not None else ""
                value = self._cookie(connection.caller)
                response.headers["Set-Cookie"] = f"{cookie}={value}; HttpOnly; SameSite=Strict; Path=/{flags}"
        return response

    def _known(self, request: Request, cookie: str) -> Caller | None:
        """The caller who logged in before: not all browsers send the login with a websocket."""
        for part in (_one(request, "Cookie") or "").split(";"):
            name, _, value = part.strip().partition("=")
            for role in ("viewer", "operator") if name == cookie else ():
                if hmac.compare_digest(value.encode(errors="replace"), self._cookie(Caller(role)).encode()):
                    return Caller(role)
        return None

    def _cookie(self, caller: Caller) -> str:
        return hmac.new(self._secret, caller.role.encode(), hashlib.sha256).hexdigest()


class VisitorConnection(ServerConnection):
    """A connection that a guard watches."""

    def __init__(self, guard: AccessGuard, *words: Any, **more: Any) -> None:
        super().__init__(*words, **more)
        self.caller = ANYBODY
        self.draws = False  # whether the browser draws splats itself
        self._guard = guard
        self._clicks = 0.0  # current allowance of clicks
        self._clicked_s = -math.inf

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._guard.opened(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self._guard.closed(self)
        super().connection_lost(exc)

    def in_time(self) -> bool:
        """Whether one more click may come. Each may queue an answer, which a visitor need not read."""
        now_s = self.loop.time()
        self._clicks = min(MAX_CLICKS_HZ, self._clicks + MAX_CLICKS_HZ * (now_s - self._clicked_s))
        self._clicked_s = now_s
        if self._clicks < 1.0:
            return False
        self._clicks -= 1.0
        return True

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            data = await super().recv(decode)
            if self._guard.acknowledges(data) if self.draws else self._guard.takes(self, data):
                return data

    async def send(self, message: Any, text: bool | None = None) -> None:
        """Send; a visitor who reads nothing for too long is disconnected, and their pending messages are dropped."""
        try:
            async with asyncio.timeout(VISITOR_TIMEOUT_S):
                await super().send(message, text)
        except TimeoutError:
            self.transport.abort()
            raise ConnectionClosedError(None, None) from None


def _brand(response: Response) -> None:
    """Put the page's title, icon and styles into viser's HTML document."""
    response.body = branded(bytes(response.body), response.headers["Content-Encoding"] == "gzip")
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


def _one(request: Request, name: str) -> str | None:
    """A header's value. Repeated values are joined, so that they match nothing."""
    values = request.headers.get_all(name)
    return ", ".join(values) if values else None
