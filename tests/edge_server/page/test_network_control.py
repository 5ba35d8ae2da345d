"""The visitor changes the network: from the page to an emulator that runs."""

import asyncio
import contextlib
from unittest.mock import MagicMock

import pytest

from edge_server.page import start_page
from edge_server.page.network_control import EmulatorControl, NetworkControl
from edge_server.page.page_constants import MAX_SLIDER_DELAY_MS
from freshfield.transport import Transport
from tests.channel_emu.live.emulator import emulate
from tests.edge_server.page.preview import bare_state
from tests.edge_server.page.test_access_guard import control
from tests.edge_server.page.visitor import Visitor
from tests.support import free_port, wait_until


async def test_a_visitor_changes_the_network_and_gives_it_back(tmp_path):
    async with emulate(tmp_path, {}, cameras=("cam00",)) as emulation:

        def changes() -> list[tuple]:
            return [(change["delay_ms"], change["loss"]) for change in emulation.proxy._snapshot()["changes"]]

        def visit() -> None:
            page = start_page(bare_state(), "127.0.0.1", 0, emulator=f"127.0.0.1:{emulation.proxy.port}")
            with contextlib.closing(Visitor(page.port)) as visitor:
                visitor.wait_for(lambda: page._server.get_clients(), "the visit")
                for label, value in (("network", "blackout"), ("delay, ms", 1000), ("network", "scenario")):
                    before = len(changes())
                    visitor.send("GuiUpdateMessage", uuid=control(page, label)._impl.uuid, updates={"value": value})
                    wait_until(lambda: len(changes()) > before, label)  # noqa: B023
            page.stop()

        await asyncio.to_thread(visit)
        assert changes() == [(0.0, 1.0), (1000.0, 1.0), (None, None)]
    (tmp_path / "channel.json").write_text('{"changes": [{"at_ns": 5, "delay_ms": 0.0, "loss": 1.0}]}')  # it is killed
    async with emulate(tmp_path, {}, cameras=("cam00",)) as emulation:
        assert changes() == [(0.0, 1.0), (None, None)]


def control_of(network: EmulatorControl) -> NetworkControl:
    gui = MagicMock()
    gui.add_slider.side_effect = lambda *words, **more: MagicMock(value=0)
    return NetworkControl(gui, network)


def test_what_the_emulator_does_not_answer_is_told_to_its_visitor():
    network, client = EmulatorControl(Transport(), f"127.0.0.1:{free_port()}"), MagicMock()
    control_of(network)._set(client, (400.0, 0.2))
    title, words = client.add_notification.call_args.args
    assert title == "The network has not changed" and "UNAVAILABLE" in words and network.in_force is None


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
