"""A contestant of the race."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View


class PeerMissing(RuntimeError):
    """A peer that is not installed; the message says what is missing."""


@dataclass(frozen=True)
class Contestant:
    """A method that is trained on a scene.

    train: trains for about the given seconds; returns the seconds that it took.
    render: renders a view as float32 (H, W, 3) in [0, 1].
    steps: number of optimizer steps so far.
    close: called once, at the end.
    """

    train: Callable[[float], float]
    render: Callable[[View], NDArray[np.float32]]
    steps: Callable[[], int]
    close: Callable[[], None] = lambda: None


def on_white(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Convert an image (H, W, 3 or 4) to colors (H, W, 3) in [0, 1], over white."""
    unit = image.astype(np.float32) / 255.0
    return unit[..., :3] * unit[..., 3:] + (1.0 - unit[..., 3:]) if unit.shape[2] == 4 else unit
