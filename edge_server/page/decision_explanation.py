"""Explains a learned policy's newest decision: what contributed for and against it, and where in an image.

Nothing is loaded or shown while the policy is not a learned one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from edge_server.live.state import EdgeState
from edge_server.page import markup
from edge_server.page.colors import AGAINST, FOR
from freshfield import payload

if TYPE_CHECKING:
    from edge_server.scheduler.learned.decision import Decision

WIDTH = 320
# Opacity of the tint over the region that contributed most.
STRENGTH = 0.75


class DecisionExplanation:
    """A folder in the current GUI container. One thread calls ``refresh``, a few times a second."""

    def __init__(self, gui: viser.GuiApi, state: EdgeState) -> None:
        self._gui, self._state = gui, state
        self._folder = gui.add_folder("Why this decision", visible=False)
        with self._folder:
            self._text = gui.add_html("")
            self._button: Any = gui.add_button(
                "show where in the image",
                hint="Covers regions of the strongest camera's image and measures how much each contributed.",
                visible=False,
            )
        self._image: Any = None
        self._number: int | None = None
        self._requested = False
        self._button.on_click(self._clicked)

    def refresh(self) -> None:
        """Explain the newest decision if it is new."""
        decided = self._state.decision()
        self._folder.visible = decided is not None
        if decided is None:
            return
        if self._requested:
            self._requested = False
            self._look(decided)
        if decided.number == self._number:
            return
        from edge_server.scheduler.learned.explain import explain

        self._number = decided.number
        explanation = explain(decided.actor, decided.state, decided.action)
        self._text.content = markup.decision_explanation(explanation)
        self._button.visible = self._state.embed is not None and bool(decided.state.frames)

    def _clicked(self, event: Any) -> None:
        # The next refresh does the work, once for any number of clicks.
        self._requested = True

    def _look(self, decided: Decision) -> None:
        """Show the regions in the image of the camera that contributed most."""
        from edge_server.scheduler.learned.explain import explain, occlusion_map

        embed, state = self._state.embed, decided.state
        if embed is None or not state.frames:
            return
        shares = np.abs(explain(decided.actor, state, decided.action).cameras)
        for number in np.argsort(-shares):
            frame = state.frames.get(state.cameras[number])
            if frame is None:
                continue
            try:
                size = (frame.intrinsics.width, frame.intrinsics.height)
                image = payload.decode(frame.payload, frame.codec, *size)
            except payload.PayloadError:
                continue
            regions = occlusion_map(decided.actor, state, decided.action, int(number), image, embed)
            self._show(tinted(image[..., :3], regions), frame.camera)
            return

    def _show(self, image: NDArray[np.uint8], camera: str) -> None:
        if self._image is not None:
            self._image.remove()
        with self._folder:
            self._image = self._gui.add_image(image, label=camera, format="jpeg", jpeg_quality=88)


def tinted(image: NDArray[np.uint8], regions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """``image`` (H, W, 3) resized to WIDTH, with the contributions ``regions`` (rows, columns) as a tint: one
    color for the decision, another against it."""
    height = max(1, round(WIDTH * image.shape[0] / max(1, image.shape[1])))
    large = cv2.resize(np.ascontiguousarray(image), (WIDTH, height), interpolation=cv2.INTER_LINEAR)
    limit = float(np.abs(regions).max())
    grid = regions / limit if limit > 0 else np.zeros_like(regions)
    # Interpolated, because sharp edges of the coarse grid would hide the image.
    share = cv2.resize(grid, (WIDTH, height), interpolation=cv2.INTER_LINEAR)[..., None]
    color = np.where(share >= 0, np.array(FOR, float), np.array(AGAINST, float))
    mixed = large + STRENGTH * np.abs(share) * (color - large)
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
