"""A small HTTP server: a WSGI application behind the access rules, with a bounded number of connections."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from collections.abc import Callable
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from edge_server.live import live_constants as tuned
from freshfield.access import HttpDoor, HttpRefused
from freshfield.transport import Transport, TransportError

log = logging.getLogger(__name__)

CALLER = "freshfield.caller"
"""Key of the ``access.Caller`` in the environment of an application's requests."""


class _Handler(WSGIRequestHandler):
    timeout = tuned.SCRAPE_TIMEOUT_S  # of each read of the socket

    def log_message(self, *_: Any) -> None:
        """Requests are not logged."""


class _Server(ThreadingMixIn, WSGIServer):
    """One thread per connection. If there are more than tuned.MAX_SCRAPES, a new connection ends the oldest."""

    daemon_threads = True
    request_queue_size = tuned.WAITING_CONNECTIONS

    def __init__(self, host: str, port: int) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._lock = threading.Lock()
        self._open: list[socket.socket] = []
        super().__init__((host, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            self._open.append(request)
            if len(self._open) > tuned.MAX_SCRAPES:
                with contextlib.suppress(OSError):  # its thread reads the end of the request
                    self._open.pop(0).shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with contextlib.suppress(OSError):
            _read_to_its_end(request)
        with self._lock, contextlib.suppress(ValueError):
            self._open.remove(request)
        super().shutdown_request(request)

    def handle_error(self, *_: Any) -> None:
        """Ignore broken connections: they concern only the client."""


def _read_to_its_end(connection: socket.socket) -> None:
    """Signal that the answer is complete, then read and discard further input for at most HTTP_LINGER_S.

    Closing with bytes unread resets the connection, and the client loses an answer that it has not read, such
    as the refusal of a body that is too large.
    """
    until = time.monotonic() + tuned.HTTP_LINGER_S
    connection.shutdown(socket.SHUT_WR)
    while (left := until - time.monotonic()) > 0:
        connection.settimeout(left)
        if not connection.recv(2**16):
            return


def _guarded(inner: Any, door: HttpDoor) -> Any:
    """``inner`` behind the access rules of ``door``; the environment holds the admitted caller under ``CALLER``."""

    def application(environ: dict[str, Any], start_response: Any) -> Any:
        try:
            door.check_origin(environ.get("HTTP_HOST"), environ.get("HTTP_ORIGIN"))
            environ[CALLER] = door.caller(environ.get("HTTP_AUTHORIZATION"))
        except HttpRefused as error:
            challenge = [("WWW-Authenticate", 'Basic realm="freshfield"')] if error.status == 401 else []
            start_response(f"{error.status} Refused", [("Content-Type", "text/plain"), *challenge])
            return [f"{error}\n".encode()]
        return inner(environ, start_response)

    return application


def serve_guarded(
    application: Any, what: str, host: str, port: int, transport: Transport | None = None
) -> tuple[int, Callable[[], None]]:
    """Serve a WSGI application on a thread; returns its port and a function that closes it.

    what: the application's name for messages.
    port: 0 takes a free one.
    transport: security; None: ``Transport()``.
    Raises TransportError if ``port`` is no port or would be open to others (see ``Transport.guard``), OSError
    if it is not available.
    """
    if not 0 <= port <= 65535:
        raise TransportError(f"{what}: {port} is not a port; give one from 1 to 65535, or 0 for a free one")
    transport = transport or Transport()
    if words := transport.guard(host, what, http=True):
        log.warning("--insecure: %s", words)
    door, tls = HttpDoor(transport.access, host), transport.tls(host)
    server = _Server(host.strip("[]"), port)
    server.set_app(_guarded(application, door))
    if tls is not None:  # a connection's own thread does the handshake
        server.socket = tls.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
    threading.Thread(target=server.serve_forever, name=what, daemon=True).start()

    def close() -> None:
        server.shutdown()
        server.server_close()

    return server.server_port, close
