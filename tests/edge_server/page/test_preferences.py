"""The preference page: a whole session in Chromium, and what the server refuses."""

import json
import socket
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest

from edge_server.live import live_constants as tuned
from edge_server.page import PageError
from edge_server.page.page_constants import MAX_ANSWER_BYTES
from edge_server.page.preferences import PreferencePage
from edge_server.viewpoints.preference_session import PreferenceSession
from freshfield.transport import Transport, TransportError
from tests.edge_server.page.browser import Browser
from tests.edge_server.page.visitor import ask
from tests.support import refused

COUNT, FRAMES, COLUMNS = 6, 6, 3
NEW = PreferenceSession(
    "tile", tuple((k, k + 1) for k in range(COUNT)), np.random.default_rng(0).normal(size=(COUNT, 3)), wanted=9
)


def sprite(k):
    """Of reconstruction k: its gray level says which it is."""
    return cv2.imencode(".jpg", np.full((96, 144, 3), 30 * k + 40, np.uint8))[1].tobytes()


@pytest.fixture
def asked():
    """(page, its address, the sessions that it kept)."""
    kept = []
    page = PreferencePage(NEW, [sprite(k) for k in range(COUNT)], FRAMES, COLUMNS, kept.append)
    url, close = page.serve("127.0.0.1", 0)
    yield page, url, kept
    close()


def request(url, method, path, body=None, **headers):
    return ask(int(url.rpartition(":")[2]), path, method, body, **headers)


def state(url):
    return json.loads(request(url, "GET", "/state")[2])


def level(jpeg):
    return round((int(cv2.imdecode(np.frombuffer(jpeg, np.uint8), 0)[5, 5]) - 40) / 30)


PLAIN = {"turn", "answered", "wanted", "open", "agreed", "repeated", "says", "finished", "plan", "frames", "columns"}


def test_the_page_is_blind(asked):
    """Neither addresses nor state say which reconstructions are shown, or that a pair is a repeated one."""
    _, url, _ = asked
    turns = set()
    for _ in range(9):
        now = state(url)
        assert set(now) == {*PLAIN, "may_change"} and now["plan"] is None
        turns.add(now["turn"])
        request(url, "POST", "/answer", {"turn": now["turn"], "choice": "left"})
    assert len(turns) == 9 and not state(url)["open"] and state(url)["repeated"] == 1


def test_answers_are_of_the_pair_that_was_shown_written_and_nothing_is_answered_twice(asked):
    page, url, kept = asked
    keep, page._keep = page._keep, MagicMock(side_effect=OSError(28, "No space left on device"))
    turn = state(url)["turn"]
    status, _, text = request(url, "POST", "/answer", {"turn": turn, "choice": "left"})
    assert status == 507 and b"No space left" in text and state(url)["answered"] == 0
    page._keep = keep
    shown = [level(request(url, "GET", f"/{side}/{turn}.jpg")[2]) for side in ("left", "right")]
    assert request(url, "POST", "/answer", {"turn": turn, "choice": "right"})[0] == 200
    (given,) = page.session.answers
    assert [given.left, given.right] == shown and given.choice == "right" and kept == [page.session]
    assert request(url, "POST", "/answer", {"turn": turn, "choice": "right"})[0] == 409
    assert request(url, "POST", "/undo", {"turn": turn})[0] == 409
    assert request(url, "GET", f"/left/{turn}.jpg")[0] == 404 and len(kept) == 1


@pytest.mark.parametrize(
    ("body", "status"),
    [(b"[1]", 400), ({"choice": "left"}, 409), (b"x" * 16 * MAX_ANSWER_BYTES, 413), (b"[" * MAX_ANSWER_BYTES, 400)],
)
def test_bad_requests_change_nothing(asked, body, status):
    _, url, kept = asked
    assert request(url, "POST", "/answer", {"choice": "left"}, Origin="http://evil.example")[0] == 403
    assert request(url, "GET", "/state", Host="evil.example:80")[0] == 403
    policy = request(url, "GET", "/")[1]["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in policy and "default-src 'none'" in policy
    found, _, text = request(url, "POST", "/answer", body)
    assert found == status and len(text.splitlines()) == 1 and not kept
    turn = state(url)["turn"]
    assert request(url, "POST", "/answer", {"turn": turn, "choice": "both"})[0] == 404 and not kept
    assert request(url, "POST", "/answer", b"{}", **{"Content-Length": "two"})[0] == 413


def test_who_sends_without_end_is_cut_off(asked, monkeypatch):
    monkeypatch.setattr(tuned, "HTTP_LINGER_S", 0.2)
    host, port = asked[1].removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=10) as endless, pytest.raises(ConnectionError):
        endless.sendall(b"POST /answer HTTP/1.1\r\nContent-Length: 999999999\r\n\r\n")
        while True:
            endless.sendall(bytes(2**16))


