"""Where joint targets go: to an arm's controller, or to a file."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from camera_node.pose.providers import PoseGapError
from camera_node.robot.arm.drive import connect_control, stop_within_timeout
from camera_node.robot.arm.joint_states import ArmError, ArmStream
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.teleop.teleoperator import Command
from freshfield.clock import Clock

# servoJ's own filter: how far ahead it looks and how hard it pulls (UR's script manual: 0.03 to 0.2 s, 100 to
# 2000). The gentlest pull that still holds; smoothing is ours already.
_LOOKAHEAD_S, _SERVO_GAIN = 0.1, 300.0
# An arm farther than this from where it was sent is being held, or has stopped.
_MAX_LAG_RAD = 0.35
_STOP_RAD_S2 = 2.0
HEADER = "t_s,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,x_m,y_m,z_m,state"


class Sink(Protocol):
    """Takes a command a tick. Raises ArmError or OSError where it cannot go on."""

    def send(self, t_s: float, command: Command) -> None: ...

    def close(self) -> None: ...


class TrajectoryFile:
    """A CSV, a line a tick: seconds, joints, where the flange is in the base's axes, the state."""

    def __init__(self, path: Path, arm: ArmModel) -> None:
        self._arm = arm
        self._file = path.open("w", encoding="ascii")
        self._file.write(HEADER + "\n")

    def send(self, t_s: float, command: Command) -> None:
        """See ``Sink``."""
        flange = self._arm.forward(command.joints)[:3, 3]
        numbers = ",".join(f"{v:.9f}" for v in (*command.joints, *flange))
        self._file.write(f"{t_s:.4f},{numbers},{command.state}\n")

    def close(self) -> None:
        self._file.close()


class ServoSink:
    """A controller, through the manufacturer's library: servoJ a tick. stream: the same arm's joint states;
    an arm that says nothing, or does not come after, ends it with ArmError."""

    def __init__(self, stream: ArmStream, clock: Clock, period_s: float) -> None:
        self._stream, self._clock, self._period_s = stream, clock, period_s
        self._control: Any = connect_control(stream.host)

    def send(self, t_s: float, command: Command) -> None:
        """See ``Sink``."""
        del t_s
        try:
            actual, _ = self._stream.at(self._clock.now_ns())
        except PoseGapError as error:
            raise ArmError(f"{error}: stopped") from None
        if self._stream.trouble:  # a program that is paused by a stop would go on by a leap when released
            raise ArmError(f"{self._stream.trouble}: stopped")
        behind = float(np.abs(actual - command.joints).max())
        if behind > _MAX_LAG_RAD:
            raise ArmError(
                f"arm at {self._stream.host}: {np.degrees(behind):.0f} degrees behind its target: stopped; "
                "is something in its way, or is its speed slider down?"
            )
        if not self._control.servoJ(
            command.joints.tolist(), 0.0, 0.0, self._period_s, _LOOKAHEAD_S, _SERVO_GAIN
        ):
            raise ArmError(f"arm at {self._stream.host}: it refuses to move: see the pendant")

    def close(self) -> None:
        """Stop the arm, and the program on its controller."""
        stop_within_timeout(self._stop)

    def _stop(self) -> None:
        with contextlib.suppress(RuntimeError):
            self._control.servoStop(_STOP_RAD_S2)
            self._control.stopScript()


def current_joints(stream: ArmStream, clock: Clock) -> NDArray[np.float64]:
    """Joints (6,) of an arm now. Raises ArmError."""
    try:
        return stream.at(clock.now_ns(), 0.0)[0]
    except PoseGapError as error:
        raise ArmError(str(error)) from None
