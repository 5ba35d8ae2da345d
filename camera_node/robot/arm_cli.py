"""The commands that simulate, drive and teleoperate an arm. Imports their modules only when they run."""

from __future__ import annotations

import argparse
import importlib
import logging
import sys
from functools import partial
from pathlib import Path
from typing import Any


def add_commands(commands: Any) -> None:
    """Add their parsers to the sub-commands ``commands``."""
    simulate = commands.add_parser(
        "simulate-arm",
        help="a simulated UR controller that real client programs connect to",
        description="Serves the ports of a Universal Robots controller whose arm is simulated: state and "
        "registers (30004), dashboard (29999), programs (30003). It executes the commands moveJ, "
        "servoJ, servoStop, stopJ, setWatchdog, kickWatchdog and stopScript. Others "
        "(moveL, forceMode, getForwardKinematics, ...), and those that a real arm refuses, stop the program "
        "with a warning.",
    )
    simulate.set_defaults(run=partial(_run, "simulated_controller.simulate_arm_command"))
    add = simulate.add_argument
    add("scenario", nargs="?", help="scenario whose source.arm gives address, robot and calibration")
    add(
        "--host",
        metavar="ADDRESS",
        help="address to serve at; the ports are fixed, so a second arm needs a second address, such as "
        "127.0.0.3 [127.0.0.2]",
    )
    add("--joints", metavar="DEG,...", help="initial joint angles: six, in degrees [a home pose]")

    drive = commands.add_parser(
        "drive-arm",
        help="move the camera on an arm around its target",
        description="Moves the arm of a scenario along the viewpoints of its source.arm.path, there and "
        "back, until Ctrl-C. Prints the joint angles first, and asks before it moves a real arm.",
    )
    drive.set_defaults(run=partial(_run, "arm.drive_arm_command"))
    add = drive.add_argument
    add("scenario", help="a scenario whose source.arm has a path")
    add("--rounds", type=int, default=0, metavar="N", help="number of tours; 0: until Ctrl-C [%(default)s]")
    add("--show", action="store_true", help="print the tour from where the arm stands and exit without moving")
    add("--yes", action="store_true", help="the arm's workspace is clear: do not ask")

    _add_teleop(commands)


TELEOP = """\
Moves the arm of a scenario as an operator moves a stylus, while its clutch is pressed: scaled, filtered, and
at every tick within limits of workspace, joints, speed, acceleration and distance between the arm's parts.
If no message arrives for watchdog_ms, the arm stops. Limits and scale are keys of the scenario's
source.arm.teleop (freshfield scenario keys source lists them).

  camera-node simulate-arm cell &                                   an arm on this machine
  camera-node teleop cell --stylus keyboard                         keys are listed when it starts
  camera-node teleop cell --stylus network:7010                     a driver sends the stylus's poses
  camera-node teleop cell --stylus network:7010 --dry-run path.csv  no arm: write joint angles to a file

A network stylus sends UDP datagrams of JSON to the port, 50 to 1000 per second:

  {"t_ns": 1234567890, "p": [x, y, z], "q": [w, x, y, z], "clutch": true}

t_ns: time of the measurement (any clock); p: meters, z up; q: orientation; clutch: follow while true, after
it was false once. For a 3D Systems Touch: p = [x, -z, y] / 1000 of HD_CURRENT_TRANSFORM, clutch from
HD_CURRENT_BUTTONS. Only drivers on this machine are heard: whoever sends a datagram moves the arm.
"""


def _add_teleop(commands: Any) -> None:
    teleop = commands.add_parser(
        "teleop",
        help="move an arm by keyboard or by the driver of a stylus",
        description=TELEOP,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    teleop.set_defaults(run=partial(_run, "teleop.teleop_command"))
    add = teleop.add_argument
    add("scenario", help="a scenario with a source.arm")
    add("--stylus", required=True, metavar="WHICH", help="keyboard, network:[HOST:]PORT [HOST: 127.0.0.1]")
    add("--dry-run", type=Path, metavar="FILE", help="write the trajectory to FILE (CSV) instead of moving an arm")
    add("--seconds", type=float, metavar="S", help="end after S seconds [on Ctrl-C]")
    add("--yes", action="store_true", help="the arm's workspace is clear: do not ask")


def log_to_stderr(level: int = logging.INFO) -> None:
    logging.basicConfig(level=level, stream=sys.stderr, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")


def _run(module: str, args: argparse.Namespace) -> int:
    """Run the command of a module and return its exit status. Raises ScenarioError."""
    log_to_stderr()
    try:
        return int(importlib.import_module(f"camera_node.robot.{module}").run(args))
    except ValueError as error:  # an error of an arm or a file, in one line
        print(f"camera-node: {error}", file=sys.stderr)
        return 2
