"""Who gets to the page and to the metrics, what a visitor may send there, and what one can cost."""

import base64
import contextlib
import http.client
import socket
import ssl
import time
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import websocket

from edge_server.live.keys_command import make_keys
from edge_server.live.live_constants import MAX_SCRAPES
from edge_server.live.output import guarded_http
from edge_server.live.output.prometheus import serve_metrics
from edge_server.page import Page, access_guard, start_page
from edge_server.page.access_guard import AccessGuard
from edge_server.page.page_constants import MAX_VISITOR_MESSAGE_BYTES
from freshfield.access import HttpDoor
from freshfield.transport import Transport, TransportError
from tests.edge_server.page.preview import BallScene, bare_state, publication
from tests.edge_server.page.visitor import CAMERA, Visitor, ask, page_of
from tests.role_table import TOKENS, cells_of
from tests.support import free_port, refused, wait_until

# Without TLS the login is the same, and easier to talk to.
LOGIN = Transport(tokens=TOKENS, insecure=True)


def login(who: str) -> dict[str, str]:
    token = TOKENS.get(who, "no such token")
    return {"Authorization": "Basic " + base64.b64encode(f"me:{token}".encode()).decode()}


def control(page: Page, label: str):
    return next(h for h in page._server.gui._gui_input_handle_from_uuid.values() if h.label == label)


def press(visitor: Visitor, page: Page, button: str) -> None:
    visitor.send("GuiUpdateMessage", uuid=control(page, "field")._impl.uuid, updates={"value": button})


def guard_of(page: Page) -> AccessGuard:
    """Of a page with a visitor."""
    return next(iter(page._server._websock_server._live_connections.values()))._guard


def has_come(page: Page, visitor: Visitor, count: int = 1) -> AccessGuard:
    """The guard, once there are so many visitors."""
    visitor.wait_for(lambda: len(page._server.get_clients()) == count, "a visitor")
    return guard_of(page)


@pytest.mark.parametrize(("what", "who", "may"), [*cells_of("page: look"), *cells_of("metrics")])
def test_who_may_look(what: str, who: str, may: bool) -> None:
    port = free_port()
    serve_metrics(bare_state(), INGEST, "0.0.0.0", port, LOGIN)
    with pytest.raises(TransportError, match=rf"{port} \(Address already in use\); see --metrics-port"):
        serve_metrics(bare_state(), INGEST, "127.0.0.1", port)
    with page_of(bare_state(), LOGIN, "0.0.0.0") as page:
        for number, path in ((page.port, "/"), (port, "/metrics")):
            status, headers, _ = ask(number, path, **login(who))
            assert status == (200 if may else 401) and ask(number, path)[0] == 401
            assert may or headers["WWW-Authenticate"].startswith("Basic")
        assert ask(port, "/metrics", Authorization=f"Bearer {TOKENS.get(who)}")[0] == (200 if may else 401)
        with pytest.raises(websocket.WebSocketBadStatusException) if not may else contextlib.nullcontext():
            Visitor(page.port, headers=login(who)).close()


@pytest.mark.parametrize(("what", "who", "may"), cells_of("page: change"))
def test_who_may_change(what: str, who: str, may: bool) -> None:
    state = bare_state()
    with page_of(state, LOGIN, "0.0.0.0") as page:
        if ask(page.port, **login(who))[0] == 401:
            assert not may
            return
        with Visitor(page.port, headers=login(who)) as visitor:
            has_come(page, visitor)
            press(visitor, page, "pause")
            if may:
                visitor.wait_for(lambda: state.controls.paused, "the pause")
            else:
                visitor.wait_for(lambda: visitor.counts["NotificationShowMessage"], "a word about it")
    assert state.controls.paused == may


def test_who_may_only_look_chooses_what_they_see_for_themselves_alone() -> None:
    state = bare_state()
    state.publish(publication(0), BallScene(0.0))
    with page_of(state, LOGIN, "0.0.0.0") as page, contextlib.ExitStack() as opened:
        visitor, other = (opened.enter_context(Visitor(page.port, headers=login("viewer"))) for _ in range(2))
        visitor.wait_for(lambda: len(guard_of(page).looks) == 2 and other.images and visitor.images, "the picture")
        mine, theirs = (guard_of(page).looks[number] for number in sorted(guard_of(page).looks))
        (choice,), at = mine, visitor.images
        visitor.send("GuiUpdateMessage", uuid=choice, updates={"value": "no such view"})
        visitor.send("GuiUpdateMessage", uuid=choice, updates={"value": "depth"})
        visitor.wait_for(lambda: visitor.images > at, "an image of depth")
        assert guard_of(page).refused == {"a value that no control takes": 1}
        assert [each.view for each in page._renders._visitors.values()] == ["depth", "picture"]
        assert [handle.value for handle in (*mine.values(), *theirs.values())] == ["depth", "picture"]
        visitor.close()
        other.wait_for(lambda: len(guard_of(page).looks) == 1, "the end of what the other had")


