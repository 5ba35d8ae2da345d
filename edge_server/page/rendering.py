"""Renders the field for every visitor: coarse while they move, finer at rest, without a queue.

One thread renders for all visitors, so the share of the machine that they cost is bounded. Each visitor keeps
only the newest viewpoint; viewpoints that changed while the thread was busy are skipped. Images are rendered
in bands of rows, and an image whose visitor moves is abandoned between two bands.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Rendering, Snapshot
from edge_server.live.state import Comparison, EdgeState
from edge_server.page import display_modes
from edge_server.page import page_constants as tuned
from edge_server.page.page_thread import PageThread
from edge_server.page.viewpoint import row_band, visitor_camera
from freshfield.geometry import Pinhole

log = logging.getLogger(__name__)


@runtime_checkable
class TellsUnseen(Protocol):
    """A snapshot that knows which places no camera has seen, such as ``LayeredSnapshot``."""

    def unseen(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> NDArray[np.bool_] | None: ...


@dataclass(frozen=True)
class DetailLevel:
    """A level of detail.

    budget_s: time for one image. max_share: largest share of all time for such images.
    min_rows, max_rows: bounds of the image rows, which adapt to the speed of the renderer.
    """

    budget_s: float
    max_share: float
    min_rows: int
    max_rows: int


MOVING, NEWER = 0, 1
LEVELS = tuple(DetailLevel(*each) for each in tuned.DETAIL)


BrowserView = tuple[NDArray[np.float64], NDArray[np.float64], float, int, int]
"""Position (3,), wxyz (4,), vertical field of view, canvas size."""


@dataclass
class ClientState:
    """A connected browser.

    viewpoint: its current viewpoint; moved_at: when that changed.
    serial: number of viewpoints so far.
    level: the finest of LEVELS sent for this viewpoint and ``renderer``, -1 for none.
    sent: number of images since the last blank background.
    view: display mode, one of ``display_modes.VIEWS``.
    """

    client: Any
    viewpoint: BrowserView | None = None
    moved_at: float = 0.0
    serial: int = 0
    renderer: Snapshot | Comparison | None = None
    level: int = -1
    sent: int = 0
    view: str = display_modes.PICTURE


class RenderLoop(PageThread):
    """The render thread."""

    def __init__(self, state: EdgeState) -> None:
        super().__init__("page-render", "rendering for a visitor")
        self._state = state
        self._visitors: dict[int, ClientState] = {}
        self._rows = [tuned.FIRST_ROWS * level.min_rows for level in LEVELS]
        self._not_before = [0.0] * len(LEVELS)
        self._took_s = [level.budget_s for level in LEVELS]  # the last whole image of each level

    # --- called from viser's threads --------------------------------------------------------------

    def add_client(self, client: Any) -> None:
        with self._wake:
            self._visitors[client.client_id] = ClientState(client)
        self.camera_moved(client)

    def remove_client(self, client: Any) -> None:
        with self._wake:
            self._visitors.pop(client.client_id, None)

    def choose(self, client: Any, view: str) -> None:
        """Show the client another of ``display_modes.VIEWS`` from now on."""
        with self._wake:
            visitor = self._visitors.get(client.client_id)
            if visitor is not None:
                visitor.view, visitor.level = view, -1
                visitor.serial += 1
                self.wake()

    def camera_moved(self, client: Any) -> None:
        """Replace the viewpoint to render for the client."""
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
            visitor.level = -1
            self.wake()

    # --- the thread -----------------------------------------------------------------------------

    def _step(self) -> float:
        if self._work(perf_counter()):
            return 0.0
        return tuned.RENDER_IDLE_S if self._visitors else tuned.RENDER_UNVISITED_S

    def _work(self, now: float) -> bool:
        """Do the most urgent work; False if nothing is due."""
        renderer = self._state.renderer
        with self._wake:
            visitors = [v for v in self._visitors.values() if v.viewpoint is not None]
        if not visitors or renderer is None:
            return False
        levels = [
            (self._next_level(visitor, self._compared(visitor) or renderer, now), visitor.sent, visitor)
            for visitor in visitors
        ]
        due = [(level, sent, visitor) for level, sent, visitor in levels if level is not None]
        if not due:
            return False
        level, _, visitor = min(due, key=lambda item: item[:2])
        self._serve(visitor, self._compared(visitor) or renderer, level)
        return True

    def _compared(self, visitor: ClientState) -> Comparison | None:
        """The comparison for a visitor in the view of truth or error; None for other views, and before the first."""
        return self._state.comparison if visitor.view in (display_modes.TRUTH, display_modes.ERROR) else None

    def _next_level(self, visitor: ClientState, renderer: Snapshot | Comparison, now: float) -> int | None:
        """The level to render next for a visitor; None if it has the finest or must wait."""
        if visitor.level < 0:
            level = MOVING
        elif now - visitor.moved_at < tuned.RENDER_SETTLE_S:
            return None
        elif visitor.renderer is not renderer:
            level = NEWER
        else:
            level = visitor.level + 1
        if level >= len(LEVELS) or now < self._not_before[level]:
            return None
        return level

    def _serve(self, visitor: ClientState, shown: Snapshot | Comparison, level: int) -> None:
        """Send a visitor an image of ``shown``, unless they move meanwhile."""
        with self._wake:
            viewpoint, serial = visitor.viewpoint, visitor.serial
        assert viewpoint is not None
        began, levels = perf_counter(), [level]
        try:
            if isinstance(shown, Comparison):
                _, camera = visitor_camera(*viewpoint, rows=LEVELS[-1].max_rows)
                image: NDArray[np.float32] | None = display_modes.compared(
                    shown, camera.width, camera.height, visitor.view == display_modes.ERROR
                )
                # A visitor who drags gets it again, like one who moves; nothing finer will follow.
                level, levels = len(LEVELS) - 1, [MOVING, NEWER]
            else:
                image = self._rendered(visitor, shown, level, viewpoint, serial)
        finally:
            spent = perf_counter() - began
            for each in levels:  # the second bound matters if rendering is cheap: it spares network and browser
                self._not_before[each] = began + max(spent / LEVELS[each].max_share, tuned.RENDER_MIN_GAP_S)
        if image is None:
            return
        if visitor.client.client_id in self._visitors:  # has not left meanwhile
            visitor.client.scene.set_background_image(
                browser_image(image), format="jpeg", jpeg_quality=tuned.PICTURE_JPEG_QUALITY
            )
            visitor.sent += 1
        with self._wake:
            if visitor.serial == serial:
                visitor.level, visitor.renderer = level, shown

    def _rendered(
        self, visitor: ClientState, renderer: Snapshot, level: int, viewpoint: BrowserView, serial: int
    ) -> NDArray[np.float32] | None:
        """A visitor's view of the current field; None if they have moved meanwhile."""
        pose, camera = visitor_camera(*viewpoint, rows=round(self._rows[level]))
        began = perf_counter()
        shown = renderer.at(self._state.now_ns())
        rendering = self._render(shown, pose, camera, visitor, serial, level)
        if rendering is None:
            return None
        self._adapt(level, perf_counter() - began)
        if visitor.view == display_modes.DEPTH:
            return display_modes.depth_view(rendering)
        if visitor.view == display_modes.AGE:
            return display_modes.age_view(rendering, pose, camera, self._state.cameras())
        if level and isinstance(shown, TellsUnseen):
            return hatched(rendering.color, shown.unseen(pose, camera.scaled(1.0 / tuned.UNSEEN_COARSE)))
        return rendering.color

    def _budget_s(self, number: int) -> float:
        """Time for an image of a level. The image of a new publication may take its share of an update: with short
        updates, a finer image would be outdated."""
        level, newest = LEVELS[number], self._state.newest()
        if number != NEWER or newest is None:
            return level.budget_s
        return float(np.clip(level.max_share * newest.update_ms / 1e3, tuned.RENDER_LEAST_S, level.budget_s))

    def _adapt(self, number: int, spent: float) -> None:
        """Change the rows of the next image so that it takes about the time budget of its level."""
        level, self._took_s[number] = LEVELS[number], spent
        change = np.clip(np.sqrt(self._budget_s(number) / max(spent, 1e-4)), *tuned.ROWS_CHANGE)
        self._rows[number] = float(np.clip(self._rows[number] * change, level.min_rows, level.max_rows))

    def _render(
        self, renderer: Snapshot, pose: NDArray, camera: Pinhole, visitor: ClientState, serial: int, level: int
    ) -> Rendering | None:
        """The image, rendered in bands; None if the visitor has moved meanwhile. Every band projects the whole field
        again, so there are only as many as the time of the last such image requires."""
        bands = max(1, round(self._took_s[level] / tuned.RENDER_BAND_S)) if level else 1
        edges = np.linspace(0, camera.height, min(bands, camera.height) + 1).astype(int)
        parts = []
        for top, bottom in pairwise(edges):
            if level and (visitor.serial != serial or self._stopped):
                return None
            parts.append(renderer.render(pose, row_band(camera, int(top), int(bottom - top))))
        return Rendering(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("color", "depth", "opacity")))


def hatched(image: NDArray[np.float32], unseen: NDArray[np.bool_] | None) -> NDArray[np.float32]:
    """A rendering (H, W, 3) with dark stripes over places that no camera has seen.

    unseen: bool, at a lower resolution; None: not known.
    """
    if unseen is None or not unseen.any():
        return image
    height, width = image.shape[:2]
    y, x = np.arange(height), np.arange(width)
    there = unseen[(y * unseen.shape[0] // height)[:, None], x * unseen.shape[1] // width]
    stripe = (x + y[:, None]) // tuned.STRIPE_PX % 2 == 0
    return np.where((there & stripe)[..., None], image * np.float32(tuned.STRIPE_SHADE), image)


def browser_image(color: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Color (H, W, 3) as uint8; pixels that are not finite show the backdrop."""
    good = np.isfinite(color).all(axis=-1, keepdims=True)
    return (np.clip(np.where(good, color, display_modes.BACKDROP), 0, 1) * 255 + 0.5).astype(np.uint8)


def _same(a: tuple | None, b: tuple) -> bool:
    """Whether two viewpoints would give the same image."""
    return a is not None and all(bool(np.allclose(x, y, rtol=0, atol=1e-6)) for x, y in zip(a, b))
