"""What a source of frames is: one camera, asked for the shot of a tick."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Pinhole, Pose


@dataclass(frozen=True)
class Shot:
    """What a camera saw at one instant.

    image: uint8 (H, W, 3) RGB or (H, W, 4) RGBA, or bytes in the scenario's codec; its size is that of
        ``intrinsics``.
    pose_gap_ns: time between the exposure and the pose sample that it was paired with.
    captured_ns: when a real camera exposed it, on the node's clock; None: at the tick it was asked for.
    """

    image: NDArray[np.uint8] | bytes
    pose: Pose
    intrinsics: Pinhole
    pose_gap_ns: int = 0
    captured_ns: int | None = None


def rate(fps: float) -> Fraction:
    """A frame rate as an exact fraction: 29.97 is 2997/100, 33.3333 is 100/3."""
    return Fraction(fps).limit_denominator(1001)


class Source(ABC):
    """One camera. Tick k is the instant k / fps since the epoch, and phase_ns later, so that cameras in
    different processes look at the same world.

    contents: number of different shots before they repeat; None if they never do.
    """

    camera: str
    fps: Fraction
    intrinsics: Pinhole
    contents: int | None = None
    phase_ns: int = 0

    def content(self, tick: int) -> int:
        """Which shot a tick shows, 0 .. contents - 1; the tick itself where nothing repeats."""
        return tick

    @abstractmethod
    def read(self, content: int) -> Shot:
        """Render, read or decode one shot. Raises ValueError (DatasetError, PoseGapError) for a shot that is
        not available; others may still be."""

    def prepare(self, stopped: Callable[[], bool]) -> None:  # noqa: B027
        """Render or decode ahead, so that ``read`` is fast. Returns when that is done, or ``stopped()``."""

    def release(self) -> None:  # noqa: B027
        """Free what making shots needs (decoders, renderers). ``read`` gets it again."""
