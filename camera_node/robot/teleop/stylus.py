"""The samples of every stylus: pose, clutch and time.

Adapters (keyboard, gamepad, network) are polled once per tick. They do not know the arm; ``limits`` makes
every sample safe for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from freshfield.geometry import matrix_to_quaternion, quaternion_multiply, quaternion_normalize, so3_exp

Array = NDArray[np.float64]

FARTHEST_M = 10.0
"""Positions farther from the origin are invalid."""
_MAX_STEP_S = 0.05  # a longer pause of the machine is not made up for


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


class PoseIntegrator:
    """Position (3,) and quaternion (4,) of a device that reports speeds (m/s, rad/s), from the origin on."""

    def __init__(self) -> None:
        self.position: Array = np.zeros(3)
        self.quaternion: Array = np.array([1.0, 0.0, 0.0, 0.0])
        self._now_ns: int | None = None

    def advance(self, now_ns: int, speed: ArrayLike, turn: ArrayLike, clutch: bool) -> StylusSample:
        """The sample at ``now_ns``, after a motion at these speeds since the last one."""
        dt_s = 0.0 if self._now_ns is None else min(max((now_ns - self._now_ns) / 1e9, 0.0), _MAX_STEP_S)
        self._now_ns = now_ns
        self.shift(np.asarray(speed, dtype=np.float64) * dt_s, np.asarray(turn, dtype=np.float64) * dt_s)
        p, q = self.position.tolist(), self.quaternion.tolist()
        return StylusSample(now_ns, (p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]), clutch)

    def shift(self, distance: Array, turn: Array) -> None:
        """Move by a distance (3,) in meters and a rotation vector (3,) in radians."""
        half = 0.5 * FARTHEST_M  # with the clutch open it may move without end
        self.position = np.clip(self.position + distance, -half, half)
        turned = matrix_to_quaternion(so3_exp(turn))
        self.quaternion = quaternion_normalize(quaternion_multiply(turned, self.quaternion))
