"""One tick of teleoperation: messages in, joint targets out.

The caller passes the time, and all ticks are equally long. The same messages at the same ticks give the same
motion, bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from camera_node.robot.arm.kinematics import ArmModel, pose_difference
from camera_node.robot.teleop.limits import Limiter
from camera_node.robot.teleop.mapping import Mapping
from camera_node.robot.teleop.settings import TeleopConfig
from camera_node.robot.teleop.stylus import StylusSample
from freshfield.geometry import Array

# Damping distorts the flange's direction, so it is applied only near a singularity, where the Jacobian's least
# singular value falls below _DAMPING_THRESHOLD (Maciejewski and Klein 1988).
_DAMPING, _DAMPING_THRESHOLD = 0.05, 0.08
WAITING, HOLDING, FOLLOWING, SILENT = "waiting", "holding", "following", "silent"


@dataclass(frozen=True)
class Command:
    """The next target of the arm.

    joints: (6,) radians.
    speeds: (6,) rad/s.
    state: waiting for the first message, holding (clutch open), following, or silent (stopped by the
        watchdog).
    """

    joints: Array
    speeds: Array
    state: str


class Teleoperator:
    """Moves an arm by stylus messages. The arm starts at rest at ``joints`` (6,). Raises ArmError if these
    are outside its limits."""

    def __init__(self, arm: ArmModel, config: TeleopConfig, joints: ArrayLike) -> None:
        self.arm, self.config = arm, config
        self.limiter = Limiter(arm, config, joints)
        self.mapping = Mapping(config)
        self.state = WAITING
        self.ticks = 0
        self._watchdog_ns = round(config.watchdog_ms * 1e6)
        self._heard_ns: int | None = None

    def tick(self, now_ns: int, samples: Iterable[StylusSample]) -> Command:
        """The command of this tick, given the messages since the last one."""
        flange = self.arm.forward(self.limiter.q)
        if self._heard_ns is not None and now_ns < self._heard_ns:
            self._heard_ns = now_ns  # the clock was set back: restart the watchdog
        for sample in samples:
            if self.mapping.add_sample(sample, flange):
                self._heard_ns, self.state = now_ns, HOLDING
        if self._heard_ns is not None and now_ns - self._heard_ns > self._watchdog_ns:
            self.mapping.silence()
            self._heard_ns, self.state = None, SILENT
        target = self.mapping.target
        wanted = np.zeros(6)
        if target is not None:
            self.state = FOLLOWING
            wanted = joint_speeds(self.arm, self.config, self.limiter.q, target)
        return self._step(wanted)

    def stop(self) -> tuple[Command, bool]:
        """One tick of a stop, without the stylus. Returns the command and whether the arm is now at rest."""
        self.mapping.silence()
        self._heard_ns, self.state = None, SILENT
        command = self._step(np.zeros(6))
        return command, not command.speeds.any()

    def _step(self, wanted: Array) -> Command:
        joints, speeds = self.limiter.step(wanted)
        self.ticks += 1
        return Command(joints, speeds, self.state)


def joint_speeds(arm: ArmModel, config: TeleopConfig, q: Array, target: Array) -> Array:
    """Joint speeds (6,), rad/s, from joints ``q`` (6,) towards ``target``, base-from-flange (4, 4):
    ``v = J^T (J J^T + damping^2)^-1 twist`` (Wampler 1986), scaled down to the joints' speed limit."""
    left, values, right = np.linalg.svd(arm.jacobian(q))
    damping = _DAMPING * max(0.0, 1.0 - (float(values[-1]) / _DAMPING_THRESHOLD) ** 2)
    wanted = commanded_twist(arm, config, q, target)
    found: Array = right.T @ (values / (values**2 + damping**2) * (left.T @ wanted))
    fastest = float(np.abs(found).max())
    return found * min(1.0, config.speed_rad_s / fastest) if fastest > 0.0 else found


def commanded_twist(arm: ArmModel, config: TeleopConfig, q: Array, target: Array) -> Array:
    """Speed (6,) of the flange towards the target, in m/s and rad/s, scaled down to its speed limit."""
    wanted = config.gain_per_s * pose_difference(arm.forward(q), target)
    fastest = float(np.linalg.norm(wanted[:3]))
    return wanted * min(1.0, config.speed_m_s / fastest) if fastest > 0.0 else wanted
