"""One tick of teleoperation: messages in, joint targets out.

The caller passes the time, and all ticks are equally long. The same messages at the same ticks give the same
motion, bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.settings import TeleopConfig
from camera_node.robot.teleop.damped_least_squares import joint_speeds
from camera_node.robot.teleop.limits import Limiter
from camera_node.robot.teleop.mapping import Mapping
from camera_node.robot.teleop.stylus import StylusSample
from freshfield.geometry import Array

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
