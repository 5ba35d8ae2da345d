"""Motion of the joints towards a command, within limits of speed and acceleration.

Time advances in steps of ``STEP_S``, as in the real controller. The same commands at the same steps give the
same motion, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.robot.arm.kinematics import ArmModel

Array = NDArray[np.float64]
Mode = Literal["idle", "move", "servo", "stop"]

STEP_S = 0.002
MAX_ACCELERATION_RAD_S2 = 40.0
"""Bound of every command. UR's default for moveJ is 1.4."""
STOP_RAD_S2 = 10.0
_SERVO_WITHOUT_COMMAND_S = 0.2


class JointMotion:
    """Joint positions (6,), velocities and accelerations in radians and seconds, stepped by ``step``."""

    def __init__(self, arm: ArmModel, joints: ArrayLike) -> None:
        self.arm = arm
        self.q: Array = np.array(joints, dtype=np.float64)
        self.qd: Array = np.zeros(6)
        self.qdd: Array = np.zeros(6)
        self.target: Array = self.q.copy()
        self.mode: Mode = "idle"
        self._speed = np.array(arm.speed_rad_s)
        self._low, self._high = np.array(arm.lower_rad), np.array(arm.upper_rad)
        self._start = self.q.copy()
        self._ramp: _Ramp | None = None
        self._elapsed_s = 0.0
        self._deceleration = STOP_RAD_S2
        self._next: tuple[Array, float, float] | None = None

    @property
    def moving(self) -> bool:
        return self.mode != "idle"

    @property
    def at_rest(self) -> bool:
        return not self.qd.any()

    def move(self, target: ArrayLike, speed_rad_s: float, acceleration_rad_s2: float) -> bool:
        """moveJ: move all joints together, from rest to rest. An arm that is still moving stops first.
        Returns False for a target beyond the limits."""
        goal = np.array(target, dtype=np.float64)
        if not self._within_limits(goal) or not speed_rad_s > 0 or not acceleration_rad_s2 > 0:
            return False
        if not self.at_rest:
            self.stop()
            self._next = (goal, speed_rad_s, acceleration_rad_s2)
            return True
        distance = np.abs(goal - self.q)
        self._start, self.target = self.q.copy(), goal
        farthest = float(distance.max())
        if farthest < 1e-12:
            return True
        # The slowest joint determines the rate at which s runs from 0 to 1 for all of them.
        rate = float(np.min(np.minimum(speed_rad_s, self._speed) / np.maximum(distance, 1e-12)))
        self._ramp = _Ramp(rate, min(acceleration_rad_s2, MAX_ACCELERATION_RAD_S2) / farthest)
        self._elapsed_s, self.mode = 0.0, "move"
        return True

    def servo(self, target: Sequence[float]) -> bool:
        """servoJ: follow ``target`` (6,), which the client may replace at any time, within the limits of
        speed and acceleration. Returns False for a target beyond the limits."""
        goal = np.array(target, dtype=np.float64)
        if not self._within_limits(goal):
            return False
        self.target, self.mode, self._elapsed_s, self._next = goal, "servo", 0.0, None
        return True

    def stop(self, deceleration_rad_s2: float = STOP_RAD_S2) -> None:
        """Come to rest at this deceleration."""
        rate = deceleration_rad_s2 if deceleration_rad_s2 > 0 else STOP_RAD_S2
        self._deceleration = min(rate, MAX_ACCELERATION_RAD_S2)
        self.mode = "stop" if not self.at_rest else "idle"
        self._next = None

    def step(self) -> None:
        """Advance by ``STEP_S``."""
        if self.mode == "idle":
            return
        before = self.qd
        if self.mode == "move":
            self._follow_ramp()
        else:
            wanted, acceleration = self._target_velocity()
            change = np.clip(wanted - self.qd, -acceleration * STEP_S, acceleration * STEP_S)
            self.qd = np.clip(self.qd + change, -self._speed, self._speed)
            self.q = self.q + self.qd * STEP_S
            if self.mode == "stop" and self.at_rest:
                self.mode = "idle"
                if self._next is not None:
                    self.move(*self._next)
                    self._next = None
        self.qdd = (self.qd - before) / STEP_S

    def _follow_ramp(self) -> None:
        assert self._ramp is not None
        self._elapsed_s += STEP_S
        path = self.target - self._start
        s, rate = self._ramp.at(self._elapsed_s)
        self.q, self.qd = self._start + s * path, rate * path
        if s >= 1.0:
            self.q, self.qd, self.mode = self.target.copy(), np.zeros(6), "idle"

    def _target_velocity(self) -> tuple[Array, float]:
        """Joint speeds to reach, and the acceleration allowed."""
        if self.mode == "stop":
            return np.zeros(6), self._deceleration
        self._elapsed_s += STEP_S
        if self._elapsed_s > _SERVO_WITHOUT_COMMAND_S:
            self.stop()
            return np.zeros(6), self._deceleration
        left = self.target - self.q
        most = _max_stoppable_speed(np.abs(left), MAX_ACCELERATION_RAD_S2)
        return np.sign(left) * np.minimum(most, self._speed), MAX_ACCELERATION_RAD_S2

    def _within_limits(self, goal: Array) -> bool:
        return bool(
            goal.shape == (6,) and np.isfinite(goal).all() and np.all(goal >= self._low) and np.all(goal <= self._high)
        )


def _max_stoppable_speed(room: Array, deceleration: float) -> Array:
    """The highest speed from which a joint can still stop within ``room``, less the motion of one step."""
    lag = 0.5 * deceleration * STEP_S
    fastest: Array = np.minimum(np.sqrt(lag * lag + 2.0 * deceleration * room) - lag, room / STEP_S)
    return fastest


class _Ramp:
    """s(t) from 0 to 1 with a trapezoidal rate: up to ``rate`` at ``acceleration``, and down again (a
    triangle if there is no time to reach ``rate``)."""

    def __init__(self, rate: float, acceleration: float) -> None:
        self.acceleration = acceleration
        self.rise_s = min(rate / acceleration, math.sqrt(1.0 / acceleration))
        self.rate = acceleration * self.rise_s
        self.total_s = 2.0 * self.rise_s + max(0.0, 1.0 / self.rate - self.rise_s)

    def at(self, t_s: float) -> tuple[float, float]:
        """s and its rate."""
        if t_s >= self.total_s:
            return 1.0, 0.0
        if t_s < self.rise_s:
            return 0.5 * self.acceleration * t_s * t_s, self.acceleration * t_s
        left_s = self.total_s - t_s
        if left_s < self.rise_s:
            return 1.0 - 0.5 * self.acceleration * left_s * left_s, self.acceleration * left_s
        return self.rate * (t_s - 0.5 * self.rise_s), self.rate
