"""Why a learned policy decided as it did: what spoke for it and against it, and where in a picture.

Nothing of it is loaded, and nothing shown, while the policy is not one that was learned.
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
# A region that decided everything is painted over by so much.
STRENGTH = 0.75


class Why:
    """A folder in the present GUI container. ``refresh`` is called by one thread, a few times a second."""

    def __init__(self, gui: viser.GuiApi, state: EdgeState) -> None:
        self._gui, self._state = gui, state
        self._folder = gui.add_folder("Why", visible=False)
        with self._folder:
            self._text = gui.add_html("")
            self._button: Any = gui.add_button(
                "where in the picture?",
                hint="Paints over regions of the strongest camera's picture and sees what they were worth.",
                visible=False,
            )
        self._picture: Any = None
        self._number: int | None = None
        self._asked = False
        self._button.on_click(self._clicked)

    def refresh(self) -> None:
        """Explain the newest decision, once."""
        decided = self._state.decision()
        self._folder.visible = decided is not None
        if decided is None:
            return
        if self._asked:
            self._asked = False
            self._look(decided)
        if decided.number == self._number:
            return
        from edge_server.scheduler.learned.explain import explain

        self._number = decided.number
        self._text.content = markup.why(explain(decided.actor, decided.state, decided.action))
        self._button.visible = self._state.embed is not None and bool(decided.state.frames)

    def _clicked(self, event: Any) -> None:
        # The page's own thread does it: a visitor who clicks ten times waits ten times, nobody else does.
        self._asked = True

    def _look(self, decided: Decision) -> None:
        """Show where in the picture of the camera with the largest share."""
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
            self._show(painted(image[..., :3], regions), frame.camera)
            return

    def _show(self, image: NDArray[np.uint8], camera: str) -> None:
        if self._picture is not None:
            self._picture.remove()
        with self._folder:
            self._picture = self._gui.add_image(image, label=camera, format="jpeg", jpeg_quality=88)


def painted(image: NDArray[np.uint8], regions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """``image`` (H, W, 3), WIDTH wide, with regions in the colors of for and against, as strongly as they
    count."""
    height = max(1, round(WIDTH * image.shape[0] / max(1, image.shape[1])))
    large = cv2.resize(np.ascontiguousarray(image), (WIDTH, height), interpolation=cv2.INTER_LINEAR)
    limit = float(np.abs(regions).max())
    grid = regions / limit if limit > 0 else np.zeros_like(regions)
    # Smooth edges are easier to look through than those of the grid; the grid is coarse anyway.
    share = cv2.resize(grid, (WIDTH, height), interpolation=cv2.INTER_LINEAR)[..., None]
    color = np.where(share >= 0, np.array(FOR, float), np.array(AGAINST, float))
    mixed = large + STRENGTH * np.abs(share) * (color - large)
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)
