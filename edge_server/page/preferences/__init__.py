"""The preference page: two reconstructions side by side from one moving viewpoint, and which is better.

The server holds the session, so that a reload and a second tab show the same question. The page learns
neither which reconstructions it shows nor whether the pair is a repeated one.
"""

from __future__ import annotations

import json
import re
import secrets
import threading
from collections.abc import Callable, Iterable, Sequence
from http import HTTPStatus
from importlib.resources import files
from typing import Any

from edge_server.live.output.guarded_http import CALLER, serve_guarded
from edge_server.page import PageError, page_url
from edge_server.page import page_constants as tuned
from edge_server.viewpoints.preference_session import PreferenceSession
from freshfield.access import CHANGE
from freshfield.transport import Transport

_HEADERS = [
    ("Cache-Control", "no-store"),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
    (
        "Content-Security-Policy",
        "default-src 'none'; img-src 'self'; connect-src 'self'; style-src "
        "'unsafe-inline'; script-src 'unsafe-inline'; frame-ancestors 'none'",
    ),
]


class _Refused(Exception):
    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


class PreferencePage:
    """Asks the questions of ``session``.

    sprites: for each reconstruction, a JPEG with its pictures along the path.
    frames, columns: number of pictures, and of columns, in each JPEG.
    keep: writes a session; an answer that it cannot write (OSError) is not taken.
    """

    def __init__(
        self,
        session: PreferenceSession,
        sprites: Sequence[bytes],
        frames: int,
        columns: int,
        keep: Callable[[PreferenceSession], None],
    ) -> None:
        self.session = session
        self.finished = threading.Event()
        self.seen = threading.Event()  # whether somebody viewed the plan
        self._plan: tuple[list[str], bytes] | None = None
        self._sprites, self._layout = sprites, {"frames": frames, "columns": columns}
        self._keep = keep
        self._lock = threading.Lock()
        self._turn = secrets.token_hex(8)  # identifies the session's current state; reveals nothing of the pair

    def serve(self, host: str, port: int, transport: Transport | None = None) -> tuple[str, Callable[[], None]]:
        """Serve on a thread; returns the address and a function that closes the page. Raises PageError if the
        port is not available, TransportError if the page would be open to others."""
        try:
            port, close = serve_guarded(self, "preference page", host, port, transport)
        except (OSError, OverflowError) as error:
            raise PageError(f"page: cannot listen on {host}:{port} ({error}); see --page-port") from None
        return page_url(host, port, bool(transport and transport.tls(host))), close

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        """The WSGI application."""
        method, path = environ["REQUEST_METHOD"], environ.get("PATH_INFO", "/")
        may_change = environ[CALLER].may(CHANGE)
        try:
            if method == "POST":
                if not may_change:
                    raise _Refused(403, "Your login is for viewing only.")
                self._change(path, _body(environ))
                path = "/state"
            elif method != "GET":
                raise _Refused(404, "Not found.")
            with self._lock:
                status, (kind, body) = 200, self._look(path, may_change)
        except _Refused as error:
            status, kind, body = error.status, "text/plain; charset=utf-8", str(error).encode()
        about = [("Content-Type", kind), ("Content-Length", str(len(body)))]
        start_response(f"{status} {HTTPStatus(status).phrase}", [*about, *_HEADERS])
        return [body]

    def _look(self, path: str, may_change: bool) -> tuple[str, bytes]:
        """Content type and content of an address."""
        session = self.session
        if path == "/":
            return "text/html; charset=utf-8", files(__package__).joinpath("preferences.html").read_bytes()
        if path == "/seen" and self._plan is not None:  # the picture arrived: the server may end
            self.seen.set()
        if path in ("/state", "/seen"):
            return "application/json", json.dumps(self.state(session) | {"may_change": may_change}).encode()
        if path == "/plan.png" and self._plan is not None:
            return "image/png", self._plan[1]
        asked = session.question
        found = re.fullmatch(r"/(left|right)/(\w+)\.jpg", path)
        if asked is None or found is None or found[2] != self._turn:
            raise _Refused(404, "Not found.")
        return "image/jpeg", self._sprites[getattr(asked, found[1])]

    def state(self, session: PreferenceSession) -> dict[str, Any]:
        """The state that the page gets."""
        agreed, repeated = session.agreement
        return {
            "turn": self._turn,
            "answered": len(session.answers),
            "wanted": session.wanted,
            "open": session.question is not None,
            "agreed": agreed,
            "repeated": repeated,
            "says": session.model.says(),
            "finished": self.finished.is_set(),
            "plan": None if self._plan is None else self._plan[0],
            **self._layout,
        }

    def show_plan(self, lines: list[str], png: bytes) -> None:
        """Show the plan that resulted from the answers: the choice and its reasons, and the candidates by value."""
        with self._lock:
            self._plan = lines, png

    def _change(self, path: str, body: bytes) -> None:
        """Apply an answer, an undo or the end. Requests about an earlier turn are refused, so that two tabs or a
        double click answer nothing twice."""
        with self._lock:
            session = self.session
            if self.finished.is_set():
                raise _Refused(409, "The session has ended.")
            message = _message(body)
            if message.get("turn") != self._turn:
                raise _Refused(409, "This was answered elsewhere; here is the current pair.")
            if path == "/answer" and message.get("choice") in ("left", "right", "neither"):
                if session.question is None:
                    raise _Refused(409, "All questions are answered.")
                session = session.answered(message["choice"])
            elif path == "/undo":
                session = session.undone()
            elif path == "/finish":
                self.finished.set()
                return
            else:
                raise _Refused(404, "Not found.")
            try:
                self._keep(session)
            except OSError as error:
                raise _Refused(507, f"Not kept: {error.strerror or error}") from None
            self.session, self._turn = session, secrets.token_hex(8)


def _message(body: bytes) -> dict[str, Any]:
    try:
        message = json.loads(body)
    except (ValueError, RecursionError):
        message = None
    if not isinstance(message, dict):
        raise _Refused(400, "Expected a JSON object.")
    return message


def _body(environ: dict[str, Any]) -> bytes:
    length = environ.get("CONTENT_LENGTH") or "0"
    if not (length.isascii() and length.isdigit() and len(length) < 10) or int(length) > tuned.MAX_ANSWER_BYTES:
        raise _Refused(413, f"At most {tuned.MAX_ANSWER_BYTES // 2**10} KiB.")
    try:
        body: bytes = environ["wsgi.input"].read(int(length))
    except OSError:
        raise _Refused(400, "The body did not arrive.") from None
    return body
