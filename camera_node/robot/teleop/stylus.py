"""What every stylus gives: its pose, whether the clutch is pressed, and when that was.

Adapters (keyboard, gamepad, network) are polled once a tick and give whatever came since; nothing in them is
checked against the arm, and nothing they give can hurt it (see ``limits``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import quaternion_normalize

Array = NDArray[np.float64]

# A stylus that reports positions farther than this has lost its origin.
FARTHEST_M = 10.0


@dataclass(frozen=True)
class StylusSample:
    """position_m: (3,) of the stylus in its own axes. quaternion: (4,), w first. clutch: the arm follows
    while it is pressed. t_ns: on the stylus's clock, whatever that is; only differences are used."""

    t_ns: int
    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    clutch: bool

    def is_valid(self) -> bool:
        """Whether this can be a pose at all: finite, of a quaternion that is one, within reach of a desk."""
        values = (*self.position_m, *self.quaternion)
        if len(values) != 7 or not all(map(math.isfinite, values)):
            return False
        norm = math.sqrt(sum(v * v for v in self.quaternion))
        return max(map(abs, self.position_m)) <= FARTHEST_M and 0.5 < norm < 2.0 and 0 <= self.t_ns < 2**63

    def arrays(self) -> tuple[Array, Array]:
        """Position (3,) and unit quaternion (4,) of a sound sample."""
        return np.array(self.position_m), quaternion_normalize(self.quaternion)


class Stylus(Protocol):
    """Something an operator holds."""

    @property
    def ended(self) -> bool:
        """The operator has asked to stop, or the device is gone for good."""
        ...

    def poll(self, now_ns: int) -> list[StylusSample]:
        """What came since the last call, oldest first; never blocks, never raises for bad input."""
        ...

    def close(self) -> None: ...
