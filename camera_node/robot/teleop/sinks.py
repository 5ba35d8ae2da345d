"""Sinks of joint targets: an arm's controller, or a file."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.arm_constants import STOP_RAD_S2
from camera_node.robot.arm.control import connect_control, joints_in_motion, stop_within_timeout
from camera_node.robot.arm.joint_states import ArmStream
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.teleop.teleop_constants import LOOKAHEAD_S, MAX_LAG_RAD, SERVO_GAIN
from camera_node.robot.teleop.teleoperator import Command

HEADER = "t_s,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,x_m,y_m,z_m,state"


class TrajectoryFile:
    """A CSV file with a line per tick: time, joints, position of the flange in the base's axes, state."""

    def __init__(self, path: Path, arm: ArmModel) -> None:
        self._arm = arm
        self._file = path.open("w", encoding="ascii", buffering=1)  # a full disk is told by ``send``
        self._file.write(HEADER + "\n")

    def send(self, t_s: float, command: Command) -> None:
        """Write the command of time ``t_s``. Raises OSError."""
        flange = self._arm.forward(command.joints)[:3, 3]
        numbers = ",".join(f"{v:.9f}" for v in (*command.joints, *flange))
        self._file.write(f"{t_s:.4f},{numbers},{command.state}\n")

    def close(self) -> None:
        with contextlib.suppress(OSError):  # of the line that ``send`` could not write
            self._file.close()


class ServoSink:
    """A controller, through the manufacturer's library: one servoJ per tick.

    stream: joint states of the same arm, which must not be stale or lag behind the targets.
    period_s: length of a tick.
    """

    def __init__(self, stream: ArmStream, period_s: float) -> None:
        self._stream, self._period_s = stream, period_s
        self._control: Any = connect_control(stream.host)

    def send(self, t_s: float, command: Command) -> None:
        """Send the command. Raises ArmError."""
        del t_s
        # An arm that was stopped must get no target: its program would jump there when it is released.
        lag_rad = float(np.abs(joints_in_motion(self._stream) - command.joints).max())
        if lag_rad > MAX_LAG_RAD:
            raise ArmError(
                f"arm at {self._stream.host}: {np.degrees(lag_rad):.0f} degrees behind its target: stopped; "
                "is something in its way, or is its speed slider down?"
            )
        if not self._control.servoJ(command.joints.tolist(), 0.0, 0.0, self._period_s, LOOKAHEAD_S, SERVO_GAIN):
            raise ArmError(f"arm at {self._stream.host}: it refuses to move: see the pendant")

    def close(self) -> None:
        """Stop the arm, and the program on its controller. Raises ArmError."""
        stop_within_timeout(self._stop, self._stream.host)

    def _stop(self) -> None:
        with contextlib.suppress(RuntimeError):
            self._control.servoStop(STOP_RAD_S2)
            self._control.stopScript()


Sink = ServoSink | TrajectoryFile
"""What teleoperation sends its commands to."""
