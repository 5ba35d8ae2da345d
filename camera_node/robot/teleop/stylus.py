"""The samples of every stylus: pose, clutch and time.

Adapters (keyboard, network) are polled once per tick. They do not know the arm; ``limits`` makes
every sample safe for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import quaternion_normalize

Array = NDArray[np.float64]

FARTHEST_M = 10.0
"""Positions farther from the origin are invalid."""


@dataclass(frozen=True)
class StylusSample:
    """One sample of a stylus.

    t_ns: on any clock; only differences are used.
    position_m: (3,) in the stylus's own axes.
    quaternion: (4,), w first.
    clutch: the arm follows while it is pressed.
    """

    t_ns: int
    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    clutch: bool

    def is_valid(self) -> bool:
        """Whether this is a possible pose: finite, with a quaternion of about unit length, and not too
        far."""
        values = (*self.position_m, *self.quaternion)
        if len(values) != 7 or not all(map(math.isfinite, values)):
            return False
        norm = math.sqrt(sum(v * v for v in self.quaternion))
        return max(map(abs, self.position_m)) <= FARTHEST_M and 0.5 < norm < 2.0 and 0 <= self.t_ns < 2**63

    def arrays(self) -> tuple[Array, Array]:
        """Position (3,) and unit quaternion (4,) of a valid sample."""
        return np.array(self.position_m), quaternion_normalize(self.quaternion)


class Stylus(Protocol):
    """An input device in the operator's hand."""

    @property
    def ended(self) -> bool:
        """Whether the operator asked to stop, or the device is gone."""
        ...

    def poll(self, now_ns: int) -> list[StylusSample]:
        """Samples since the last call, oldest first. Never blocks, and never raises for bad input."""
        ...

    def close(self) -> None: ...
