"""The live page: the field rendered for each visitor, the cameras, charts and controls.

``start_page`` serves it on one port from its own threads. It only reads what the loop published and renders
immutable snapshots, so the field never waits for a visitor.
"""

from __future__ import annotations

import logging
import socket
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import rich
import viser

from edge_server.live.state import EdgeState
from edge_server.page.access_guard import AccessGuard
from edge_server.page.controls import add_view_choice, notify
from edge_server.page.network_control import EmulatorControl
from edge_server.page.page_constants import REFRESH_S
from edge_server.page.page_thread import PageThread
from edge_server.page.panel import Panel
from edge_server.page.rendering import RenderLoop
from edge_server.page.scene import Scene
from edge_server.page.splats.stream import SplatStream
from edge_server.page.timelines import History
from freshfield.access import HttpDoor
from freshfield.transport import Transport

__all__ = ["Page", "PageError", "start_page"]

log = logging.getLogger(__name__)

BRAND: tuple[int, int, int] = (0, 150, 115)


class PageError(RuntimeError):
    """The page cannot be served; the message says why and what to do."""


@dataclass
class Page:
    """A page being served. url: its address on this machine (or through an SSH forward of the port)."""

    url: str
    port: int
    _server: viser.ViserServer
    _refresher: _Refresher
    _renders: RenderLoop
    _splats: SplatStream

    def stop(self) -> None:
        """Close the port and end the page's threads. May be called twice."""
        self._refresher.stop()
        self._renders.stop()
        self._splats.stop()
        _quietly(self._server.stop)


def start_page(
    state: EdgeState,
    host: str = "127.0.0.1",
    port: int = 8080,
    transport: Transport | None = None,
    emulator: str | None = None,
) -> Page:
    """Serve the page of ``state``. Port 0 takes a free one. emulator: HOST:PORT of the channel emulator, for visitors
    to change the network; None: they cannot. Raises PageError if the port is not available,
    TransportError if it would be open to others (see ``Transport.guard``)."""
    check_port(host, port)
    transport = transport or Transport()
    if words := transport.guard(host, "page", http=True):
        log.warning("--insecure: %s", words)
    tls = transport.tls(host)
    guard = AccessGuard(HttpDoor(transport.access, host), tls)
    with guard.before_viser():
        server: viser.ViserServer = _quietly(lambda: viser.ViserServer(host, port, verbose=False))
    if not guard.used:
        _quietly(server.stop)
        raise PageError("page: this version of viser listens in an unsupported way: the page would be unprotected")
    if port and server.get_port() != port:  # taken since the check: viser silently takes the next one
        _quietly(server.stop)
        raise PageError(_taken(host, port))
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, brand_color=BRAND, control_width="medium"
    )
    scene = Scene(server, state)
    renders = RenderLoop(state)
    panel = Panel(server, state, EmulatorControl(transport, emulator) if emulator is not None else None)
    refresher = _Refresher(server, state, scene, panel)

    async def joined(client: viser.ClientHandle) -> None:
        renders.add_client(client)
        add_view_choice(client, panel.view_order, renders)
        guard.looks[client.client_id] = client.gui._gui_input_handle_from_uuid

        async def moved(camera: Any) -> None:
            renders.camera_moved(client)
            panel.make_room(client)

        client.camera.on_update(moved)

    async def left(client: viser.ClientHandle) -> None:
        renders.remove_client(client)
        guard.looks.pop(client.client_id, None)
        scene.remove_client(client)

    server.on_client_connect(joined)
    server.on_client_disconnect(left)

    def on_refused(connection: Any) -> None:
        for number, each in list(server._websock_server._live_connections.items()):
            if each is connection:
                notify(server.get_clients().get(number), "Not done", "Your login is for viewing only.", bad=True)

    guard.controls, guard.on_refused = server.gui._gui_input_handle_from_uuid, on_refused
    splats = SplatStream(state, lambda: scene.viewpoint)
    guard.splats = splats.serve
    renders.start()
    refresher.start()
    splats.start()
    port = server.get_port()
    return Page(page_url(host, port, tls is not None), port, server, refresher, renders, splats)


class _Refresher(PageThread):
    """The thread that keeps scene, panel and history up to date, at a fixed low rate."""

    def __init__(self, server: viser.ViserServer, state: EdgeState, scene: Scene, panel: Panel) -> None:
        super().__init__("page", "refresh")
        self._server, self._state, self._scene, self._panel = server, state, scene, panel
        self._history = History()

    def _step(self) -> float:
        began, state = perf_counter(), self._state
        cameras = state.cameras()
        channel = state.channel() or None
        self._history.sample(state.now_s(), cameras, channel)
        watched = bool(self._server.get_clients())
        self._scene.refresh(cameras, watched)
        if watched:
            self._panel.refresh(cameras, self._history, state.publications(), channel)
        # A slow refresh (a busy machine) is followed by an equally long pause.
        spent = perf_counter() - began
        return max(REFRESH_S - spent, spent)


def page_url(host: str, port: int, tls: bool = False) -> str:
    """An address that a browser can open: localhost if the page listens on every interface."""
    if host in ("", "0.0.0.0", "::", "*"):
        host = "localhost"
    return f"http{'s' if tls else ''}://{f'[{host}]' if ':' in host else host}:{port}"


def check_port(host: str, port: int) -> None:
    """Raise PageError for a taken port or an address of another machine: viser would take the next port, or hang."""
    if not 0 <= port <= 65535:
        raise PageError(f"page: {port} is not a port; give one from 1 to 65535, or 0 for a free one")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise PageError(f"{_taken(host, port)} ({error.strerror or error})") from None


def _taken(host: str, port: int) -> str:
    return f"page: cannot listen on {host}:{port}; choose another port with --page-port"


def _quietly(action: Any) -> Any:
    """Call ``action`` without the banners that it prints through rich's global console."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        return action()
    finally:
        console.quiet = before
