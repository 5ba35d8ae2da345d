"""Limits of every tick: joint speeds that keep all limits now, and from which the arm can always stop.

Time advances in ticks of ``dt``. A state is (q, v); a tick chooses v' within the limits of speed and acceleration, and
sets q' = q + v' dt. Joint limits, box, floor, the flange's speed and the distance between the arm's parts are kept by
one rule, whose proof is the stop itself: before a tick is accepted, every tick of the stop that would follow it (each
joint at its full deceleration) is computed and checked. If one of them breaks a limit, smaller steps are tried, and
finally the stop that was checked with the tick before. So by induction the arm can always stop within its limits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.capsules import PAIRS, PARTS, CapsuleModel
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.settings import TeleopConfig
from camera_node.robot.teleop import teleop_constants as tuned
from freshfield.geometry import Array

# Limits are this much tighter than configured, because sums over a stop round differently at each tick.
_ROUNDING = 1e-9


class JointRates:
    """Limits of the joints' speeds and accelerations.

    low, high: joint limits (n,), radians, before which the joints slow down.
    speed, acceleration: of every joint, rad/s and rad/s^2.
    dt_s: length of a tick.
    """

    def __init__(self, low: Array, high: Array, speed: float, acceleration: float, dt_s: float) -> None:
        self.low, self.high, self.dt_s = low, high, dt_s
        self._speed = speed * (1.0 - _ROUNDING)
        self._change = acceleration * dt_s * (1.0 - _ROUNDING)

    def clamp(self, q: Array, v: Array, wanted: Array) -> Array:
        """Speeds (n,) of the next tick, as close to ``wanted`` as the limits allow."""
        up, down = self._stoppable(self.high - q), -self._stoppable(q - self.low)
        change = np.minimum(np.maximum(wanted, down), up) - v
        # All changes are scaled alike, by the largest one, so that the flange keeps its direction.
        most = float(np.abs(change).max())
        change *= min(1.0, self._change / most) if most > 0.0 else 1.0
        allowed = np.minimum(np.maximum(v + change, down), up)
        return np.minimum(np.maximum(allowed, v - self._change), v + self._change)

    def stopping(self, v: Array) -> Array:
        """Speeds (n,) of the first tick of a stop."""
        return np.sign(v) * np.maximum(np.abs(v) - self._change, 0.0)

    def stop(self, q: Array, v: Array) -> Array:
        """Joints (T, n) of a stop from (q, v), beginning with that state."""
        ticks = int(np.ceil(np.abs(v).max() / self._change)) if v.any() else 0
        left = np.abs(v) - self._change * np.arange(1, ticks + 1)[:, None]
        moved = np.cumsum(np.sign(v) * np.maximum(left, 0.0), axis=0) * self.dt_s
        return np.concatenate([q[None], q + moved])

    def _stoppable(self, room: Array) -> Array:
        """Speeds (n,) from which the joints stop within ``room`` (n,): the root of v^2 / (2 a) + v dt / 2 + a dt^2 / 8,
        which is at least the way of the stop's ticks."""
        half = self._change / 2.0
        fastest = np.sqrt(np.maximum(2.0 * self._change * room / self.dt_s, half**2)) - half
        return np.minimum(fastest, self._speed)


class Limiter:
    """Joints ``q`` (6,) and speeds ``v`` (6,) that keep every limit of a TeleopConfig. The arm starts at rest
    at ``joints`` (6,). Raises ArmError if these break a limit.

    refused: numbers of ticks in which a limit reduced the speeds, or the wanted speeds were invalid
        (unsound).
    """

    def __init__(self, arm: ArmModel, config: TeleopConfig, joints: ArrayLike) -> None:
        self.config, self.dt_s = config, 1.0 / config.rate_hz
        margin = config.joint_margin_rad
        low, high = np.array(arm.lower_rad) + margin + _ROUNDING, np.array(arm.upper_rad) - margin - _ROUNDING
        speed = min(config.speed_rad_s, *arm.speed_rad_s)
        self.rates = JointRates(low, high, speed, config.acceleration_rad_s2, self.dt_s)
        self.shape = CapsuleModel(arm, config.tool_m, config.tool_radius_m)
        self.refused = dict.fromkeys(("joint", "box", "floor", "speed", "near", "unsound"), 0)
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
        limits = self.rates
        asked, stopping = limits.clamp(self.q, self.v, speeds), limits.stopping(self.v)
        chosen = stopping
        for k, share in enumerate(tuned.STEP_FRACTIONS):
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
        path, arm = self.rates.stop(q, v), self.shape.arm
        # A joint that rests at its end, to a rounding error, holds no other.
        if np.maximum(self.rates.low - path, path - self.rates.high).max() > 0.5 * _ROUNDING:
            return "joint"
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
        violated = self._violated_limit(q, self.v)
        if violated is not None:
            raise ArmError(
                f"{self._show_violation(violated)}: move the arm with the pendant, or change source.arm.teleop"
            )

    def _show_violation(self, limit: str) -> str:
        """How the arm, at rest, breaks ``limit`` (joint, box, floor or near): for people."""
        config, arm = self.config, self.shape.arm
        if limit == "joint":
            joint = int(np.argmax(np.maximum(self.rates.low - self.q, self.q - self.rates.high)))
            stands = f"joint {joint + 1} stands at {np.degrees(self.q[joint]):.1f} degrees"
            return f"{stands}, within joint_margin_rad of its limit"
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
