"""Explains a learned policy's newest decision: what contributed for and against it.

Nothing is loaded or shown while the policy is not a learned one. ``edge-server explain`` also finds where in an image.
"""

from __future__ import annotations

import viser

from edge_server.live.state import EdgeState
from edge_server.page import markup


class DecisionExplanation:
    """A folder in the current GUI container. One thread calls ``refresh``, a few times a second."""

    def __init__(self, gui: viser.GuiApi, state: EdgeState) -> None:
        self._state = state
        self._folder = gui.add_folder("Why this decision", visible=False)
        with self._folder:
            self._text = gui.add_html("")
        self._number: int | None = None

    def refresh(self) -> None:
        """Explain the newest decision if it is new."""
        decided = self._state.decision()
        self._folder.visible = decided is not None
        if decided is None or decided.number == self._number:
            return
        from edge_server.scheduler.learned.explain import explain

        self._number = decided.number
        self._text.content = markup.decision_explanation(explain(decided.actor, decided.state, decided.action))
