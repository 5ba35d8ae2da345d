"""Limits of every tick: joint speeds that keep all limits now, and from which the arm can always stop.

Time advances in ticks of ``dt``. A state is (q, v); a tick chooses v' and sets q' = q + v' dt.

*Each joint by itself.* Stopping from v takes ``stop_way(v) = dt (v + (v - a dt) + (v - 2 a dt) + ...)`` over
the positive terms, the first of which is v itself. The rule is: choose v' with |v' - v| <= a dt, |v'| <=
v_max, and ``stop_way(v') <= upper - q`` (likewise for the lower limit). This is always possible: if v obeys
the rule, then v' = v - a dt (or 0, if that is negative) has
``stop_way(v') = stop_way(v) - v dt <= upper - q_before - v dt = upper - q``. At rest the rule holds for every
q within its limits. So by induction no joint ever leaves them.

*All joints together.* Box, floor, the flange's speed and the distance between the arm's parts depend on all
joints. There the stop itself is the proof: before a tick is accepted, every tick of the stop that would
follow it (each joint at its full deceleration) is computed and checked. If one of them breaks a limit,
smaller steps are tried, and finally the stop that was checked with the tick before.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.capsules import PAIRS, PARTS, CapsuleModel
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.teleop.settings import TeleopConfig
from freshfield.geometry import Array

# Limits are this much tighter than configured, because sums over a stop round differently at each tick.
_ROUNDING = 1e-9
_STEP_FRACTIONS = (1.0, 0.5, 0.2)


class JointLimits:
    """Limits of each joint by itself.

    low, high: joint limits (n,), radians.
    speed, acceleration: of every joint, rad/s and rad/s^2.
    dt_s: length of a tick.
    """

    def __init__(self, low: ArrayLike, high: ArrayLike, speed: float, acceleration: float, dt_s: float) -> None:
        self.low = np.asarray(low, dtype=np.float64) + _ROUNDING
        self.high = np.asarray(high, dtype=np.float64) - _ROUNDING
        self.dt_s = dt_s
        self._speed = speed * (1.0 - _ROUNDING)
        self._change = acceleration * dt_s * (1.0 - _ROUNDING)

    def clamp(self, q: Array, v: Array, wanted: Array) -> Array:
        """Speeds (n,) of the next tick, as close to ``wanted`` as the limits allow."""
        up = np.minimum(self._speed, self._max_stoppable_speed(self.high - q))
        down = np.maximum(-self._speed, -self._max_stoppable_speed(q - self.low))
        change = np.minimum(np.maximum(wanted, down), up) - v
        # All changes are scaled alike, by the largest one, so that the flange keeps its direction.
        most = float(np.abs(change).max())
        change *= min(1.0, self._change / most) if most > 0.0 else 1.0
        allowed = np.minimum(np.maximum(v + change, down), up)
        # This clamp comes last, because by the proof above it corrects rounding only.
        return np.minimum(np.maximum(allowed, v - self._change), v + self._change)

    def stopping(self, v: Array) -> Array:
        """Speeds (n,) of the first tick of a stop."""
        return np.sign(v) * np.maximum(np.abs(v) - self._change, 0.0)

    def stop(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Joints and speeds (T, n) of a stop from (q, v), beginning with that state."""
        ticks = int(np.ceil(np.abs(v).max() / self._change)) if v.any() else 0
        left = np.abs(v) - self._change * np.arange(ticks + 1)[:, None]
        speeds = np.sign(v) * np.maximum(left, 0.0)
        moved = np.cumsum(speeds[1:], axis=0) * self.dt_s
        return np.concatenate([q[None], q + moved]), speeds

    def _max_stoppable_speed(self, room: Array) -> Array:
        """The largest v with ``stop_way(v) <= room``. If v is n whole steps of deceleration and a remainder,
        stop_way is ``dt ((n + 1) v - a dt n (n + 1) / 2)``; at v = n a dt it is ``a dt^2 n (n + 1) / 2``."""
        room = np.maximum(room, 0.0)
        unit = self._change * self.dt_s
        n = np.floor((np.sqrt(1.0 + 8.0 * room / unit) - 1.0) / 2.0)
        fastest: Array = room / ((n + 1.0) * self.dt_s) + self._change * n / 2.0
        return fastest


