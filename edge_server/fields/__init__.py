"""Radiance fields behind one small protocol: fit a view set within a budget, render a camera, save, load.

A representation is one folder here and one line in ``registry``, which says what a folder must have. The
tests of all representations find what they need in ``tests/edge_server/fields/small.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Pinhole

SEPARATOR = "#"
"""Between a camera's name and the number of its keyframe (``hand#3``): no camera's name may hold it."""


@dataclass(frozen=True)
class View:
    """One decoded, posed image that supervises a field.

    image: uint8 (H, W, 3) RGB, or (H, W, 4) straight-alpha RGBA; matches ``intrinsics``.
    camera_to_world: float64 (4, 4), OpenCV axes, meters.
    generated_ns: capture time, edge clock.
    weight: float32 (H, W) in [0, 1], how much each pixel supervises; None: all of them in full.
    depth: float32 (H, W), measured depth along the optical axis of each pixel of ``image``, meters; 0 where nothing was
    measured. None: this frame brings none.
    depth_ns: when it was measured, edge clock; None: with the image.
    whole: where ``image`` was decoded smaller (``Field.most_pixels``), decodes the same frame at its full
    resolution and returns that view, or None if the frame is damaged.
    """

    camera: str
    image: NDArray[np.uint8]
    camera_to_world: NDArray[np.float64]
    intrinsics: Pinhole
    generated_ns: int = 0
    weight: NDArray[np.float32] | None = None
    depth: NDArray[np.float32] | None = None
    depth_ns: int | None = None
    whole: Callable[[], View | None] | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class Budget:
    """What one fit may spend: wall seconds (live) or optimizer steps (virtual time)."""

    seconds: float | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        if (self.seconds is None) == (self.steps is None):
            raise ValueError("a budget is either seconds or steps")
        if not 0 <= (self.steps if self.seconds is None else self.seconds) < math.inf:  # type: ignore[operator]
            raise ValueError(f"a budget is finite and not negative, not {self}")


@dataclass(frozen=True)
class FitReport:
    """What one fit did: optimizer steps, wall seconds, mean loss of the last steps, rays and samples.

    dropped: rays and gradients that were not finite and were left out.
    refused: cameras whose view contradicts the others' background, and was left out (``splat`` in layers).
    note: why nothing was done, if so.
    short: whether there was no time for a step.
    """

    steps: int
    seconds: float
    loss: float
    rays: int
    samples: int
    dropped: int = 0
    refused: tuple[str, ...] = ()
    note: str = ""
    short: bool = False


@dataclass(frozen=True)
class Rendering:
    """color float32 (H, W, 3) in [0, 1]; depth float32 (H, W), meters along the ray (0 where empty);
    opacity float32 (H, W) in [0, 1]."""

    color: NDArray[np.float32]
    depth: NDArray[np.float32]
    opacity: NDArray[np.float32]


@dataclass(frozen=True)
class Correction:
    """How a field renders what a camera saw, where it has learned that poses and exposures are inexact.

    camera_to_world: (4, 4), where to render from.
    gain, bias: (3,), by channel, from a rendering's colors to those of the image.
    """

    camera_to_world: NDArray[np.float64]
    gain: NDArray[np.float64]
    bias: NDArray[np.float64]

    def exposed(self, color: NDArray[np.float32]) -> NDArray[np.float32]:
        """A rendering (H, W, 3) at the image's exposure, in [0, 1]."""
        return np.clip(color * self.gain + self.bias, 0.0, 1.0).astype(np.float32)


@runtime_checkable
class RefinesCameras(Protocol):
    """A field that may correct the poses and exposures of its views."""

    def correction(self, view: View) -> Correction | None:
        """How to render what ``view`` saw, without looking at its image: by its own correction if the field learns
        from it, else by those of the views taken before and after it. None: the field corrects nothing."""
        ...


class Renderer(Protocol):
    """Renders one scene; safe to use from any thread while a field trains on."""

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """Render a camera. camera_to_world: (4, 4), OpenCV axes, meters."""
        ...


class Snapshot(Renderer, Protocol):
    """An immutable copy of a field."""

    def at(self, present_ns: int) -> Snapshot:
        """The same field at another instant, where a representation knows how things move; itself elsewhere.

        present_ns: on the clock of the views' ``generated_ns``.
        """
        ...


class Field(Renderer, Protocol):
    """A radiance field. Every implementation is deterministic for one seed and one sequence of calls.

    frame_s: seconds that ``fit`` takes for each new frame (0.0: not known yet), if the field now wants every
    frame since the last fit. None: it wants only the newest frame of each camera.
    most_pixels: largest number of pixels of one image of every camera together, if larger images would take
    too much time for following what moves; None: no limit.
    views: newest view of each camera that it learns from.
    """

    @property
    def frame_s(self) -> float | None: ...
    @property
    def most_pixels(self) -> int | None: ...
    @property
    def views(self) -> tuple[View, ...]: ...

    def fit(self, views: Sequence[View], budget: Budget) -> FitReport:
        """Warm-start from the present parameters and train on ``views``. An empty set does nothing. Raises
        ValueError for a view that no field can use."""
        ...

    def snapshot(self, present_ns: int | None = None) -> Snapshot:
        """The field as it is now, for others to render from while it trains on.

        present_ns: the instant to show, on the clock of the views' ``generated_ns``, where a representation
        knows how things move; None: that of its newest view.
        """
        ...

    def warm_up(self, cameras: int | None = None) -> float:
        """Compile or load every kernel, so that the first fit is as fast as others; returns the seconds.

        cameras: how many there will be, where that is known: few may need kernels of their own.
        """
        ...

    def state(self) -> dict[str, NDArray]:
        """Everything needed to continue bit for bit: plain arrays, no pickle."""
        ...

    def load_state(self, state: dict[str, NDArray]) -> None:
        """Continue from ``state``. ValueError if this field cannot; it then stays as it was."""
        ...

    def reset(self) -> None:
        """Forget the scene (4.4.4's manual reset); keep the settings and the compiled kernels."""
        ...
