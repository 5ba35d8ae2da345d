"""The operator's controls: policy and its value, pause, reset, snapshot.

A refused change becomes a notification for its sender. Everybody sees the current values.
"""

from __future__ import annotations

import logging
import math
import re
import threading
from functools import partial
from typing import Any

import numpy as np
import viser

from edge_server.live.state import EdgeState
from edge_server.page.display_modes import ERROR, HINT, PICTURE, TRUTH, VIEWS
from edge_server.page.markup import frontier, html
from edge_server.page.page_constants import NOTICE_S, SNAPSHOT_NOTICE_S
from edge_server.page.rendering import RenderLoop
from edge_server.scheduler import make_policy, policy_help, short_name

log = logging.getLogger(__name__)


class ControlPanel:
    """Inputs in the current GUI container, kept equal to ``state.controls``, which others may change too."""

    def __init__(self, server: viser.ViserServer, state: EdgeState) -> None:
        gui = server.gui
        self._state = state
        self._lock = threading.Lock()
        self._parameter: dict[str, str | None] = {}
        self._names = {short_name(name): name for name in state.policies or (state.controls.policy,)}
        names, current = tuple(self._names), short_name(state.controls.policy)
        self.policy: Any = gui.add_dropdown(
            "policy",
            names,
            initial_value=current if current in names else names[0],
            hint="Which of the newest views an update uses.",
        )
        self.value: Any = gui.add_number("value", _finite_or_zero(state.controls.value), min=0.0, step=1.0)
        self.help = gui.add_html("")
        self.chosen = gui.add_html("", visible=bool(state.chosen))
        self.frontier = gui.add_html("", visible=state.frontier is not None)
        self.buttons = gui.add_button_group("field", ("pause", "reset", "snapshot"))
        self._paused: bool | None = None
        self.policy.on_update(lambda event: self._policy_chosen(event))
        self.value.on_update(lambda event: self._value_entered(event))
        self.buttons.on_click(self._pressed)
        self.refresh()

    def refresh(self) -> None:
        """Show the current values."""
        controls = self._state.controls
        with self._lock:
            shown = short_name(controls.policy)
            if shown in self.policy.options and self.policy.value != shown:
                self.policy.value = shown
            parameter = self._parameter_of(controls.policy)
            self.value.visible = parameter is not None
            self.value.label = _label(parameter)
            if self.value.value != _finite_or_zero(controls.value):
                self.value.value = _finite_or_zero(controls.value)
            if self._state.frontier is not None:
                self.frontier.content = frontier(self._state.frontier, self._state.present())
            self.help.content = _help(controls.policy)
            self.chosen.content = html("note", self._state.chosen)
            if self._paused != controls.paused:
                self._paused = controls.paused
                self.buttons.options = ("resume" if controls.paused else "pause", "reset", "snapshot")

    # --- callbacks ------------------------------------------------------------------------------

    def _policy_chosen(self, event: Any) -> None:
        if event.client is None:  # set by refresh, not by a visitor
            return
        shown = event.target.value
        name = self._names.get(shown, shown)
        self._attempt(event.client, f"policy {shown}", lambda: self._state.set_policy(name, None))

    def _value_entered(self, event: Any) -> None:
        entered, name = event.target.value, self._state.controls.policy
        if event.client is None or entered == _finite_or_zero(self._state.controls.value):
            return
        # The value comes from a browser: an empty input must result in a notification, too.
        self._attempt(event.client, f"{name} with {entered}", lambda: self._state.set_policy(name, float(entered)))

    async def _pressed(self, event: Any) -> None:
        # A coroutine runs before the next click is handled, so the group still holds this click's value.
        pressed, client, controls = event.target.value, event.client, self._state.controls
        if pressed == "reset":
            controls.reset_requested = True
            notify(client, "Reset", "The field forgets the scene and starts again.")
        elif pressed == "snapshot":
            save = partial(self._attempt, client, "snapshot", lambda: self._snapshot(client))
            threading.Thread(target=save, name="page-snapshot", daemon=True).start()
        else:
            controls.paused = pressed == "pause"
            self.refresh()

    def _snapshot(self, client: Any) -> None:
        path = self._state.save_snapshot()
        notify(client, "Snapshot saved", str(path), seconds=SNAPSHOT_NOTICE_S)

    def _attempt(self, client: Any, what: str, action: Any) -> None:
        """Call ``action``; if it fails, notify the client and show the unchanged values."""
        try:
            action()
        except Exception as error:  # any failure is shown to the operator and never ends the page
            log.info("page: %s refused: %s", what, error)
            notify(client, f"Not done: {what}", str(error) or type(error).__name__, bad=True)
        self.refresh()

    def _parameter_of(self, policy: str) -> str | None:
        """Name of the policy's value, None if it has none. A policy unknown here may have one."""
        if policy not in self._parameter:
            try:
                self._parameter[policy] = make_policy(policy, None, np.random.default_rng(0)).parameter
            except ValueError:
                self._parameter[policy] = "value"
        return self._parameter[policy]


def add_view_choice(client: Any, order: float, renders: RenderLoop) -> None:
    """Add the choice of display mode, for this visitor alone. order: of the input in the panel."""
    choice = client.gui.add_dropdown("show", VIEWS, initial_value=PICTURE, hint=HINT, order=order)
    # A node of the same name for this visitor replaces the shared one: frustums would obscure a comparison.
    cameras = client.scene.add_frame("/cameras", show_axes=False)

    def chosen(event: Any) -> None:
        cameras.visible = choice.value not in (TRUTH, ERROR)
        renders.choose(client, choice.value)

    choice.on_update(chosen)


def _finite_or_zero(value: float | None) -> float:
    return float(value) if value is not None and math.isfinite(value) else 0.0


def _label(parameter: str | None) -> str:
    """``omega_ms`` as a label: omega, ms."""
    if parameter is None:
        return "value"
    name, _, unit = parameter.partition("_")
    return f"{name}, {unit}" if unit else name


def _help(policy: str) -> str:
    """The scheduler's line of help on the policy, without equation numbers and values."""
    return html("note", re.sub(r" \([\d.-]+\)", "", policy_help(policy).split("; value:")[0]))


def notify(client: Any, title: str, body: str, bad: bool = False, seconds: float = NOTICE_S) -> None:
    """Show a notification to ``client``, if there is one."""
    if client is not None:
        client.add_notification(title, body, auto_close_seconds=seconds, color="red" if bad else None)
