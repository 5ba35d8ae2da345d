"""``camera-node teleop``: an operator moves the arm of a scenario, or writes a trajectory file instead."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from pathlib import Path

import numpy as np

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.camera_poses import arm_model, require_arm
from camera_node.robot.arm.control import confirm_motion, open_stream, stop_event
from camera_node.robot.arm.joint_states import ArmStream
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.settings import TeleopConfig
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.robot.teleop import teleop_constants as tuned
from camera_node.robot.teleop.sinks import ServoSink, Sink, TrajectoryFile
from camera_node.robot.teleop.stylus import Stylus, open_stylus
from camera_node.robot.teleop.teleoperator import Teleoperator
from freshfield.clock import WallClock
from freshfield.scenario import load


def run(args: argparse.Namespace) -> int:
    """Teleoperate until the operator ends it, Ctrl-C or ``--seconds``. Returns 1 after an error of the arm or
    the file. Raises ScenarioError and ArmError before the arm moves."""
    scenario = load(args.scenario)
    arm_config = require_arm(scenario)
    config = arm_config.teleop or TeleopConfig()
    model = arm_model(scenario, arm_config)
    if args.seconds is not None and not args.seconds > 0:
        raise ArmError("--seconds: expected a positive number")
    stream: ArmStream | None = None
    joints = np.array(HOME_RAD)
    with contextlib.ExitStack() as at_the_end:
        if args.dry_run is None:
            stream = open_stream(arm_config, arm_config.frequency_hz)
            at_the_end.callback(stream.stop)
            stream.start()
            joints = stream.now()
        operator = Teleoperator(model, config, joints)
        asks = stream is not None and not (args.yes or arm_config.simulated)
        if asks and not confirm_motion(arm_config.host, "follow the stylus"):
            return 2
        # After the question, because a keyboard stylus switches the terminal's line mode off.
        stylus = open_stylus(args.stylus)
        at_the_end.callback(stylus.close)
        status = _run_loop(operator, stylus, _sink(args.dry_run, stream, model, config), args.seconds)
    if status and stream is not None:
        sys.stdout.flush()
        os._exit(status)  # the library's destructor would wait for an arm that may be gone
    return status


def _sink(file: Path | None, stream: ArmStream | None, model: ArmModel, config: TeleopConfig) -> Sink:
    if stream is not None:
        return ServoSink(stream, 1.0 / config.rate_hz)
    assert file is not None
    try:
        return TrajectoryFile(file, model)
    except OSError as error:
        raise ArmError(f"--dry-run: {file}: {error.strerror}") from None


def _run_loop(operator: Teleoperator, stylus: Stylus, sink: Sink, seconds: float | None) -> int:
    """Tick until asked to end, then bring the arm to rest within the limits. Returns the exit status."""
    stop_requested, clock = stop_event(), WallClock()
    period_s = 1.0 / operator.config.rate_hz
    status, started_s = 0, time.monotonic()
    next_s, shown_s, late = started_s, started_s, 0
    try:
        with contextlib.closing(sink):
            while not stop_requested.is_set() and not stylus.ended:
                now_ns = clock.now_ns()
                command = operator.tick(now_ns, stylus.poll(now_ns))
                sink.send(operator.ticks * period_s, command)
                now_s = time.monotonic()
                if seconds is not None and now_s - started_s >= seconds:
                    break
                if now_s - shown_s >= tuned.SHOW_S and sys.stderr.isatty():
                    shown_s = now_s
                    print(f"\r{_status_line(operator)}\x1b[K", end="", file=sys.stderr, flush=True)
                next_s += period_s
                if next_s < now_s:
                    # Missed ticks are not made up for: the arm would move too fast.
                    next_s, late = now_s, late + 1
                else:
                    stop_requested.wait(next_s - now_s)
            _come_to_rest(operator, sink, period_s)
    except (ArmError, OSError) as error:
        operator.stop()
        print(f"camera-node: {error}", file=sys.stderr)
        status = 1
    print(f"\n{_status_line(operator)}; {late} of {operator.ticks} ticks late")
    return status


def _come_to_rest(operator: Teleoperator, sink: Sink, period_s: float) -> None:
    for _ in range(round(tuned.LONGEST_STOP_S / period_s)):
        begun_s = time.monotonic()
        command, at_rest = operator.stop()
        sink.send(operator.ticks * period_s, command)
        if at_rest:
            return
        time.sleep(max(0.0, period_s - (time.monotonic() - begun_s)))


def _status_line(operator: Teleoperator) -> str:
    x, y, z = operator.arm.forward(operator.limiter.q)[:3, 3]
    counts = operator.mapping.counts
    refused = [f"{name} {n}" for name, n in operator.limiter.refused.items() if n]
    held = f", held by {', '.join(refused)}" if refused else ""
    return (
        f"{operator.state}: flange at {x:.3f} {y:.3f} {z:.3f} m, {counts['taken']} messages, "
        f"clutch pressed {counts['pressed']} times, {counts['refused']} refused, {counts['jumps']} jumps{held}"
    )
