"""Motion of the joints towards a command, within limits of speed and acceleration.

Time advances in steps of ``STEP_S``, as in the real controller. The same commands at the same steps give the
same motion, bit for bit.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.simulated_controller import simulated_controller_constants as tuned
from freshfield.geometry import Array

STEP_S = 0.002
_ARRIVED_RAD = 1e-9


class JointMotion:
    """Joint positions ``q`` (6,) and velocities ``qd`` in radians and seconds, advanced by ``step``."""

    def __init__(self, arm: ArmModel, joints: ArrayLike) -> None:
        self.q: Array = np.array(joints, dtype=np.float64)
        self.qd: Array = np.zeros(6)
        self.mode: Literal["idle", "move", "servo", "stop"] = "idle"
        self._limits = np.array(arm.lower_rad), np.array(arm.upper_rad), np.array(arm.speed_rad_s)
        self._target: Array = self.q.copy()
        self._speed: Array = np.zeros(6)
        self._acceleration: Array = np.zeros(6)
        self._elapsed_s = 0.0

    @property
    def moving(self) -> bool:
        return self.mode != "idle"

    def move(self, target: ArrayLike, speed_rad_s: float, acceleration_rad_s2: float) -> bool:
        """moveJ: all joints together, from rest on a straight line. Returns False for a target beyond the
        limits."""
        goal = np.array(target, dtype=np.float64)
        if not (self._within_limits(goal) and speed_rad_s > 0 and acceleration_rad_s2 > 0):
            return False
        distance = np.abs(goal - self.q)
        # Speeds and accelerations in proportion to their distances, so that all joints arrive at once; the slowest
        # joint determines the rate. An arm that is still moving is only turned round.
        share = distance / max(float(distance.max()), 1e-12) if not self.qd.any() else np.ones(6)
        fastest = float(np.min(np.minimum(speed_rad_s, self._limits[2]) / np.maximum(share, 1e-12)))
        self._target, self.mode = goal, "move"
        self._speed = fastest * share
        self._acceleration = min(acceleration_rad_s2, tuned.MAX_ACCELERATION_RAD_S2) * share
        return True

    def servo(self, target: ArrayLike) -> bool:
        """servoJ: follow ``target`` (6,), which the client may replace at any time, within the limits of
        speed and acceleration. Returns False for a target beyond the limits."""
        goal = np.array(target, dtype=np.float64)
        if not self._within_limits(goal):
            return False
        self._target, self.mode, self._elapsed_s = goal, "servo", 0.0
        self._speed, self._acceleration = self._limits[2], np.full(6, tuned.MAX_ACCELERATION_RAD_S2)
        return True

    def stop(self, deceleration_rad_s2: float = tuned.STOP_RAD_S2) -> None:
        """Come to rest at this deceleration."""
        rate = deceleration_rad_s2 if deceleration_rad_s2 > 0 else tuned.STOP_RAD_S2
        self._acceleration = np.full(6, min(rate, tuned.MAX_ACCELERATION_RAD_S2))
        self.mode = "stop" if self.qd.any() else "idle"

    def step(self) -> None:
        """Advance by ``STEP_S``."""
        self._elapsed_s += STEP_S
        if self.mode == "servo" and self._elapsed_s > tuned.SERVO_WITHOUT_COMMAND_S:
            self.stop()
        if self.mode == "idle":
            return
        left = np.zeros(6) if self.mode == "stop" else self._target - self.q
        wanted = np.sign(left) * np.minimum(_max_stoppable_speed(np.abs(left), self._acceleration), self._speed)
        most = self._acceleration * STEP_S
        self.qd = self.qd + np.clip(wanted - self.qd, -most, most)
        self.q = self.q + self.qd * STEP_S
        if self.mode == "stop" and not self.qd.any():
            self.mode = "idle"
        elif self.mode == "move" and np.abs(left).max() < _ARRIVED_RAD:
            self.q, self.qd, self.mode = self._target.copy(), np.zeros(6), "idle"

    def _within_limits(self, goal: Array) -> bool:
        low, high, _ = self._limits
        return goal.shape == (6,) and bool(np.all((goal >= low) & (goal <= high)))


def _max_stoppable_speed(room: Array, deceleration: Array) -> Array:
    """The highest speeds from which joints can still stop within ``room``, less the motion of one step."""
    lag = 0.5 * deceleration * STEP_S
    fastest: Array = np.minimum(np.sqrt(lag * lag + 2.0 * deceleration * room) - lag, room / STEP_S)
    return fastest
