"""Prometheus metrics of a running edge server, read from its state when scraped."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
from collections.abc import Iterator
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from edge_server.fidelity.scorer import fidelity_title
from edge_server.live.ingest import Ingest
from edge_server.live.state import EdgeState
from freshfield.access import HttpDoor, HttpRefused
from freshfield.limits import MAX_SCRAPES, SCRAPE_TIMEOUT_S
from freshfield.transport import Transport

log = logging.getLogger(__name__)


class EdgeCollector:
    """Turns the state into samples when it is scraped; nothing runs in between."""

    def __init__(self, state: EdgeState, ingest: Ingest) -> None:
        self._state = state
        self._ingest = ingest

    def collect(self) -> Iterator[Metric]:
        age = GaugeMetricFamily(
            "freshfield_camera_age_seconds", "age of the newest buffered frame", labels=["camera"]
        )
        delivered = CounterMetricFamily("freshfield_frames_delivered", "frames accepted", labels=["camera"])
        for camera in self._state.cameras():
            if camera.age_ms is not None:
                age.add_metric([camera.camera], camera.age_ms / 1e3)
            delivered.add_metric([camera.camera], camera.delivered)
        rejected = CounterMetricFamily("freshfield_frames_rejected", "frames refused", labels=["reason"])
        for reason, count in self._ingest.rejected.items():
            rejected.add_metric([reason], count)
        shed = self._ingest.buffer.shed
        yield from (age, delivered, rejected)
        yield CounterMetricFamily("freshfield_frames_shed", "frames left out for lack of time", value=shed)
        check = GaugeMetricFamily(
            "freshfield_check_seconds", "time to check and buffer a frame", labels=["quantile"]
        )
        for percent in (50, 99):
            value = self._ingest.check_ms.percentile(percent)
            if value is not None:
                check.add_metric([str(percent / 100)], value / 1e3)
        yield check
        last, scored = self._state.newest(), self._state.newest(scored=True)
        if last is None:
            return
        yield CounterMetricFamily("freshfield_updates", "updates published", value=last.number + 1)
        yield GaugeMetricFamily("freshfield_update_seconds", "last update", value=last.update_ms / 1e3)
        yield GaugeMetricFamily("freshfield_aaoi_seconds", "mean age of selection", value=last.aaoi_ms / 1e3)
        yield GaugeMetricFamily("freshfield_selected_views", "views used last", value=len(last.selected))
        about = fidelity_title([scored.scored_on if scored else None])
        for name in ("psnr_db", "psnr_moving_db", "ssim", "lpips", "perceptual"):
            if (value := getattr(scored, name, None)) is not None:
                yield GaugeMetricFamily(f"freshfield_{name}", about, value=value)


class _Handler(WSGIRequestHandler):
    timeout = SCRAPE_TIMEOUT_S  # of each read of the socket

    def log_message(self, *_: Any) -> None:
        """Scrapes are not worth a line."""


class _Server(ThreadingMixIn, WSGIServer):
    """A thread for each connection, of which there are at most MAX_SCRAPES: a new one ends the oldest."""

    daemon_threads = True

    def __init__(self, host: str, port: int) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._lock = threading.Lock()
        self._open: list[socket.socket] = []
        super().__init__((host, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            self._open.append(request)
            if len(self._open) > MAX_SCRAPES:
                with contextlib.suppress(OSError):  # its thread reads the end of the request
                    self._open.pop(0).shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock, contextlib.suppress(ValueError):
            self._open.remove(request)
        super().shutdown_request(request)

    def handle_error(self, *_: Any) -> None:
        """A connection that broke is the client's matter."""


def _guarded(metrics: Any, door: HttpDoor) -> Any:
    """The WSGI application for those who may look."""

    def application(environ: dict[str, Any], start_response: Any) -> Any:
        try:
            door.check_origin(environ.get("HTTP_HOST"), environ.get("HTTP_ORIGIN"))
            door.caller(environ.get("HTTP_AUTHORIZATION"))
        except HttpRefused as error:
            challenge = [("WWW-Authenticate", 'Basic realm="freshfield"')] if error.status == 401 else []
            start_response(f"{error.status} Refused", [("Content-Type", "text/plain"), *challenge])
            return [f"{error}\n".encode()]
        return metrics(environ, start_response)

    return application


def serve_metrics(
    state: EdgeState, ingest: Ingest, host: str, port: int, transport: Transport | None = None
) -> None:
    """Serve /metrics on a thread until the process ends. Raises TransportError if they would be open to
    others (see ``Transport.guard``)."""
    transport = transport or Transport()
    if words := transport.guard(host, "metrics", http=True):
        log.warning("--insecure: %s", words)
    door, tls = HttpDoor(transport.access, host), transport.tls(host)
    registry = CollectorRegistry()
    registry.register(EdgeCollector(state, ingest))  # type: ignore[arg-type]
    server = _Server(host.strip("[]"), port)
    server.set_app(_guarded(make_wsgi_app(registry), door))
    if tls is not None:  # a connection's own thread does the handshake
        server.socket = tls.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
    threading.Thread(target=server.serve_forever, name="metrics", daemon=True).start()
