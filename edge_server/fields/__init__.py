"""Radiance fields behind one small protocol: fit a view set within a budget, render a camera, save, load.

Adding a representation NAME is one file here with its settings beside it (``NAME_settings``: the class
``NameSettings``, ``EFFORTS``, ``make_settings``, ``help_text``), its kernels in ``kernels/``, and a line in
``registry``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Pinhole


@dataclass(frozen=True)
class View:
    """One decoded, posed image that supervises a field.

    image: uint8 (H, W, 3) RGB, or (H, W, 4) straight-alpha RGBA; matches ``intrinsics``.
    camera_to_world: float64 (4, 4), OpenCV axes, metres. generated_ns: capture time, edge clock.
    weight: float32 (H, W) in [0, 1], how much each pixel supervises; None: all of them in full.
    carried_to_ns: the instant that the image has been carried forward to since its capture
    (``treatments.freshen``); None: it shows the instant of its capture.
    """

    camera: str
    image: NDArray[np.uint8]
    camera_to_world: NDArray[np.float64]
    intrinsics: Pinhole
    generated_ns: int = 0
    weight: NDArray[np.float32] | None = None
    carried_to_ns: int | None = None

    @property
    def shows_ns(self) -> int:
        """The instant that the image shows. Ages are reported by capture; what a field makes of time (how
        things move, whom to trust less) goes by this."""
        return self.generated_ns if self.carried_to_ns is None else self.carried_to_ns


@dataclass(frozen=True)
class Budget:
    """What one fit may spend: wall seconds (live) or optimiser steps (virtual time). One of the two."""

    seconds: float | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        if (self.seconds is None) == (self.steps is None):
            raise ValueError("a budget is either seconds or steps")
        if not 0 <= (self.steps if self.seconds is None else self.seconds) < math.inf:  # type: ignore[operator]
            raise ValueError(f"a budget is finite and not negative, not {self}")


@dataclass(frozen=True)
class FitReport:
    """What one fit did: optimiser steps, wall seconds, mean loss of the last steps, rays and samples.

    dropped: rays and gradients that were not finite and were left out. refused: cameras whose view was left
    out because it contradicts all that is known (``trust.refused``). note: why nothing was done, if so.
    """

    steps: int
    seconds: float
    loss: float
    rays: int
    samples: int
    dropped: int = 0
    refused: tuple[str, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class Rendering:
    """color float32 (H, W, 3) in [0, 1]; depth float32 (H, W), metres along the ray (0 where empty);
    opacity float32 (H, W) in [0, 1]."""

    color: NDArray[np.float32]
    depth: NDArray[np.float32]
    opacity: NDArray[np.float32]


class Renderer(Protocol):
    """An immutable snapshot of a field; safe to use from any thread while the field trains on."""

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering: ...

    def points(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Up to ``count`` surface points (N, 3) in world metres and colours (N, 3) in [0, 1]."""
        ...


class Field(Renderer, Protocol):
    """A radiance field. Every implementation is deterministic for one seed and one sequence of calls."""

    def fit(self, views: Sequence[View], budget: Budget) -> FitReport:
        """Warm-start from the present parameters and train on ``views``. An empty set does nothing."""
        ...

    def snapshot(self, present_ns: int | None = None) -> Renderer:
        """The field as it is now, for others to render from while it trains on. present_ns: the instant it is
        to show, on the clock of the views' ``generated_ns``, where a representation knows how things move;
        none: that of its newest view."""
        ...

    def warm_up(self) -> float:
        """Compile or load every kernel, so that the first fit is not the slow one; seconds it took."""
        ...

    def state(self) -> dict[str, NDArray]:
        """Everything needed to go on as if nothing had happened: plain arrays, no pickle."""
        ...

    def load_state(self, state: dict[str, NDArray]) -> None:
        """Go on where ``state`` was taken. ValueError where this field cannot; it then stays as it was."""
        ...

    def reset(self) -> None:
        """Forget the scene (4.4.4's manual reset); keep the settings and the compiled kernels."""
        ...
