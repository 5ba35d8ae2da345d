"""Renders the field for every visitor: coarse while they move, finer when they stop, never a queue.

One thread serves all visitors and is the only place of the page that renders, so the share of the machine
that watching costs is bounded however many watch. A visitor is a slot that holds the newest viewpoint: what
was asked for while the thread was busy is forgotten. Images are rendered in bands, and one that has been
overtaken by a movement is given up between two bands.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Renderer, Rendering
from edge_server.live.state import EdgeState
from edge_server.page.viewpoint import band, visitor_camera
from freshfield.geometry import Pinhole

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stage:
    """How fine an image is. seconds: what it may take; share: of all time that may go into such images;
    rows between least and most, adapted to what this machine's renderer turns out to need."""

    seconds: float
    share: float
    least: int
    most: int


# While the visitor moves, at rest, and at rest with nothing new to show. Below the least rows an image says
# too little to be worth its fixed cost, which is waiting for a training step of the field to end.
STAGES = (Stage(0.08, 0.5, 64, 240), Stage(0.20, 0.2, 120, 480), Stage(1.2, 0.15, 200, 720))
BAND_S = 0.1
LEAST_GAP_S = 0.05
SETTLE_S = 0.25
POINTS = 8000
POINTS_SHARE = 0.05
POINTS_EVERY_S = 1.0
# viser packs depth into 24 bits of 1e-5 m: this is the farthest it can say.
FAR_M = 167.0
# Coarser depth has a constant low byte, which PNG packs five times better.
DEPTH_STEP_M = 256e-5
DEPTH_ROWS = 180
BACKDROP = np.array([18, 20, 24], np.float32) / 255


@dataclass
class Visitor:
    """One connected browser. viewpoint: position (3,), wxyz (4,), vertical field of view, canvas size.
    stage: finest of STAGES that was sent for this viewpoint and ``renderer``; -1 for none."""

    client: Any
    viewpoint: tuple[NDArray[np.float64], NDArray[np.float64], float, int, int] | None = None
    moved_at: float = 0.0
    serial: int = 0
    renderer: Renderer | None = None
    stage: int = -1
    sent: int = 0


