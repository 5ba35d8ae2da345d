"""Treatments of stale views before they supervise: a stale view is wrong only where something moved.

A policy chooses views (``edge_server.scheduler``). A treatment takes them, with the frame that each camera
delivered before, and gives each pixel a weight (``View.weight``); it may also warp images forward in time.
Treatments are pure functions: live and virtual time share them, and a run repeats bit for bit.

They run only where a policy's name asks for one (``threshold+freshen``). All they know of motion is in the
last two frames of one camera. So they do not change views of cameras that moved, zoomed or changed their
image size between these two, or that delivered only one frame: changes there come from the camera, and the
views remain right about the static scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from edge_server.fields import View


class Treatment(Protocol):
    """Prepares stale views to supervise the present."""

    @property
    def name(self) -> str: ...

    def treat(self, views: Sequence[View], earlier: Mapping[str, View], now_ns: int) -> list[View]:
        """Treat views.

        earlier: the view before, by camera; cameras without one are missing.
        now_ns: the present, on the clock of ``generated_ns``.
        Returns the views in their order, unchanged or with a weight and an image of their own.
        """
        ...
