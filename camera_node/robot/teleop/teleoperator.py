"""One tick of teleoperation: messages in, joint targets out.

Time is the caller's, and ticks are equally long. The same messages at the same ticks give the same
motion, bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.teleop.ik_solver import Solver, make_solver
from camera_node.robot.teleop.limits import Limiter
from camera_node.robot.teleop.mapping import Mapping
from camera_node.robot.teleop.settings import TeleopConfig
from camera_node.robot.teleop.stylus import StylusSample

Array = NDArray[np.float64]

WAITING, HOLDING, FOLLOWING, SILENT = "waiting", "holding", "following", "silent"


@dataclass(frozen=True)
class Command:
    """What the arm is to do next. joints: (6,) radians; speeds: (6,) rad/s; state: waiting for the first
    message, holding (clutch open), following, or silent (the watchdog has let go)."""

    joints: Array
    speeds: Array
    state: str


class Teleoperator:
    """An arm at ``joints`` (6,), standing still, moved by stylus messages. Raises TeleopError where it stands
    outside its limits."""

    def __init__(
        self, arm: ArmModel, config: TeleopConfig, joints: ArrayLike, solver: Solver | None = None
    ) -> None:
        self.arm, self.config = arm, config
        self.limiter = Limiter(arm, config, joints)
        self.solver = solver or make_solver(arm, config)
        self.mapping = Mapping(config)
        self.state = WAITING
        self.ticks = 0
        self._watchdog_ns = round(config.watchdog_ms * 1e6)
        self._heard_ns: int | None = None

    def tick(self, now_ns: int, samples: Iterable[StylusSample]) -> Command:
        """The command of one period of ``config.rate_hz``, given what came since the last."""
        hand = self.arm.forward(self.limiter.q)
        if self._heard_ns is not None and now_ns < self._heard_ns:
            self._heard_ns = now_ns  # the clock was set back: silence is counted from here
        for sample in samples:
            if self.mapping.add_sample(sample, hand):
                self._heard_ns, self.state = now_ns, HOLDING
        if self._heard_ns is not None and now_ns - self._heard_ns > self._watchdog_ns:
            self.mapping.silence()
            self._heard_ns, self.state = None, SILENT
        target = self.mapping.target
        wanted = np.zeros(6)
        if target is not None:
            self.state = FOLLOWING
            wanted = self.solver.speeds(self.limiter.q, self.limiter.v, target)
        joints, speeds = self.limiter.step(wanted)
        self.ticks += 1
        return Command(joints, speeds, self.state)

    def stop(self) -> tuple[Command, bool]:
        """One tick of coming to rest, whatever the stylus says; and whether the arm now stands still."""
        self.mapping.silence()
        self._heard_ns, self.state = None, SILENT
        joints, speeds = self.limiter.step(np.zeros(6))
        self.ticks += 1
        return Command(joints, speeds, self.state), not speeds.any()

    def summary(self) -> dict[str, Any]:
        """Counts for people and logs."""
        return {
            "ticks": self.ticks,
            "state": self.state,
            "messages": vars(self.mapping.counts),
            "refused": vars(self.limiter.refused),
            "solver": self.solver.name,
            "unsolved": self.solver.failed,
        }