class RenderLoop:
    """The thread. ``show_points(points, colors)`` is called with the field's own points while ``mode`` or
    the field's youth asks for them, and with None when it no longer does."""

    def __init__(self, state: EdgeState, show_points: Any) -> None:
        self._state = state
        self._show_points = show_points
        self._visitors: dict[int, Visitor] = {}
        self._wake = threading.Condition()
        self._stopped = False
        self._rows = [1.5 * stage.least for stage in STAGES]
        self._not_before = [0.0] * len(STAGES)
        self._points_from: Renderer | None = None
        self._points_not_before = 0.0
        self._points_shown = False
        self._complained = ""
        self.want_points = False
        self.want_rendering = True
        self.occlude = False
        self._thread = threading.Thread(target=self._run, name="page-render", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        with self._wake:
            self._stopped = True
            self._wake.notify_all()
        self._thread.join(timeout=5.0)

    # --- what visitors do (called from viser's threads) -----------------------------------------

    def join(self, client: Any) -> None:
        with self._wake:
            self._visitors[client.client_id] = Visitor(client)
        self.moved(client)

    def leave(self, client: Any) -> None:
        with self._wake:
            self._visitors.pop(client.client_id, None)

    def moved(self, client: Any) -> None:
        """Take the client's viewpoint, replacing what it asked for before."""
        camera = client.camera
        viewpoint = (
            np.array(camera.position, dtype=np.float64),
            np.array(camera.wxyz, dtype=np.float64),
            float(camera.fov),
            int(camera.image_width),
            int(camera.image_height),
        )
        if viewpoint[3] < 1 or viewpoint[4] < 1 or not all(np.all(np.isfinite(v)) for v in viewpoint[:3]):
            return
        with self._wake:
            visitor = self._visitors.get(client.client_id)
            if visitor is None or _same(visitor.viewpoint, viewpoint):
                return
            visitor.viewpoint = viewpoint
            visitor.moved_at = perf_counter()
            visitor.serial += 1
            visitor.stage = -1
            self._wake.notify_all()

    def refresh(self) -> None:
        """Send everybody a new image, because what they want to see has changed."""
        with self._wake:
            for visitor in self._visitors.values():
                visitor.stage = -1
            self._points_from = None
            self._wake.notify_all()

    # --- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._wake:
                if self._stopped:
                    return
            try:
                worked = self._step(perf_counter())
            except Exception as error:  # a page must never take the server with it
                self._complain(error)
                worked = False
            if not worked:
                with self._wake:
                    if not self._stopped:
                        self._wake.wait(0.05 if self._visitors else 0.5)

    def _step(self, now: float) -> bool:
        """Do the most urgent thing there is time for; False if there is none."""
        renderer = self._state.renderer
        with self._wake:
            visitors = [v for v in self._visitors.values() if v.viewpoint is not None]
        if not visitors:
            return False
        if self._points(renderer, now):
            return True
        if renderer is None or not self.want_rendering:
            for visitor in visitors:
                if visitor.stage < len(STAGES) and visitor.sent:
                    visitor.client.scene.set_background_image(None)
                    visitor.sent = 0
                visitor.stage = -1
            return False
        due = [(stage, v.sent, v) for v in visitors if (stage := self._due(v, renderer, now)) is not None]
        if not due:
            return False
        stage, _, visitor = min(due, key=lambda item: item[:2])
        self._serve(visitor, renderer, stage)
        return True

    def _due(self, visitor: Visitor, renderer: Renderer, now: float) -> int | None:
        """The stage to render next for a visitor, None if it has what it can have or must wait."""
        if visitor.stage < 0:
            stage = 0
        elif now - visitor.moved_at < SETTLE_S:
            return None
        elif visitor.renderer is not renderer:
            stage = 1
        else:
            stage = visitor.stage + 1
        if stage >= len(STAGES) or now < self._not_before[stage]:
            return None
        return stage

    def _serve(self, visitor: Visitor, renderer: Renderer, stage: int) -> None:
        with self._wake:
            viewpoint, serial = visitor.viewpoint, visitor.serial
        assert viewpoint is not None
        pose, camera = visitor_camera(*viewpoint, rows=round(self._rows[stage]))
        began = perf_counter()
        try:
            image = self._render(renderer, pose, camera, visitor, serial, stage)
        finally:
            spent = perf_counter() - began
            # The second bound counts where rendering is cheap: the network and the browser have a share, too.
            self._not_before[stage] = began + max(spent / STAGES[stage].share, LEAST_GAP_S)
        if image is None:
            return
        self._adapt(stage, spent)
        color, depth = presentable(image, camera)
        if visitor.client.client_id not in self._visitors:  # gone meanwhile
            return
        visitor.client.scene.set_background_image(
            color, format="jpeg", jpeg_quality=85,
            depth=depth if self.occlude else None,
        )  # fmt: skip
        visitor.sent += 1
        with self._wake:
            if visitor.serial == serial:
                visitor.stage, visitor.renderer = stage, renderer

    def _adapt(self, stage: int, spent: float) -> None:
        """Take more or fewer rows next time, so that an image takes about what its stage allows."""
        plan = STAGES[stage]
        change = np.clip(np.sqrt(plan.seconds / max(spent, 1e-4)), 0.7, 1.3)
        self._rows[stage] = float(np.clip(self._rows[stage] * change, plan.least, plan.most))

    def _render(
        self, renderer: Renderer, pose: NDArray, camera: Pinhole, visitor: Visitor, serial: int, stage: int
    ) -> Rendering | None:
        """The image in bands; None if the visitor has moved on meanwhile."""
        bands = max(1, round(STAGES[stage].seconds / BAND_S)) if stage else 1
        edges = np.linspace(0, camera.height, min(bands, camera.height) + 1).astype(int)
        parts = []
        for top, bottom in pairwise(edges):
            if stage and (visitor.serial != serial or self._stopped):
                return None
            parts.append(renderer.render(pose, band(camera, int(top), int(bottom - top))))
        return Rendering(
            np.concatenate([p.color for p in parts]),
            np.concatenate([p.depth for p in parts]),
            np.concatenate([p.opacity for p in parts]),
        )

    def _points(self, renderer: Renderer | None, now: float) -> bool:
        """Renew the point cloud if it is wanted and affordable, drop it if it no longer is."""
        if renderer is None or not self.want_points:
            if self._points_shown:
                self._points_shown, self._points_from = False, None
                self._show_points(None, None)
            return False
        if renderer is self._points_from or now < self._points_not_before:
            return False
        points, colors = renderer.points(POINTS)
        spent = perf_counter() - now
        self._points_not_before = now + max(POINTS_EVERY_S, spent / POINTS_SHARE)
        self._points_from = renderer
        points, colors = np.asarray(points, np.float32), np.asarray(colors, np.float32)
        good = np.isfinite(points).all(axis=1) & np.isfinite(colors).all(axis=1)
        if good.any():
            self._points_shown = True
            self._show_points(points[good], np.clip(colors[good] * 255, 0, 255).astype(np.uint8))
        return True

    def _complain(self, error: Exception) -> None:
        """Log a failure once, not at every frame, and slow down."""
        text = f"{type(error).__name__}: {error}"
        if text != self._complained:
            log.warning("page: rendering for a visitor failed: %s", text, exc_info=error)
            self._complained = text
        until = perf_counter() + 1.0
        self._not_before = [max(t, until) for t in self._not_before]
        self._points_not_before = max(self._points_not_before, until)


def presentable(image: Rendering, camera: Pinhole) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """What a browser is sent: color uint8 (H, W, 3) and depth float32 (h, w) along the view axis, metres.

    Whatever the field rendered is safe to show: what is not a number becomes empty space.
    """
    color = np.nan_to_num(image.color, nan=0.0, posinf=1.0, neginf=0.0).astype(np.float32)
    opacity = np.clip(np.nan_to_num(image.opacity, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    bad: NDArray[np.bool_] = ~np.all(np.isfinite(image.color), axis=-1)
    opacity = np.where(bad, 0.0, opacity).astype(np.float32)
    color = np.where(bad[..., None], BACKDROP, color)
    step = max(1, -(-camera.height // DEPTH_ROWS))
    distance = image.depth[::step, ::step]
    axial = np.asarray(distance, np.float32) * camera.rays()[::step, ::step, 2].astype(np.float32)
    empty = ~np.isfinite(axial) | (axial <= 0) | (opacity[::step, ::step] < 0.5)
    axial = np.where(empty, FAR_M, np.minimum(axial, FAR_M)).astype(np.float32)
    depth = np.round(axial / DEPTH_STEP_M) * np.float32(DEPTH_STEP_M)
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8), depth.astype(np.float32)


def _same(a: tuple | None, b: tuple) -> bool:
    """Whether two viewpoints would give the same image."""
    return a is not None and all(bool(np.allclose(x, y, rtol=0, atol=1e-6)) for x, y in zip(a, b))
