"""A visitor without a browser: speaks the viewer's wire protocol, counts what the page sends."""

import contextlib
import http.client
import json
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import msgspec
import numpy as np
import viser
import websocket
import zstandard

from edge_server.live.state import EdgeState
from edge_server.page import Page, start_page
from freshfield.transport import Transport
from tests.support import wait_until

CAMERA = {"type": "ViewerCameraMessage", "wxyz": [1.0, 0, 0, 0], "position": [0.0, 0, 1], "fov": 0.9, "near": 0.01}
CAMERA |= {"far": 1e3, "image_height": 600, "image_width": 800, "look_at": [0.0] * 3, "up_direction": [0.0, 0, 1]}


@contextlib.contextmanager
def page_of(state: EdgeState, transport: Transport | None = None, host: str = "127.0.0.1") -> Iterator[Page]:
    """The page of a state, while it is needed."""
    page = start_page(state, host, 0, transport)
    try:
        yield page
    finally:
        page.stop()


def ask(port: int, path: str = "/", method: str = "GET", body: Any = None, **headers: str) -> tuple[int, dict, bytes]:
    """Status, headers and text of an answer. body: bytes, or what becomes JSON."""
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10)) as connection:
        sent = body if body is None or isinstance(body, bytes) else json.dumps(body)
        connection.request(method, path, sent, headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()


class Visitor(contextlib.AbstractContextManager):
    """Connects, with more ``headers``, and looks at the origin; reads in a thread unless ``reads`` is False.
    ``counts``: messages by type; ``images``: number of renderings; ``image``: the last one, encoded."""

    def __init__(self, port: int, reads: bool = True, headers: Mapping[str, str] | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self.images = 0
        self.image: bytes | None = None
        self._closing = False
        self._socket = websocket.create_connection(
            f"ws://127.0.0.1:{port}",
            subprotocols=[f"viser-v{viser.__version__}"],
            timeout=20,
            header=dict(headers or {}),
            sockopt=() if reads else ((socket.SOL_SOCKET, socket.SO_RCVBUF, 4096),),
        )
        self.stand_at((4.0, 0.0, 3.0))
        self._thread = threading.Thread(target=self._read, daemon=True)
        if reads:
            self._thread.start()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self._closing = True
        self._socket.close()
        if self._thread.ident is not None:
            self._thread.join(timeout=5)

    def stand_at(self, position: tuple[float, float, float]) -> None:
        """Tell the page where this visitor is now."""
        p = np.asarray(position, float)
        forward = -p / np.linalg.norm(p)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward], axis=1)
        turn = viser.transforms.SO3.from_matrix(axes)
        self.send(**{**CAMERA, "wxyz": list(turn.wxyz), "position": list(p)})

    def send(self, type: str, **fields: Any) -> None:
        self._socket.send_binary(msgspec.msgpack.encode({**fields, "type": type}, enc_hook=float))

    def wait_for(self, wanted: Callable[[], bool], what: str, timeout_s: float = 30.0) -> None:
        wait_until(wanted, lambda: f"{what} did not happen; received {dict(self.counts)}", timeout_s)

    def _read(self) -> None:
        while not self._closing:
            try:
                data = self._socket.recv()
            except (OSError, websocket.WebSocketException):
                return
            if not isinstance(data, bytes) or len(data) < 16:
                return
            packed = int.from_bytes(data[8:16], "little")
            inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed])
            for message in msgspec.msgpack.decode(inner)["messages"]:
                if message["type"] == "BackgroundImageMessage":
                    self.image = message["rgb_data"]
                    self.images += self.image is not None
                self.counts[message["type"]] += 1
