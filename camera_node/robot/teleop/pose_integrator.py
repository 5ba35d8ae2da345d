"""Integrates speeds to a pose, for devices that report speeds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.robot.teleop.stylus import FARTHEST_M, StylusSample
from freshfield.geometry import matrix_to_quaternion, quaternion_multiply, quaternion_normalize, so3_exp

Array = NDArray[np.float64]

_MAX_STEP_S = 0.05  # a longer pause of the machine is not made up for


class PoseIntegrator:
    """Position (3,) and quaternion (4,) moved by speeds (m/s, rad/s), from the origin."""

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
        """Move by a distance (3,) in metres and a rotation vector (3,) in radians."""
        half = 0.5 * FARTHEST_M  # with the clutch open it may move without end
        self.position = np.clip(self.position + distance, -half, half)
        turned = matrix_to_quaternion(so3_exp(turn))
        self.quaternion = quaternion_normalize(quaternion_multiply(turned, self.quaternion))
