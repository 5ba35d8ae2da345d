"""What is done to stale views before they supervise: a stale view is only wrong where something moved.

A policy chooses views (``edge_server.scheduler``), a treatment says what of them is still true: it takes the
chosen views and the frame each camera delivered before, and gives views whose pixels are weighed
(``View.weight``) and may have been carried forward in time. Pure functions of what they are given: live and
virtual time share them, and a run repeats bit for bit.

Treatments run only where a policy's name asks for one (``threshold+freshen``). They know of motion only what
one camera's last two frames show, so they leave alone the views of cameras that moved, zoomed or changed
their size between the two, and of those that have delivered one frame only: what changed there is the
camera's own doing, and their views stay as true of the static scene as they were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from edge_server.fields import View


class Treatment(Protocol):
    """Makes stale views fit to supervise the present."""

    @property
    def name(self) -> str: ...

    def treat(self, views: Sequence[View], earlier: Mapping[str, View], now_ns: int) -> list[View]:
        """The views, in their order, each as it is or with a weight and an image of its own.

        earlier: camera -> the view it delivered before; cameras without one are missing. now_ns: the present,
        on the clock of ``generated_ns``.
        """
        ...
