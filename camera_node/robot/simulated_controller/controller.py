"""What the simulated controller knows and does: joints, registers, the program that a client has uploaded.

The client library drives an arm through registers: it uploads a program that reads command numbers from an
input register and answers in an output register. Here that program is not interpreted; its commands are
carried out directly, those of ``SIMULATED`` and no others. What a real controller refuses, and what is not
simulated, stops the program, as a fault does there: a client that took it for done would be wrong.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.simulated_controller.joint_motion import STEP_S, JointMotion
from freshfield.geometry import so3_log

log = logging.getLogger("camera-node.arm")

Array = NDArray[np.float64]

HOME_RAD = (0.0, -np.pi / 2, -np.pi / 2, -np.pi / 2, np.pi / 2, 0.0)
STEP_NS = round(STEP_S * 1e9)
_HISTORY_STEPS = 10_000  # 20 s
_MAX_CATCH_UP_STEPS = 5_000

MOVE_J, SERVO_J, SERVO_STOP, STOP_SCRIPT, NO_COMMAND = 1, 11, 16, 255, 0
SPEED_J, SPEED_STOP, STOP_J = 9, 15, 34
SET_WATCHDOG = 35
SIMULATED = "moveJ, servoJ, servoStop, speedJ, speedStop, stopJ, setWatchdog, kickWatchdog, stopScript"
READY, DONE = 1, 2
PLAYING, STOPPED = 2, 1


class Controller:
    """One arm. Time is the caller's: ``advance_to`` brings everything to an instant.

    drift_ppm: how much faster the controller's clock runs than true time. noise_rad: standard deviation of
    what the joint encoders add (the truth has none of it). seed: of that noise.
    """

    def __init__(
        self,
        arm: ArmModel,
        start_ns: int,
        joints: ArrayLike = HOME_RAD,
        drift_ppm: float = 0.0,
        noise_rad: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.arm = arm
        self.motion = JointMotion(arm, joints)
        self.inputs: dict[str, Any] = {}
        self.output_int = [0] * 48
        self.output_double = [0.0] * 48
        self.digital_out = 0
        self.runtime_state = STOPPED
        self.steps = 0
        self._start_ns = start_ns
        self._drift = 1.0 + drift_ppm * 1e-6
        self._noise_rad = noise_rad
        self._rng = np.random.default_rng(seed)
        self._busy = False
        self._watchdog_steps: int | None = None
        self._watchdog_reset_step = 0
        self._history = np.tile(self.motion.q, (_HISTORY_STEPS, 1))

    def advance_to(self, now_ns: int, on_step: Callable[[], None] | None = None) -> None:
        """Take every step that is due at ``now_ns``; ``on_step`` is called after each. A clock that went back
        is waited for; after a long standstill of the machine the arm goes on from where it was."""
        due = (now_ns - self._start_ns) // STEP_NS
        if due - self.steps > _MAX_CATCH_UP_STEPS:
            self._start_ns += (due - self.steps) * STEP_NS
            return
        while self.steps < due:
            self.motion.step()
            self.steps += 1
            self._history[self.steps % _HISTORY_STEPS] = self.motion.q
            if self._busy and not self.motion.moving:
                self._finish()
            if (
                self._watchdog_steps is not None
                and self.steps - self._watchdog_reset_step > self._watchdog_steps
            ):
                self.fault(f"its client has been silent for {self._watchdog_steps * STEP_S:g} s (watchdog)")
            if on_step is not None:
                on_step()

    def true_joints(self, t_ns: int) -> tuple[int, Array]:
        """Where the joints (6,) really were at ``t_ns``, between the two steps around it, and the instant
        that this is: ``t_ns``, or the nearest that is known of (the last step, or 20 s ago)."""
        position = (t_ns - self._start_ns) / STEP_NS
        position = min(max(position, float(max(0, self.steps - _HISTORY_STEPS + 2))), float(self.steps))
        whole = int(position)
        a = self._history[whole % _HISTORY_STEPS]
        b = self._history[min(whole + 1, self.steps) % _HISTORY_STEPS]
        part = position - whole
        return round(self._start_ns + position * STEP_NS), (1.0 - part) * a + part * b

    def values(self) -> dict[str, Any]:
        """The variables of an output recipe now. Each call draws the encoders' noise anew."""
        m = self.motion
        q = m.q + self._rng.normal(0.0, self._noise_rad, 6) if self._noise_rad > 0.0 else m.q
        flange = self.arm.forward(q)
        pose = (*flange[:3, 3], *so3_log(flange[:3, :3]))
        running = self.runtime_state == PLAYING
        return {
            "timestamp": self.steps * STEP_S * self._drift,
            "target_q": m.q, "target_qd": m.qd, "target_qdd": m.qdd, "actual_q": q, "actual_qd": m.qd,
            "actual_TCP_pose": pose, "target_TCP_pose": pose,
            "actual_TCP_speed": self.arm.jacobian(q) @ m.qd if m.qd.any() else None,
            "joint_temperatures": (25.0,) * 6, "joint_mode": (253,) * 6,
            "robot_mode": 7, "safety_mode": 1, "safety_status": 1, "safety_status_bits": 1,
            "robot_status_bits": 0b11 if running else 0b01,
            "runtime_state": self.runtime_state,
            "speed_scaling": 1.0, "target_speed_fraction": 1.0,
            "actual_main_voltage": 48.0, "actual_robot_voltage": 48.0, "actual_joint_voltage": (48.0,) * 6,
            "actual_digital_output_bits": self.digital_out,
            **{f"output_int_register_{k}": v for k, v in enumerate(self.output_int)},
            **{f"output_double_register_{k}": v for k, v in enumerate(self.output_double)},
        }  # fmt: skip

    def start_program(self) -> None:
        """A client has uploaded its program."""
        self.motion.stop()
        self.runtime_state, self._busy, self._watchdog_steps = PLAYING, False, None
        self.output_int[0] = READY
        self.inputs.clear()

    def stop_program(self) -> None:
        self.motion.stop()
        self.runtime_state, self._busy, self._watchdog_steps = STOPPED, False, None
        self.output_int[0] = 0

    def write_inputs(self, given: dict[str, Any]) -> None:
        """Input registers from a client, and what they ask for."""
        self.inputs.update(given)
        self._set_outputs(given)
        if "input_int_register_0" not in given or self.runtime_state != PLAYING:
            return
        command = int(given["input_int_register_0"])
        self._watchdog_reset_step = self.steps
        if command == NO_COMMAND:
            self.output_int[0] = READY
        elif command == STOP_SCRIPT:
            self.stop_program()
        elif command == SERVO_J:
            if not self.motion.servo(self._doubles(0, 6)):  # answers nothing: the next target follows at once
                self.fault("servoJ to where the joints cannot go")
        elif command == SPEED_J:
            if not self.motion.speed(self._doubles(0, 6), self._double(6)):
                self.fault("speedJ without a speed or an acceleration")
        else:
            self._command(command)

    def _command(self, command: int) -> None:
        """One that is answered when it is done."""
        if command == MOVE_J:
            if not self.motion.move(self._doubles(0, 6), self._double(6), self._double(7)):
                self.fault("moveJ to where the joints cannot go, or without a speed or an acceleration")
                return
            self._busy = self.motion.moving
            if self.inputs.get("input_int_register_1", 0) == 1:  # asked for without waiting
                self._busy = False
        elif command in (SERVO_STOP, SPEED_STOP, STOP_J):
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
            self.output_int[0] = DONE

    def fault(self, why: str) -> None:
        """Stop the program, as a controller does that is asked for what it cannot do."""
        log.warning("simulated arm: %s: the program is stopped", why)
        self.stop_program()

    def _set_outputs(self, given: dict[str, Any]) -> None:
        for name, shift in (("standard", 0), ("configurable", 8), ("tool", 16)):
            mask = given.get(f"{name}_digital_output_mask")
            if mask is not None:
                value = given.get(f"{name}_digital_output", 0)
                self.digital_out = (self.digital_out & ~(mask << shift)) | ((value & mask) << shift)

    def _double(self, register: int) -> float:
        return float(self.inputs.get(f"input_double_register_{register}", 0.0))

    def _doubles(self, first: int, count: int) -> list[float]:
        return [self._double(first + k) for k in range(count)]
