"""A stylus for devices that say how fast, not where: speeds added up to a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.robot.teleop.stylus import FARTHEST_M, StylusSample
from freshfield.geometry import matrix_to_quaternion, quaternion_multiply, quaternion_normalize, so3_exp

Array = NDArray[np.float64]

# A machine that stood still longer must not make up for it.
_MAX_STEP_S = 0.05


class PoseIntegrator:
    """Position (3,) and orientation that speeds (m/s, rad/s) move. Begins at the origin."""

    def __init__(self) -> None:
        self.position: Array = np.zeros(3)
        self.quaternion: Array = np.array([1.0, 0.0, 0.0, 0.0])
        self._now_ns: int | None = None

    def advance(self, now_ns: int, speed: ArrayLike, turn: ArrayLike, clutch: bool) -> StylusSample:
        """The sample at ``now_ns``, having moved at these speeds since the last one."""
        dt_s = 0.0 if self._now_ns is None else min(max((now_ns - self._now_ns) / 1e9, 0.0), _MAX_STEP_S)
        self._now_ns = now_ns
        self.shift(np.asarray(speed, dtype=np.float64) * dt_s, np.asarray(turn, dtype=np.float64) * dt_s)
        p, q = self.position.tolist(), self.quaternion.tolist()
        return StylusSample(now_ns, (p[0], p[1], p[2]), (q[0], q[1], q[2], q[3]), clutch)

    def shift(self, way: Array, turn: Array) -> None:
        """Move by ``way`` (3,) metres and a rotation vector (3,)."""
        half = 0.5 * FARTHEST_M  # with the clutch open it may be moved for ever
        self.position = np.clip(self.position + way, -half, half)
        turned = matrix_to_quaternion(so3_exp(turn))
        self.quaternion = quaternion_normalize(quaternion_multiply(turned, self.quaternion))
