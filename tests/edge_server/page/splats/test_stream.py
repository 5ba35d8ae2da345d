"""The stream on the live page's port: what arrives, who gets it, and a browser that draws it."""

import asyncio
import base64
import json
import time
from contextlib import nullcontext
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
import websocket

from edge_server.page import Page, start_page
from edge_server.page.page_constants import MAX_VISITORS
from edge_server.page.splats.messages import StreamReader, read_saved
from edge_server.page.splats.stream import STREAM, SplatStream
from freshfield.transport import Transport
from tests.edge_server.fields.scenes import psnr
from tests.edge_server.page.browser import Browser
from tests.edge_server.page.preview import bare_state, publication
from tests.edge_server.page.splats.gaussians import BOX, LENS, NEWEST_S, ORIGIN_NS, POSE, gaussians, snapshot
from tests.edge_server.page.test_access_guard import login
from tests.edge_server.page.visitor import ask, page_of
from tests.role_table import TOKENS
from tests.support import wait_until


class Drawer:
    """A visitor who reads the stream and says so."""

    def __init__(self, page: Page, **headers: str) -> None:
        address = f"ws://127.0.0.1:{page.port}{STREAM}"
        self.socket = websocket.create_connection(address, timeout=20, header=headers)
        self.reader = StreamReader()

    def read(self, answer: bytes | None = None) -> None:
        """One message, and the answer to it, after another one if given."""
        data = self.socket.recv()
        self.reader.read(data)
        for each in (answer, data[:4]):
            if each is not None:
                self.socket.send(each, websocket.ABNF.OPCODE_BINARY)

    def read_until(self, wanted) -> None:
        wait_until(lambda: wanted() or self.read(), lambda: str(self.reader.status))


def test_a_visitor_gets_everything_then_what_changes():
    state = bare_state()
    with page_of(state) as page:
        drawer = Drawer(page)
        drawer.read()
        assert drawer.reader.scene is None and drawer.reader.status["scenario"] == state.scenario
        state.publish(publication(0), snapshot())
        drawer.read_until(lambda: len(drawer.reader.at(NEWEST_S)) == 820)
        assert drawer.reader.scene.radius_m == BOX.radius_m
        state.publish(publication(1), snapshot(gaussians(500, 7), movers=0))
        drawer.read_until(lambda: len(drawer.reader.at(NEWEST_S)) == 500)
        state.publish(publication(2), object())
        drawer.read_until(lambda: "does not consist of Gaussians" in drawer.reader.status.get("line", ""))
        drawer.socket.close()
        wait_until(lambda: not page._splats._connected, "the end of the visit")
        assert page._splats._thread.is_alive()


@pytest.mark.stability
def test_answers_that_are_none_are_counted_and_cost_nothing():
    state = bare_state()
    with page_of(state) as page:
        state.publish(publication(0), snapshot())
        drawer = Drawer(page)
        for answer in (b"", b"abc", b"abcde", bytes(60_000), b"\xff\xff\xff\xff"):
            drawer.read(answer)
        drawer.read_until(lambda: len(drawer.reader.at(NEWEST_S)) > 0)


@pytest.mark.stability
def test_who_acknowledges_without_reading_does_not_fill_the_memory():
    state = bare_state()
    with page_of(state) as page:
        drawer = Drawer(page)
        for number in range(400):  # all that may come
            drawer.socket.send(number.to_bytes(4, "little"), websocket.ABNF.OPCODE_BINARY)
        for number in range(60):
            state.publish(publication(number), snapshot(gaussians(6000, number % 5)))
            drawer.socket.send((number + 1).to_bytes(4, "little"), websocket.ABNF.OPCODE_BINARY)
            time.sleep(0.03)
        (connected,) = page._splats._connected
        assert connected.queue.qsize() <= 1
        drawer.socket.close()


def test_who_reads_slowly_holds_up_nobody():
    connected = [MagicMock(lock=nullcontext(), queue=asyncio.Queue()) for _ in range(3)]
    connected[1].queue.put_nowait(b"not yet read")
    SplatStream(bare_state(), lambda: None)._tick(connected)
    assert [each.visitor.message.called for each in connected] == [True, False, True]


def test_the_rules_of_the_page_hold_for_the_stream():
    state = bare_state()
    with page_of(state, Transport(tokens=TOKENS, insecure=True)) as page:
        state.publish(publication(0), snapshot())
        assert ask(page.port, "/splats/splats.js")[0] == 401
        status, headers, _ = ask(page.port, "/splats/", **login("viewer"))
        assert status == 200 and "script-src 'self'" in headers["Content-Security-Policy"]
        assert ask(page.port, "/splats", **login("viewer"))[0] == 301
        assert ask(page.port, "/splats/../records.py", **login("viewer"))[0] in (404, 400)
        with pytest.raises(websocket.WebSocketBadStatusException, match="401"):
            Drawer(page)
        drawer = Drawer(page, **login("viewer"))
        drawer.read_until(lambda: drawer.reader.scene is not None)
        visitors = [drawer] + [Drawer(page, **login("viewer")) for _ in range(MAX_VISITORS - 1)]
        with pytest.raises(websocket.WebSocketBadStatusException, match="503"):
            Drawer(page, **login("viewer"))
        for each in visitors:
            each.socket.close()


ARRIVED = "window.splats && splats.reader.moves && splats.reader.shown.total + splats.reader.moving.count"
# Draws at a fixed instant and returns the canvas.
DRAW = """
(() => {
  const { reader, renderer } = window.splats;
  const canvas = renderer.canvas;
  [canvas.width, canvas.height] = [%d, %d];
  renderer.draw(reader, %s, %f);
  return canvas.toDataURL("image/png");
})()
"""


