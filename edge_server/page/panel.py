"""The two side panels: what is going on and what one may change; the time lines and the cameras."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from edge_server.live.state import CameraView, Comparison, EdgeState, Publication
from edge_server.page import markup
from edge_server.page.controls import ControlPanel
from edge_server.page.decision_explanation import Why
from edge_server.page.mesh_layer import MeshLayer
from edge_server.page.timelines import History, Timelines

MAIN_WIDTH = 372
SIDE_WIDTH = 356
# Two images and the gap between them, as they stand in the panel.
PAIR_WIDTH = 640
GAP = 8
PANEL_COLOR = (36, 36, 36)


class Panel:
    """Server-wide GUI. ``refresh`` is called by one thread, a few times a second."""

    def __init__(self, server: viser.ViserServer, state: EdgeState) -> None:
        self._state = state
        gui = server.gui
        gui.set_panel_label("freshfield")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(MAIN_WIDTH)
        gui.add_html(markup.INTRO)
        self._status = gui.add_html("")
        self._caption = gui.add_html(markup.note("Waiting for a held-out frame to compare with."))
        self._pair: Any = None
        self._pair_of: int | None = None
        self._turn = 0
        self._folder = gui.add_folder("Controls")
        with self._folder:
            self.controls = ControlPanel(server, state)
            self.surface = MeshLayer(server, state)
        self._why = Why(gui, state)
        side = gui.add_panel()
        with side.add_tab("Time lines"):
            self._timelines = Timelines(gui)
            self._waiting = gui.add_html(markup.note("Curves appear with the first frames and updates."))
            self._channel = gui.add_html("", visible=False)
            gui.add_html(markup.legend())
            self._table = gui.add_html("")
        side.dock_left()
        side.set_width(SIDE_WIDTH)
        self._gui = gui

    def refresh(
        self,
        cameras: list[CameraView],
        history: History,
        publications: list[Publication],
        channel: dict[str, Any] | None,
    ) -> None:
        """Show the present."""
        last = publications[-1] if publications else None
        self._status.content = markup.status(summary(self._state, cameras, publications))
        self._table.content = markup.table(cameras, last.selected if last else ())
        self._waiting.visible = last is None
        if channel is not None:
            self._channel.content = markup.channel_line(channel)
            self._channel.visible = True
        self._turn += 1
        if self._turn % 2:  # curves need no more than one new point a second
            self._timelines.refresh(history, publications)
        self.controls.refresh()
        self._why.refresh()
        comparison = self._state.comparison
        if comparison is not None and comparison.number != self._pair_of:
            self._compare(comparison, publications)

    def _compare(self, comparison: Comparison, publications: list[Publication]) -> None:
        self._pair_of = comparison.number
        scored = next((p for p in reversed(publications) if p.number == comparison.number), None)
        self._caption.content = markup.comparison_caption(
            comparison.camera, scored.psnr_db if scored else None, comparison.number
        )
        pair = side_by_side(comparison.truth, comparison.rendered)
        if self._pair is None:
            order = 0.5 * (self._caption.order + self._folder.order)
            self._pair = self._gui.add_image(pair, format="jpeg", jpeg_quality=88, order=order)
        else:
            self._pair.image = pair


def summary(state: EdgeState, cameras: list[CameraView], publications: list[Publication]) -> markup.Summary:
    """The tiles' numbers: the latest score there is, ages of the training cameras now."""
    ages = [c.age_ms for c in cameras if not c.held_out and c.age_ms is not None]
    last = publications[-1] if publications else None
    scored = next((p for p in reversed(publications) if p.psnr_db is not None), None)
    return markup.Summary(
        scenario=state.scenario,
        field=state.field_name,
        doing="paused by the operator" if state.controls.paused else state.status_line,
        condition="paused" if state.controls.paused else "live" if state.started else "waiting",
        updates=last.number + 1 if last else 0,
        update_ms=last.update_ms if last else None,
        psnr_db=scored.psnr_db if scored else None,
        scored_on=scored.scored_on if scored else None,
        mean_age_ms=float(np.mean(ages)) if ages else None,
        worst_age_ms=float(np.max(ages)) if ages else None,
        reporting=sum(c.age_ms is not None for c in cameras),
        cameras=len(cameras),
        t_s=state.now_s(),
    )


def side_by_side(truth: NDArray[np.uint8], rendered: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Two images of any size as one (H, PAIR_WIDTH, 3), a gap in the panel's color between them."""
    width = (PAIR_WIDTH - GAP) // 2
    height = max(1, round(width * truth.shape[0] / max(1, truth.shape[1])))
    out = np.empty((height, PAIR_WIDTH, 3), np.uint8)
    out[:] = PANEL_COLOR
    for image, left in ((truth, 0), (rendered, PAIR_WIDTH - width)):
        small = np.ascontiguousarray(image[..., :3])
        shrinks = small.shape[1] > width
        how = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
        out[:, left : left + width] = cv2.resize(small, (width, height), interpolation=how)
    return out