POINTS = np.random.default_rng(0).random((300_000, 3), np.float32)  # 4.5 MB to send
INGEST = SimpleNamespace(rejected={}, depth={}, buffer=SimpleNamespace(shed=0), check_ms=deque())


def test_a_login_lasts_for_the_websocket_and_is_nobody_elses() -> None:
    """Browsers do not all send the login again with a websocket."""
    with page_of(bare_state(), LOGIN, "0.0.0.0") as page:
        _, headers, _ = ask(page.port, **login("viewer"))
        cookie, *flags = headers["Set-Cookie"].split("; ")
        assert {"HttpOnly", "SameSite=Strict"} <= set(flags)
        assert ask(page.port, Cookie=f"other=1; {cookie}")[0] == 200
        assert ask(page.port, Cookie=cookie[:-1] + "0é")[0] == 401
        assert ask(page.port, Cookie=cookie, **login("nobody"))[0] == 401
        Visitor(page.port, headers={"Cookie": cookie}).close()


def tls_of(folder: Path) -> dict[str, Path]:
    make_keys(folder / "keys", [], ["edge"], [])
    return {part: folder / "keys" / "edge" / f"{part}.pem" for part in ("cert", "key")}


def test_tls_and_login_or_words_or_no_page(tmp_path, caplog, monkeypatch) -> None:
    monkeypatch.setattr(access_guard, "TLS_HANDSHAKE_TIMEOUT_S", 1.0)
    files = tls_of(tmp_path)
    for half in (Transport(tokens=TOKENS), Transport(**files)):
        refused(TransportError, "--insecure", start_page, bare_state(), "0.0.0.0", 0, half)
        refused(TransportError, "--insecure", serve_metrics, bare_state(), INGEST, "0.0.0.0", 0, half)
    port = free_port()
    serve_metrics(bare_state(), INGEST, "0.0.0.0", port, Transport(**files, tokens=TOKENS))
    with page_of(bare_state(), Transport(**files, tokens=TOKENS), "0.0.0.0") as page:
        assert page.url.startswith("https://localhost:")
        context = ssl.create_default_context(cafile=tmp_path / "keys" / "edge" / "ca.pem")
        context.verify_flags |= ssl.VERIFY_X509_STRICT  # the default from Python 3.13 on
        for number, path in ((page.port, "/"), (port, "/metrics")):
            connection = http.client.HTTPSConnection("localhost", number, timeout=10, context=context)
            connection.request("GET", path, headers=login("viewer"))
            answer = connection.getresponse()
            assert answer.status == 200 and answer.read()
            assert path != "/" or "Secure" in answer.getheader("Set-Cookie")
            with pytest.raises((OSError, http.client.HTTPException)):
                ask(number, path)
        with socket.create_connection(("127.0.0.1", page.port), timeout=4.0) as silent:  # no handshake
            assert silent.recv(1) == b""
    assert "--insecure" not in caplog.text


def test_the_page_says_in_words_what_is_open() -> None:
    state = bare_state()
    state.warnings = [Transport(insecure=True).guard("0.0.0.0", "page", http=True)]
    with page_of(state, Transport(insecure=True), "0.0.0.0") as page:
        assert ask(page.port)[0] == 200  # without a login
        messages = page._server._websock_server._broadcast_buffer.message_from_id.values()
        texts = [m.props.content for m in messages if type(m).__name__ == "GuiHtmlMessage"]
    assert any("Insecure: page on 0.0.0.0" in text and "callers are not authenticated" in text for text in texts)


def test_a_foreign_web_site_reaches_nothing() -> None:
    """Which names and origins are foreign: ``test_access``."""
    with page_of(bare_state()) as page:
        own, foreign = f"127.0.0.1:{page.port}", f"evil.example:{page.port}"
        assert ask(page.port, Origin=f"http://{own}")[0] == 200
        assert ask(page.port, Origin="http://evil.example")[0] == 403
        assert ask(page.port, Host=foreign)[0] == 403
        assert "frame-ancestors 'self'" in ask(page.port)[1]["Content-Security-Policy"]
        with pytest.raises(websocket.WebSocketBadStatusException):
            Visitor(page.port, headers={"Host": foreign})
        with pytest.raises(websocket.WebSocketBadStatusException):
            websocket.create_connection(f"ws://{own}", origin="http://evil.example", timeout=10)