class Limiter:
    """Joints ``q`` (6,) and speeds ``v`` (6,) that keep every limit of a TeleopConfig. The arm starts at rest
    at ``joints`` (6,). Raises ArmError if these break a limit.

    refused: numbers of ticks in which a limit reduced the speeds, or the wanted speeds were invalid
        (unsound).
    """

    def __init__(self, arm: ArmModel, config: TeleopConfig, joints: ArrayLike) -> None:
        self.config, self.dt_s = config, 1.0 / config.rate_hz
        margin = config.joint_margin_rad
        low, high = np.array(arm.lower_rad) + margin, np.array(arm.upper_rad) - margin
        speed = min(config.speed_rad_s, *arm.speed_rad_s)
        self.joint_limits = JointLimits(low, high, speed, config.acceleration_rad_s2, self.dt_s)
        self.shape = CapsuleModel(arm, config.tool_m, config.tool_radius_m)
        self.refused = dict.fromkeys(("box", "floor", "speed", "near", "unsound"), 0)
        self._low_m = np.array(config.workspace_low_m) + _ROUNDING
        self._high_m = np.array(config.workspace_high_m) - _ROUNDING
        self.q: Array = np.array(joints, dtype=np.float64)
        self.v: Array = np.zeros(6)
        self._check_start()

    def step(self, wanted: ArrayLike) -> tuple[Array, Array]:
        """One tick towards joint speeds ``wanted`` (6,), which may be any value. Returns joints and speeds
        (6,)."""
        speeds = np.asarray(wanted, dtype=np.float64)
        if speeds.shape != (6,) or not np.isfinite(speeds).all():
            self.refused["unsound"] += 1
            speeds = np.zeros(6)
        limits = self.joint_limits
        asked, stopping = limits.clamp(self.q, self.v, speeds), limits.stopping(self.v)
        chosen = stopping
        for k, share in enumerate(_STEP_FRACTIONS):
            tried = stopping + share * (asked - stopping)
            violated = self._violated_limit(self.q + tried * self.dt_s, tried)
            if violated is None:
                chosen = tried
                break
            if k == 0:
                self.refused[violated] += 1
        self.q, self.v = self.q + chosen * self.dt_s, chosen
        return self.q.copy(), self.v.copy()

    def _violated_limit(self, q: Array, v: Array) -> str | None:
        """The limit that a stop from (q, v) would break, or None."""
        path, _ = self.joint_limits.stop(q, v)
        arm = self.shape.arm
        frames = arm.link_frames(np.concatenate([self.q[None], path]))
        flange = frames[:, 6, :3, 3]
        if np.any(flange[1:] < self._low_m) or np.any(flange[1:] > self._high_m):
            return "box"
        steps = np.diff(flange, axis=0)
        most = (self.config.speed_m_s * self.dt_s) ** 2 * (1.0 - _ROUNDING)
        if np.einsum("ij,ij->i", steps, steps).max() > most:
            return "speed"
        apart, lowest = self.shape.clearance(
            frames[1:] if arm.nominal_model is arm else arm.nominal_model.link_frames(path)
        )
        if lowest.min() < self.config.floor_m + _ROUNDING:
            return "floor"
        return "near" if apart.min() < self.config.margin_m + _ROUNDING else None

    def _check_start(self) -> None:
        """Raise ArmError if the arm breaks a limit at the start."""
        q = self.q
        if q.shape != (6,) or not np.isfinite(q).all():
            raise ArmError("the arm gives no joint angles")
        limits = self.joint_limits
        if np.any(q < limits.low) or np.any(q > limits.high):
            joint = int(np.argmax(np.maximum(limits.low - q, q - limits.high)))
            raise ArmError(
                f"joint {joint + 1} stands at {np.degrees(q[joint]):.1f} degrees, within joint_margin_rad of "
                "its limit: turn it back with the pendant"
            )
        violated = self._violated_limit(q, self.v)
        if violated is not None:
            raise ArmError(
                f"{self._show_violation(violated)}: move the arm with the pendant, or change source.arm.teleop"
            )

    def _show_violation(self, limit: str) -> str:
        """How the arm, at rest, breaks ``limit`` (box, floor or near): for people."""
        config, arm = self.config, self.shape.arm
        if limit == "box":
            at = np.round(arm.forward(self.q)[:3, 3], 3).tolist()
            low, high = list(config.workspace_low_m), list(config.workspace_high_m)
            return f"the flange stands at {at} m, outside workspace_low_m {low} to workspace_high_m {high}"
        apart, lowest = self.shape.clearance(arm.nominal_model.link_frames(self.q[None]))
        if limit == "floor":
            return f"a part of the arm is {1e3 * lowest[0]:.1f} mm high, below floor_m, {1e3 * config.floor_m:g} mm"
        first, second = PAIRS[int(apart[0].argmin())]
        return (
            f"{PARTS[first]} and {PARTS[second]} are {1e3 * apart.min():.1f} mm apart, nearer than margin_m, "
            f"{1e3 * config.margin_m:g} mm"
        )