def test_viewers_look_and_operators_answer():
    tokens = Transport(tokens={"operator": "op-token", "viewer": "view-token"})
    page = PreferencePage(NEW, [sprite(k) for k in range(COUNT)], FRAMES, COLUMNS, lambda s: None)
    refused(TransportError, "nothing is encrypted", page.serve, "0.0.0.0", 0, tokens)
    url, close = page.serve("0.0.0.0", 0, Transport(tokens=tokens.tokens, insecure=True))
    try:
        assert request(url, "GET", "/state")[0] == 401
        body = {"turn": page._turn, "choice": "left"}
        for token, may in (("view-token", False), ("op-token", True)):
            login = {"Authorization": f"Bearer {token}"}
            assert json.loads(request(url, "GET", "/state", **login)[2])["may_change"] == may
            assert request(url, "POST", "/answer", body, **login)[0] == (200 if may else 403)
        refused(PageError, "--page-port", page.serve, "0.0.0.0", int(url.rpartition(":")[2]), Transport(insecure=True))
    finally:
        close()


def press(browser, key, code):
    for kind in ("keyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)


def swipe(browser, dx):
    box = browser.evaluate(
        "(({x, y, width, height}) => [x + width / 2, y + height / 2])"
        "(document.getElementById('pair').getBoundingClientRect())"
    )
    for kind, share in (("touchStart", 0), ("touchMove", 0.5), ("touchMove", 1)):
        point = {"x": box[0] + share * dx, "y": box[1]}
        browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=[point])
    browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


def gray(browser):
    """Reconstructions that the two canvases show."""
    return browser.evaluate(
        "['leftView', 'rightView'].map(id => {const c = document.getElementById(id);"
        "return Math.round((c.getContext('2d').getImageData(5, 5, 1, 1).data[0] - 40) / 30)})"
    )


@pytest.mark.browser
def test_a_whole_session_by_keys_and_touch(asked):
    page, url, _ = asked
    with Browser(url, 360, 740) as browser:  # a phone

        def ready(answered):
            browser.wait_for_text(f"{answered} of 9 answered")
            browser.wait_for(lambda: not browser.evaluate("document.getElementById('left').disabled"), "a pair")
            asked = page.session.question
            assert gray(browser) == [asked.left, asked.right]

        browser.call("Emulation.setTouchEmulationEnabled", enabled=True)
        ready(0)
        assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert browser.evaluate("document.querySelector('#right').getBoundingClientRect().bottom <= innerHeight")
        assert browser.evaluate("[...document.querySelectorAll('button')].every(b => b.offsetHeight >= 44)")
        moving = "document.getElementById('place').value"
        was = browser.evaluate(moving)
        browser.wait_for(lambda: browser.evaluate(moving) != was, "the movement of the viewpoint")
        press(browser, "ArrowLeft", 37)
        ready(1)
        press(browser, "ArrowDown", 40)
        ready(2)
        swipe(browser, 90)
        ready(3)
        assert [a.choice for a in page.session.answers] == ["left", "neither", "right"]
        browser.click_text("Undo")
        ready(2)
        # Who wants less motion moves the viewpoint by hand.
        for less in ("reduce", ""):
            browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": less}])
            browser.call("Page.reload")
            ready(2)
            assert ("Play" in browser.text()) == bool(less)
        # A second tab answered: this one shows the next pair by itself.
        request(url, "POST", "/answer", {"turn": page._turn, "choice": "right"})
        ready(3)
        for k in range(4, 9):
            press(browser, "ArrowRight", 39)
            ready(k)
        assert "repeated pairs answered alike: 0 of 1" in browser.text()  # always right, sides swapped
        press(browser, "ArrowRight", 39)
        browser.wait_for_text("All questions are answered")
        browser.click_text("Finish and plan")
        browser.wait_for_text("Finished")
        assert page.finished.is_set() and len(page.session.answers) == 9 and browser.errors == []
        page.show_plan(["candidate 3: the nearest"], cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes())
        browser.wait_for_text("candidate 3: the nearest")
        assert page.seen.wait(5.0) and "Where to look" in browser.text()
        assert all(address.startswith(url) for address in browser.requests)