def test_a_flood_of_refused_requests_and_visitors_is_counted_and_said_once_a_minute(caplog, monkeypatch) -> None:
    caplog.set_level("INFO")
    now_s = [0.0]
    monkeypatch.setattr(access_guard, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    monkeypatch.setattr(access_guard, "MAX_VISITORS", 1)
    login_of = login("viewer")

    def refused(guard: AccessGuard) -> dict[str, int]:
        kinds = ("status", "visitors", "GET")
        return {what: count for what, count in guard.refused.items() if any(kind in what for kind in kinds)}

    with page_of(bare_state(), LOGIN, "0.0.0.0") as page, Visitor(page.port, headers=login_of) as visitor:
        guard = has_come(page, visitor)
        for _ in range(10):
            assert ask(page.port)[0] == 401
            assert ask(page.port, Origin="http://evil.example", **login("viewer"))[0] == 403
            with pytest.raises(websocket.WebSocketBadStatusException, match="503"):
                Visitor(page.port, headers=login_of)
            with socket.create_connection(("127.0.0.1", page.port), timeout=10) as raw:
                raw.sendall(b"\x00\xff\r\nHost: 127.0.0.1\r\n\r\n")
                with contextlib.suppress(ConnectionResetError):
                    assert not raw.recv(100)
        expected = {"requests with status 401": 10, "requests with status 403": 10, "visitors beyond 1": 10}
        expected["a request that is not an HTTP/1.1 GET"] = 10
        wait_until(lambda: refused(guard) == expected, lambda: str(guard.refused))
        # The first says what is open.
        said = [r.getMessage() for r in caplog.records if r.name.startswith(("edge_server", "websockets"))]
        assert said[1:] == [f"page: refused: {what} (1 so far)" for what in expected]
        for now_s[0], messages in ((59.9, []), (60.0, ["page: refused: requests with status 401 (12 so far)"])):
            caplog.clear()
            assert ask(page.port)[0] == 401
            assert [text for text in caplog.messages if "401" in text] == messages
        visitor.close()
        wait_until(lambda: not guard.visitors, "the place was kept")
        Visitor(page.port, headers=login_of).close()


def test_a_visitor_sets_values_of_controls_and_nothing_else() -> None:
    state = bare_state()
    state.policies, state.set_policy = ("all", "threshold"), lambda name, _: setattr(state.controls, "policy", name)
    with page_of(state) as page, Visitor(page.port) as visitor, Visitor(page.port) as other:
        has_come(page, other, 2)
        time.sleep(0.7)  # a refresh
        handles = {label: control(page, label) for label in ("field", "policy", "value")}
        before = {label: (h.value, h.disabled) for label, h in handles.items()}
        told = other.counts["GuiUpdateMessage"]
        not_values = [{"visible": False}, {"disabled": True}, {"value": "pause", "visible": False}, {}]
        odd = [("field", "format the disk"), ("policy", "<script>"), ("policy", ["all"]), ("value", float("nan"))]
        sent = [("field", each) for each in not_values] + [(label, {"value": value}) for label, value in odd]
        for label, updates in sent:
            visitor.send("GuiUpdateMessage", uuid=handles[label]._impl.uuid, updates=updates)
            time.sleep(0.06)
        visitor.send("GuiUpdateMessage", uuid="another", updates={"value": True})
        visitor.send("GuiRemoveMessage", uuid=handles["field"]._impl.uuid)
        visitor._socket.send("text")
        visitor._socket.send_binary(b"\xdd" * 60_000)  # arrays in arrays
        visitor.send("GuiUpdateMessage", uuid=handles["policy"]._impl.uuid, updates={"value": "threshold"})
        visitor.wait_for(lambda: state.controls.policy == "threshold", "what a control offers")
        after = {label: (h.value, h.disabled) for label, h in handles.items()}
        assert after == before | {"policy": ("threshold", False)} and not state.controls.paused
        assert sum(guard_of(page).refused.values()) == 12
        other.wait_for(lambda: other.counts["GuiUpdateMessage"] > told, "the one change")
        assert not other.counts["GuiRemoveMessage"]
        for _ in range(500):  # clicks come no faster than a person's
            press(visitor, page, "snapshot")
        visitor.wait_for(lambda: sum(guard_of(page).refused.values()) > 412, "refusals")
        assert visitor.counts["NotificationShowMessage"] < 100


NOBODYS = [{"image_width": 10**9}, {"image_height": 0}, {"fov": 4.0}, {"wxyz": [0.0, 0, 0, 0]}]
NOBODYS += [{"position": [float("nan"), 0, 0]}, {"type": "RunJavascriptMessage", "source": "x"}]


# A later viser may add fields.
@pytest.mark.parametrize(("change", "taken"), [({}, True), ({"zoom": 2}, True), *((each, False) for each in NOBODYS)])
def test_viewpoints_that_nobody_can_have_are_not_taken(change: dict, taken: bool) -> None:
    guard = AccessGuard(HttpDoor(Transport().access, "127.0.0.1"), None)
    assert guard.takes(None, msgspec.msgpack.encode(CAMERA | change)) == taken
    assert guard.refused.total() == (not taken)


def test_nothing_is_uploaded() -> None:
    with page_of(bare_state()) as page, Visitor(page.port) as visitor:
        at = has_come(page, visitor)
        upload = {"source_component_uuid": control(page, "field")._impl.uuid, "transfer_uuid": "t"}
        file = {"filename": "f", "mime_type": "x", "part_count": 2, "size_bytes": 3 * 10**8}
        visitor.send("FileTransferStartUpload", **upload, **file)
        visitor.send("FileTransferPart", **upload, part=0, content=bytes(1000))
        wait_until(lambda: sum(at.refused.values()) == 2, "they were not refused")
        assert not page._server.gui._current_file_upload_states
        with contextlib.suppress(OSError):
            visitor._socket.send_binary(bytes(MAX_VISITOR_MESSAGE_BYTES + 1))
        wait_until(lambda: not at.visitors, "too long a message did not end the visit")


def test_half_requests_end_for_new_ones(monkeypatch) -> None:
    monkeypatch.setattr(access_guard, "MAX_PAGE_CONNECTIONS", 8)
    with page_of(bare_state()) as page, Visitor(page.port) as visitor, contextlib.ExitStack() as open_:
        halves = [open_.enter_context(socket.create_connection(("127.0.0.1", page.port), 4.0)) for _ in range(30)]
        for half in halves:
            half.sendall(b"GET / HTTP/1.1\r\n")
        for oldest in halves[:-8]:  # by themselves they would end after ten seconds
            with contextlib.suppress(ConnectionError):
                assert oldest.recv(1) == b""
        assert ask(page.port)[0] == 200
        visitor.stand_at((1.0, 1.0, 1.0))  # who is in stays in


@pytest.mark.parametrize("what", ["page", "metrics"])
def test_unfinished_handshakes_are_few_and_shut_nobody_out(tmp_path, monkeypatch, what: str) -> None:
    monkeypatch.setattr(access_guard, "TLS_HANDSHAKE_TIMEOUT_S", 60.0)
    monkeypatch.setattr(guarded_http._Handler, "timeout", 60.0)
    monkeypatch.setattr(access_guard, "MAX_PAGE_CONNECTIONS", MAX_SCRAPES)
    transport, port = Transport(**tls_of(tmp_path), tokens=TOKENS), free_port()
    with page_of(bare_state(), transport, "0.0.0.0") as page, contextlib.ExitStack() as open_:
        serve_metrics(bare_state(), INGEST, "0.0.0.0", port, transport)
        at = ("127.0.0.1", page.port if what == "page" else port)
        silent = [open_.enter_context(socket.create_connection(at, timeout=10.0)) for _ in range(30)]
        for oldest in silent[:-MAX_SCRAPES]:
            assert oldest.recv(1) == b""
        with socket.create_connection(at, timeout=10.0) as new:
            ssl._create_unverified_context().wrap_socket(new).close()


def test_who_does_not_read_is_sent_away_and_what_was_held_with_them(monkeypatch) -> None:
    monkeypatch.setattr(access_guard, "VISITOR_TIMEOUT_S", 2.0)
    with page_of(bare_state()) as page, Visitor(page.port) as reader:
        has_come(page, reader)
        stuck, held = [Visitor(page.port, reads=False) for _ in range(3)], []
        at = has_come(page, reader, 4)
        for k in range(20):
            page._server.scene.add_point_cloud(f"/{k % 4}", POINTS, POINTS)
            time.sleep(0.05)
            held.append(sum(each.transport.get_write_buffer_size() for each in at.visitors))
        assert max(held) > 10**6, "the network held it all, and this test shows nothing"
        wait_until(lambda: len(at.visitors) == 1, "they stay", 20.0)
        count = reader.counts["GuiUpdateMessage"]
        reader.wait_for(lambda: reader.counts["GuiUpdateMessage"] > count, "who reads is served")
        for visitor in stuck:
            visitor.close()