def drawn(browser: Browser, instant_s: float, start_ns: int) -> np.ndarray:
    """What the browser draws from POSE, RGB float (H, W, 3). instant_s: of the motion. start_ns: of the run."""
    instant_s += (ORIGIN_NS - start_ns) / 1e9
    turn, eye = POSE[:3, :3].T, BOX.normalise(POSE[:3, 3])
    fov = 2 * np.arctan(0.5 * LENS.height / LENS.fy)
    camera = json.dumps({"turn": turn.ravel().tolist(), "eye": eye.tolist(), "fov": fov})
    data = browser.evaluate(DRAW % (LENS.width, LENS.height, camera, instant_s))
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.float32) / 255.0


def rendered(shown, instant_s: float) -> np.ndarray:
    return np.clip(shown.at(ORIGIN_NS + round(instant_s * 1e9)).render(POSE, LENS).color, 0, 1)


@pytest.mark.browser
def test_the_browser_draws_what_the_edge_renders():
    state, shown = bare_state(), snapshot()
    with page_of(state) as page, Browser(page.url + "/splats/?full", 640, 480) as browser:
        state.publish(publication(0), shown)
        browser.wait_for(lambda: browser.evaluate(ARRIVED) == 820, "all Gaussians")
        assert browser.evaluate("splats.renderer.format === splats.renderer.gl.RGBA32F")
        # Last in half floats, as with a GPU.
        for ahead_s, format_ in ((-0.2, "RGBA32F"), (0.12, "RGBA32F"), (0.9, "RGBA16F")):
            browser.evaluate(f"splats.renderer.format = splats.renderer.gl.{format_}; splats.renderer.targetSize = ''")
            assert psnr(drawn(browser, NEWEST_S + ahead_s, state.start_ns), rendered(shown, NEWEST_S + ahead_s)) > 50.0
        other = rendered(shown, NEWEST_S + 0.2)
        assert psnr(drawn(browser, NEWEST_S, state.start_ns), other) < 40.0, "the test can fail"
        # What no camera has seen is striped, darker.
        browser.evaluate("splats.reader.shown.unseen = new Uint8Array(700).fill(1)")
        browser.evaluate("splats.reader.shown.changed = [0, 700]")
        seen, striped = rendered(shown, NEWEST_S), drawn(browser, NEWEST_S, state.start_ns)
        assert 15.0 < psnr(striped, seen) < 40.0 and striped.mean() < seen.mean()
        still = snapshot(gaussians(1300, 9), movers=0)
        state.publish(publication(1), still)
        browser.wait_for(lambda: browser.evaluate("splats.reader.shown.total") == 1300, "the new set")
        assert psnr(drawn(browser, NEWEST_S, state.start_ns), rendered(still, NEWEST_S)) > 50.0
        # A context that is lost, as when a graphics driver starts anew.
        browser.evaluate("window.lose = splats.renderer.gl.getExtension('WEBGL_lose_context'); lose.loseContext()")
        browser.wait_for(lambda: browser.evaluate("splats.renderer.gl.isContextLost()"), "the loss")
        browser.evaluate("lose.restoreContext()")
        browser.wait_for(lambda: not browser.evaluate("splats.renderer.gl.isContextLost()"), "its return")
        assert psnr(drawn(browser, NEWEST_S, state.start_ns), rendered(still, NEWEST_S)) > 50.0
        assert browser.errors == [] and all(f":{page.port}" in address for address in browser.requests)


@pytest.mark.browser
def test_a_stream_comes_back_when_it_broke_and_a_saved_one_is_played_without_the_edge():
    state, shown = bare_state(), snapshot()
    with Browser("about:blank", 640, 480) as browser:
        with page_of(state) as page:
            state.publish(publication(0), shown)
            browser.call("Page.navigate", url=page.url + "/splats/?full")
            browser.wait_for(lambda: browser.evaluate(ARRIVED) == 820, "all Gaussians")
            data = bytes(browser.evaluate("splats.savedFile().arrayBuffer().then((b) => [...new Uint8Array(b)])"))
        browser.wait_for_text("The connection broke")
        again = start_page(state, "127.0.0.1", page.port)
        state.publish(publication(1), snapshot(gaussians(900, 3), movers=0))
        browser.wait_for(lambda: browser.evaluate("splats.reader.shown.total") == 900, "the stream again")
        assert "broke" not in browser.text()
        again.stop()
        reader, times = StreamReader(), []
        for came_s, message in read_saved(data):
            reader.read(message)
            times.append(came_s)
        assert times == sorted(times) and times[0] == 0.0
        assert len(reader.at(NEWEST_S)) == 820
        assert len(list(read_saved(data[:-1]))) == len(times) - 1
        browser.evaluate(f"splats.open(new File([Uint8Array.from({list(data)})], 'room.ffsplats'))")
        browser.wait_for(lambda: browser.evaluate("splats.reader.shown.total") == 700, "the file's Gaussians")
        browser.wait_for(lambda: browser.evaluate("splats.reader.moving?.count") == 120, "what moves")
        assert psnr(drawn(browser, NEWEST_S, state.start_ns), rendered(shown, NEWEST_S)) > 50.0
        browser.evaluate("splats.open(new File(['nothing'], 'x.ffsplats'))")
        browser.wait_for_text("x.ffsplats holds no messages")
