"""Which frame of a recording a tick shows: at the recording's own rate, looping for ever."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction


def rate(fps: float) -> Fraction:
    """A frame rate as an exact fraction: 29.97 is 2997/100, 33.3333 is 100/3."""
    return Fraction(fps).limit_denominator(1001)


@dataclass(frozen=True)
class Playback:
    """``count`` frames recorded at ``recorded_fps`` and captured at ``fps``.

    back_and_forth: 0 1 2 3 2 1 0 1 ..., so that motion never jumps; otherwise 0 1 2 3 0 1 ...
    """

    count: int
    fps: Fraction
    recorded_fps: Fraction
    back_and_forth: bool = True

    def frame(self, tick: int) -> int:
        """The frame nearest to the tick's instant."""
        position = (2 * tick * self.recorded_fps + self.fps) // (2 * self.fps)  # rounds half up, exactly
        if not self.back_and_forth:
            return int(position % self.count)
        period = max(1, 2 * (self.count - 1))
        place = int(position % period)
        return place if place < self.count else period - place
