"""The two side panels: status and controls; timelines and cameras."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any
from weakref import WeakSet

import numpy as np
import viser

from edge_server.live.state import CameraView, Comparison, EdgeState, Publication
from edge_server.page import display_modes, markup
from edge_server.page import page_constants as tuned
from edge_server.page.controls import ControlPanel
from edge_server.page.diagnosis import poor_picture
from edge_server.page.markup import html
from edge_server.page.network_control import EmulatorControl, NetworkControl
from edge_server.page.rendering import browser_image
from edge_server.page.timelines import History, Timelines
from edge_server.run_records import age_parts_ms
from freshfield import coverage


class Panel:
    """GUI shared by all visitors. One thread calls ``refresh``, a few times a second."""

    def __init__(self, server: viser.ViserServer, state: EdgeState, network: EmulatorControl | None = None) -> None:
        self._state = state
        gui = server.gui
        gui.set_panel_label("freshfield")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(tuned.MAIN_PANEL_PX)
        gui.add_html(html("intro"))
        if state.warnings:
            gui.add_html(html("warning", f"Insecure: {'; '.join(state.warnings)}."))
        self._troubles = gui.add_html("", visible=False)
        self._status = gui.add_html("")
        self._decision = gui.add_html("", visible=False)
        self.view_order = self._decision.order + 0.5
        """Of the elements that each visitor has alone, below the status."""
        self._network: NetworkControl | None = None
        if network is not None:
            with gui.add_folder("Change the network"):
                self._network = NetworkControl(gui, network)
        self._caption = gui.add_html(html("note", "Waiting for a held-out frame to compare with."))
        self._pair: Any = None
        self._compared_update: int | None = None
        self._refreshes = 0
        with gui.add_folder("Controls"):
            self.controls = ControlPanel(server, state)
        side = gui.add_panel()
        with side.add_tab("Timelines"):
            self._timelines = Timelines(gui)
            self._waiting = gui.add_html(html("note", "Curves appear with the first frames and updates."))
            self._channel = gui.add_html("", visible=False)
            gui.add_html(html("legend"))
            self._table = gui.add_html("")
        with side.add_tab("Coverage"):
            self._coverage = gui.add_html(html("note", "Computed once every camera has sent a frame and stands still."))
            self._places: dict[str, coverage.Camera] = {}  # of the cameras at the last refresh
            self._reckoned_for: dict[str, coverage.Camera] = {}
            self._reckoned_with_depth = False
        side.dock_left()
        side.set_width(tuned.SIDE_PANEL_PX)
        self._gui, self._side = gui, side
        self._made_room: WeakSet[viser.ClientHandle] = WeakSet()

    def make_room(self, client: viser.ClientHandle) -> None:
        """Collapse the timelines, once, for a visitor whose window is so narrow that both panels hide the scene."""
        if client.camera.image_width < tuned.LEAST_SCENE_PX and client not in self._made_room:
            self._made_room.add(client)
            panel = client.gui.main_panel  # a handle that speaks to this visitor alone
            with contextlib.suppress(AttributeError):  # viser's own: a version that calls it otherwise folds nothing
                panel._placement_uuid = self._side._placement_uuid
                panel.minimize()

    def refresh(
        self,
        cameras: list[CameraView],
        history: History,
        publications: list[Publication],
        channel: dict[str, Any] | None,
    ) -> None:
        """Show the current state."""
        last = publications[-1] if publications else None
        self._status.content = markup.status(summary(self._state, cameras, publications))
        learning = self._state.status_line.startswith("learning")  # nothing is shown yet, and the status says so
        poor = "" if learning else poor_picture(self._state.flat_db(), publications, cameras)
        troubles = [*self._state.troubles(), *([poor] if poor else [])]
        self._troubles.visible = bool(troubles)
        self._troubles.content = html("warning", "; ".join(troubles)) if troubles else ""
        if last is not None:
            self._decision.content = markup.decision_words(last, cameras, self._state.controls.policy)
            self._decision.visible = True
        self._table.content = html("table", cameras, last.selected if last else ())
        self._waiting.visible = last is None
        if channel is not None:
            self._channel.content = markup.channel_line(channel)
            self._channel.visible = True
        self._refresh_coverage([c for c in cameras if not c.held_out])
        self._refreshes += 1
        if self._refreshes % 2:  # charts need only one new point a second
            self._timelines.refresh(history, publications)
        self.controls.refresh()
        if self._network is not None:
            self._network.refresh(channel)
        comparison = self._state.comparison
        if comparison is not None and comparison.number != self._compared_update:
            held_out = any(c.held_out for c in cameras if c.camera == comparison.camera)
            self._show_comparison(comparison, publications, held_out)

    def _refresh_coverage(self, cameras: Sequence[CameraView]) -> None:
        """Compute the coverage once the cameras stand still, and again if one then stands elsewhere."""
        frames = {c.camera: c.newest for c in cameras if c.newest is not None}
        if not frames or len(frames) < len(cameras):
            return
        known = {name: (frame.intrinsics, frame.pose.matrix()) for name, frame in frames.items()}
        stand_still, self._places = _same_places(known, self._places), known
        depth = 2 * sum(c.measures_depth for c in cameras) >= len(cameras)  # as many as a field begins with
        if not stand_still or (_same_places(known, self._reckoned_for) and depth == self._reckoned_with_depth):
            return
        self._reckoned_for, self._reckoned_with_depth = known, depth
        found = coverage.reckon(list(known.values()))
        words = f"{found.words}. {coverage.reached(len(cameras), depth)}"
        self._coverage.content = html("coverage", coverage.plan_svg(known, found), words)

    def _show_comparison(self, comparison: Comparison, publications: list[Publication], held_out: bool) -> None:
        self._compared_update = comparison.number
        scored = next((p for p in reversed(publications) if p.number == comparison.number), None)
        self._caption.content = markup.comparison_caption(
            comparison.camera, scored.psnr_db if scored else None, comparison.number, held_out
        )
        rows, columns = comparison.truth.shape[:2]
        height = max(1, round(tuned.PAIR_PX / 2 * rows / columns))
        pair = browser_image(display_modes.compared(comparison, tuned.PAIR_PX, height, error=False, labeled=False))
        if self._pair is None:
            order = self._caption.order + 0.5  # below its caption
            self._pair = self._gui.add_image(pair, format="jpeg", jpeg_quality=tuned.PAIR_JPEG_QUALITY, order=order)
        else:
            self._pair.image = pair


def _same_places(cameras: Mapping[str, coverage.Camera], others: Mapping[str, coverage.Camera]) -> bool:
    """Whether the same cameras stand where they stood, up to pose noise."""
    return cameras.keys() == others.keys() and all(
        np.allclose(pose, others[name][1], atol=tuned.POSE_NOISE) for name, (_, pose) in cameras.items()
    )


def summary(state: EdgeState, cameras: list[CameraView], publications: list[Publication]) -> markup.Summary:
    """The numbers of the tiles: the latest score, the current ages of the training cameras."""
    ages = [c.age_ms for c in cameras if not c.held_out and c.age_ms is not None]
    last = publications[-1] if publications else None
    scored = next((p for p in reversed(publications) if p.psnr_db is not None), None)
    db, on = (scored.psnr_db, scored.scored_on) if scored else (None, None)
    if (moving := state.so_far()) is not None:
        db, on = moving.now_psnr_db, moving.words()
    return markup.Summary(
        scenario=state.scenario,
        field=state.field_name,
        doing="paused by the operator" if state.controls.paused else state.status_line,
        condition="paused" if state.controls.paused else "live" if state.started else "waiting",
        updates=last.number + 1 if last else 0,
        update_ms=last.update_ms if last else None,
        psnr_db=db,
        scored_on=on,
        mean_age_ms=float(np.mean(ages)) if ages else None,
        worst_age_ms=float(np.max(ages)) if ages else None,
        reporting=sum(c.age_ms is not None for c in cameras),
        cameras=len(cameras),
        t_s=state.now_s(),
        age_parts_ms=age_parts_ms(publications[-tuned.AGE_PARTS_OF :], state.now_s()),
    )
