"""The simulated controller's state and commands: joints, registers, and the program that a client uploaded.

The client library drives an arm through registers: it uploads a program that reads command numbers from an
input register and answers in an output register. Here that program is not interpreted; the commands of
``SIMULATED`` are executed directly. Other commands, and those that a real controller refuses, stop the
program as a fault does there, so that the client cannot take them for done.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.simulated_controller import simulated_controller_constants as tuned
from camera_node.robot.simulated_controller.joint_motion import STEP_S, JointMotion
from freshfield.geometry import Array

log = logging.getLogger("camera-node.arm")

HOME_RAD = (0.0, -np.pi / 2, -np.pi / 2, -np.pi / 2, np.pi / 2, 0.0)
STEP_NS = round(STEP_S * 1e9)

MOVE_J, SERVO_J, SERVO_STOP, STOP_SCRIPT, NO_COMMAND = 1, 11, 16, 255, 0
STOP_J, SET_WATCHDOG = 34, 35
SIMULATED = "moveJ, servoJ, servoStop, stopJ, setWatchdog, kickWatchdog, stopScript"
READY, DONE = 1, 2
PLAYING, STOPPED = 2, 1


class Controller:
    """Controller of one arm. The caller passes the time to ``advance_to``.

    start_ns: the instant of step 0.
    joints: initial joint angles (6,), radians.
    """

    def __init__(self, arm: ArmModel, start_ns: int, joints: ArrayLike = HOME_RAD) -> None:
        self.motion = JointMotion(arm, joints)
        self.inputs: dict[str, Any] = {}
        self.answer = 0
        self.runtime_state = STOPPED
        self.steps = 0
        self._start_ns = start_ns
        self._busy = False
        self._watchdog_steps: int | None = None
        self._watchdog_reset_step = 0
        self._history = np.tile(self.motion.q, (tuned.HISTORY_STEPS, 1))

    def advance_to(self, now_ns: int, on_step: Callable[[], None] | None = None) -> None:
        """Execute every step that is due at ``now_ns``, and call ``on_step`` after each. Nothing happens
        until a clock that was set back has caught up. After a long pause of the machine the arm continues
        from where it was."""
        due = (now_ns - self._start_ns) // STEP_NS
        if due - self.steps > tuned.MAX_CATCH_UP_STEPS:
            self._start_ns += (due - self.steps) * STEP_NS
            return
        while self.steps < due:
            self.motion.step()
            self.steps += 1
            self._history[self.steps % tuned.HISTORY_STEPS] = self.motion.q
            if self._busy and not self.motion.moving:
                self._finish()
            limit = self._watchdog_steps
            if limit is not None and self.steps - self._watchdog_reset_step > limit:
                self.fault(f"its client has been silent for {limit * STEP_S:g} s (watchdog)")
            if on_step is not None:
                on_step()

    def true_joints(self, t_ns: int) -> tuple[int, Array]:
        """True joint angles (6,) at ``t_ns``, interpolated between two steps. Returns their instant too:
        ``t_ns``, or the nearest one that is known (the last step, or 20 s ago)."""
        position = (t_ns - self._start_ns) / STEP_NS
        position = min(max(position, float(max(0, self.steps - tuned.HISTORY_STEPS + 2))), float(self.steps))
        whole = int(position)
        a = self._history[whole % tuned.HISTORY_STEPS]
        b = self._history[min(whole + 1, self.steps) % tuned.HISTORY_STEPS]
        part = position - whole
        return round(self._start_ns + position * STEP_NS), (1.0 - part) * a + part * b

    def values(self) -> dict[str, Any]:
        """Current values of the output variables that are not zero."""
        running = self.runtime_state == PLAYING
        return {
            "timestamp": self.steps * STEP_S,
            "actual_q": self.motion.q,
            "robot_mode": 7,
            "safety_mode": 1,
            "safety_status_bits": 1,
            "robot_status_bits": 0b11 if running else 0b01,
            "runtime_state": self.runtime_state,
            "output_int_register_0": self.answer,
        }

    def start_program(self) -> None:
        """Start the program that a client has uploaded."""
        self.stop_program()
        self.runtime_state, self.answer = PLAYING, READY
        self.inputs.clear()

    def stop_program(self) -> None:
        """Stop the program and bring the arm to rest."""
        self.motion.stop()
        self.runtime_state, self._busy, self._watchdog_steps = STOPPED, False, None
        self.answer = 0

    def write_inputs(self, given: dict[str, Any]) -> None:
        """Take a client's input registers, and execute their command."""
        self.inputs.update(given)
        if "input_int_register_0" not in given or self.runtime_state != PLAYING:
            return
        command = int(given["input_int_register_0"])
        self._watchdog_reset_step = self.steps
        if command == NO_COMMAND:
            self.answer = READY
        elif command == STOP_SCRIPT:
            self.stop_program()
        elif command == SERVO_J:
            if not self.motion.servo(self._joints()):  # without an answer: the next target follows at once
                self.fault("servoJ to where the joints cannot go")
        else:
            self._command(command)

    def _command(self, command: int) -> None:
        """Execute a command that is answered when it is done."""
        if command == MOVE_J:
            if not self.motion.move(self._joints(), self._double(6), self._double(7)):
                self.fault("moveJ to where the joints cannot go, or without a speed or an acceleration")
                return
            asynchronous = self.inputs.get("input_int_register_1", 0) == 1
            self._busy = self.motion.moving and not asynchronous
        elif command in (SERVO_STOP, STOP_J):
            self.motion.stop(self._double(0))
            self._busy = self.motion.moving
        elif command == SET_WATCHDOG and self._double(0) > 0:
            self._watchdog_steps = round(1.0 / (self._double(0) * STEP_S))
        else:
            self.fault(f"command {command} is not simulated (it knows {SIMULATED})")
            return
        if not self._busy:
            self._finish()

    def _finish(self) -> None:
        self._busy = False
        if self.runtime_state == PLAYING:
            self.answer = DONE

    def fault(self, why: str) -> None:
        """Stop the program, as a controller does after a command that it cannot execute."""
        log.warning("simulated arm: %s: the program is stopped", why)
        self.stop_program()

    def _double(self, register: int) -> float:
        return float(self.inputs.get(f"input_double_register_{register}", 0.0))

    def _joints(self) -> list[float]:
        return [self._double(k) for k in range(6)]
