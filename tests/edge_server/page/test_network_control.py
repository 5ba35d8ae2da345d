"""The visitor changes the network: through the page in a browser, and the emulator's own process."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from dataclasses import replace
from unittest.mock import MagicMock, patch

import pytest

from edge_server.page import start_page
from edge_server.page.network_control import EmulatorControl, NetworkControl
from edge_server.page.settings import MAX_SLIDER_DELAY_MS
from freshfield.files import ReplacedJson
from freshfield.transport import Transport
from tests.edge_server.page.browser import Browser
from tests.edge_server.page.preview import Preview
from tests.support import free_port, wait_until


@pytest.mark.browser
def test_a_visitor_changes_the_network_and_gives_it_back(tmp_path):
    address, status = f"127.0.0.1:{free_port()}", ReplacedJson(tmp_path / "channel.json")
    command = [sys.executable, "-m", "channel_emu.cli", "run", "card", "--listen", address, "--out", str(tmp_path)]
    emulator = subprocess.Popen([*command, "--to", "127.0.0.1:1"], stderr=subprocess.DEVNULL)
    preview = Preview()
    preview.state = replace(preview.state, channel=status.read)
    page = start_page(preview.state, "127.0.0.1", 0, emulator=address)
    preview.start()
    try:
        with Browser(page.url, timeout_s=60.0) as browser:
            browser.wait_for_text("The network is the scenario's.")
            wait_until(lambda: status.read() is not None, "no status")
            browser.close_notices()
            browser.click_text("blackout")
            browser.wait_for_text("The network is blackout: mean delay 0 ms, 100 % of the frames lost.")
            browser.wait_for_text("2 set by hand")  # a state of the channel's chart
            track = "document.querySelector('.mantine-Slider-track').getBoundingClientRect()"
            x, y = browser.evaluate(f"(r => [r.x + r.width / 2, r.y + r.height / 2])({track})")
            browser.click(x, y)
            browser.wait_for_text("The network is set by hand: mean delay 1")
            browser.click_text("scenario")
            browser.wait_for_text("The network is the scenario's.")
    finally:
        page.stop()
        preview.stop()
        emulator.terminate()
        emulator.wait(10)
    changes = json.loads((tmp_path / "channel.json").read_text())["changes"]
    assert [c["loss"] for c in changes] == [1.0, 1.0, None] and changes[0]["delay_ms"] == 0.0
    assert 800.0 <= changes[1]["delay_ms"] <= 1200.0 and changes[2]["delay_ms"] is None


def control_of(network: EmulatorControl) -> NetworkControl:
    gui = MagicMock()
    gui.add_slider.side_effect = lambda *words, **more: MagicMock(value=0)
    return NetworkControl(gui, network)


def test_what_the_emulator_does_not_answer_is_told_to_its_visitor():
    network, client = EmulatorControl(Transport(), f"127.0.0.1:{free_port()}"), MagicMock()
    control_of(network)._set(client, (400.0, 0.2))
    title, words = client.add_notification.call_args.args
    assert title == "The network has not changed" and "UNAVAILABLE" in words and network.in_force is None


def test_a_slider_that_is_moved_right_after_a_button_keeps_nothing_of_the_blackout_before():
    control = control_of(EmulatorControl(Transport(), "x:1"))
    control.refresh({"by_hand": {"delay_ms": 0.0, "loss": 1.0}})
    for button, values in (("bad", (400, 20)), ("blackout", (0, 100)), ("scenario", (0, 0))):
        with patch.object(control, "_set_after") as asked:
            asyncio.run(control._pressed(MagicMock(target=MagicMock(value=button))))
        assert (control.delay.value, control.loss.value) == values and asked.called


@pytest.mark.stability
@pytest.mark.parametrize("by_hand", [None, "x", {"delay_ms": None, "loss": 0.1}, {"delay_ms": "a", "loss": 1}])
def test_an_odd_status_file_is_survived(by_hand):
    control = control_of(EmulatorControl(Transport(), "x:1"))
    control.refresh({"by_hand": {"delay_ms": 9000.0, "loss": 0.5}})
    assert control.delay.value == MAX_SLIDER_DELAY_MS and control.loss.value == 50
    assert "set by hand: mean delay 9000 ms, 50 % of the frames lost" in control.words.content
    control.refresh({"by_hand": by_hand, "drawn_delay_ms": {"mean": 61.2}})
    assert "the scenario" in control.words.content and (control.delay.value, control.loss.value) == (61, 0)
    for odd in (None, {"mean": None}, {"mean": float("nan")}, "x"):
        control.refresh({"by_hand": None, "drawn_delay_ms": odd})
        assert control.delay.value == 0


def test_a_certificate_speaks_for_the_edge_and_not_a_token_of_its_visitors(tmp_path):
    tokens = {"operator": "secret"}
    assert EmulatorControl(Transport(tokens=tokens), "x:1")._metadata == (("authorization", "Bearer secret"),)
    certificate = Transport(cert=tmp_path / "c", key=tmp_path / "k", ca=tmp_path / "a", tokens=tokens)
    assert EmulatorControl(certificate, "x:1")._metadata == ()
