"""The visitor's control of the network: four conditions, and sliders of delay and loss.

The edge is an operator of the channel emulator and makes requests on a visitor's behalf. A refusal becomes a
notification for that visitor.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from typing import Any

import grpc
import viser

from edge_server.page import page_constants as tuned
from edge_server.page.controls import notify
from edge_server.page.markup import html
from freshfield.transport import Transport, peer_text
from freshfield.v1 import channel_pb2, channel_pb2_grpc

log = logging.getLogger(__name__)

SCENARIO = "scenario"
Setting = tuple[float, float] | None
"""Mean delay (ms) and loss (0 to 1); None: the scenario's channel."""


class EmulatorControl:
    """Sets delay and loss of the emulator at ``address`` (HOST:PORT).

    transport: must make this process an operator there, see docs/how-to/tls.md.
    """

    def __init__(self, transport: Transport, address: str) -> None:
        self._transport, self._address = transport, address
        # A certificate identifies this process; the tokens of this server's visitors would be refused there.
        self._metadata = () if transport.cert is not None and transport.ca is not None else transport.metadata()
        self.in_force: Setting = None
        """The last setting made here."""

    def set(self, wanted: Setting) -> None:
        """Change the network. Raises RuntimeError with the emulator's refusal, or if it did not answer."""
        delay_ms, loss = wanted or (None, None)
        request = channel_pb2.SetChannelRequest(delay_ms=delay_ms, loss=loss)
        with self._transport.channel(self._address) as channel:
            ask = channel_pb2_grpc.ChannelServiceStub(channel).SetChannel
            try:
                ask(request, timeout=tuned.ANSWER_S, metadata=self._metadata)
            except grpc.RpcError as error:
                said = f"{error.code().name}: {peer_text(error.details())}"
                raise RuntimeError(f"the emulator at {self._address} refuses ({said})") from None
        self.in_force = wanted


class NetworkControl:
    """Inputs in the current GUI container, kept equal to the emulator's setting, which others may change too."""

    def __init__(self, gui: viser.GuiApi, network: EmulatorControl) -> None:
        self._network = network
        self._timer: threading.Timer | None = None
        self._refresh_after_s = 0.0
        self.buttons: Any = gui.add_button_group("network", (SCENARIO, *tuned.NETWORKS))
        self.delay: Any = gui.add_slider(
            "delay, ms", 0, tuned.MAX_SLIDER_DELAY_MS, tuned.SLIDER_STEP_MS, 0, hint="Mean delay of a frame."
        )
        self.loss: Any = gui.add_slider("loss, %", 0, 100, 1, 0, hint="Share of the frames that never arrive.")
        self.words: Any = gui.add_html("")
        self.buttons.on_click(self._pressed)
        for slider in (self.delay, self.loss):
            slider.on_update(self._moved)
        self.refresh(None)

    def refresh(self, status: dict[str, Any] | None) -> None:
        """Show the current setting. status: the emulator's; None if it runs on another machine."""
        if time.monotonic() < self._refresh_after_s:  # sliders stay where the visitor put them
            return
        in_force = self._network.in_force
        if status is not None and "by_hand" in status:
            try:
                in_force = float(status["by_hand"]["delay_ms"]), float(status["by_hand"]["loss"])
            except (KeyError, TypeError, ValueError):  # null: the scenario's; or a file of another version
                in_force = None
        self.words.content = html("note", f"The network is {describe(in_force)}.")
        # For the scenario's network, show what is known: moving one slider also sets the other one's value.
        self._place_sliders(*(in_force or (_drawn_ms(status), 0.0)))

    def _place_sliders(self, delay_ms: float, loss: float) -> None:
        values = round(min(delay_ms, tuned.MAX_SLIDER_DELAY_MS)), round(100.0 * loss)
        for slider, value in zip((self.delay, self.loss), values):
            if slider.value != value:
                slider.value = value

    # --- callbacks ------------------------------------------------------------------------------

    async def _pressed(self, event: Any) -> None:
        # A coroutine runs before the next click is handled, so the group still holds this click's value.
        wanted = tuned.NETWORKS.get(event.target.value)
        self._set_after(0.0, event.client, wanted)
        # At once: moving a slider now also sets the other one's value.
        self._place_sliders(*(wanted or (float(self.delay.value), 0.0)))

    def _moved(self, event: Any) -> None:
        if event.client is not None:  # not set by refresh
            self._set_after(tuned.SLIDER_SETTLES_S, event.client, (float(self.delay.value), self.loss.value / 100.0))

    def _set_after(self, seconds: float, client: Any, wanted: Setting) -> None:
        """Set it unless another change comes first: dragging a slider is one change."""
        if self._timer is not None:
            self._timer.cancel()
        self._refresh_after_s = time.monotonic() + seconds + tuned.STATUS_LAG_S
        self._timer = threading.Timer(seconds, self._set, (client, wanted))
        self._timer.name, self._timer.daemon = "page-network", True
        self._timer.start()

    def _set(self, client: Any, wanted: Setting) -> None:
        try:
            self._network.set(wanted)
        except Exception as error:  # any failure is shown to the visitor and never ends the page
            log.info("page: network %s refused: %s", describe(wanted), error)
            notify(client, "The network has not changed", str(error) or type(error).__name__, bad=True)


def _drawn_ms(status: dict[str, Any] | None) -> float:
    """The mean delay of the frames so far; 0 if it is not known."""
    try:
        found = float((status or {})["drawn_delay_ms"]["mean"])
    except (KeyError, TypeError, ValueError):
        return 0.0
    return found if math.isfinite(found) else 0.0


def describe(setting: Setting) -> str:
    """A setting in words."""
    if setting is None:
        return "the scenario's"
    name = next((name for name, each in tuned.NETWORKS.items() if each == setting), "set by hand")
    return f"{name}: mean delay {setting[0]:.0f} ms, {100.0 * setting[1]:.0f} % of the frames lost"
