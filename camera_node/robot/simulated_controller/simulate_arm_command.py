"""``camera-node simulate-arm``: the simulated controller as a process of its own."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import math
import signal
import sys

import numpy as np

from camera_node.robot.arm.camera_poses import arm_model, require_arm
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.simulated_controller.controller import HOME_RAD, Controller
from camera_node.robot.simulated_controller.server import ControllerServer
from freshfield.clock import WallClock
from freshfield.scenario import ScenarioError, load


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C or SIGTERM. Returns 1 if a port is taken. Raises ScenarioError."""
    host, arm = args.host or "127.0.0.2", UR3E
    if args.scenario is not None:
        scenario = load(args.scenario)
        config = require_arm(scenario)
        host, arm = args.host or config.host, arm_model(scenario, config)
    joints = np.array(HOME_RAD) if args.joints is None else read_joints(args.joints)
    clock = WallClock()
    controller = Controller(arm, clock.now_ns(), joints)
    server = ControllerServer(controller, host, clock)

    async def serve() -> None:
        serving = asyncio.ensure_future(
            server.run(lambda: print(f"a simulated {arm.name} stands at {host}; Ctrl-C ends it", flush=True))
        )
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, serving.cancel)
        with contextlib.suppress(asyncio.CancelledError):
            await serving

    try:
        asyncio.run(serve())
    except OSError as error:
        print(f"camera-node: {host}: {error.strerror}: is another arm simulated there? --host", file=sys.stderr)
        return 1
    return 0


def read_joints(text: str) -> np.ndarray:
    """Parse six angles in degrees, separated by commas, to radians (6,). Raises ScenarioError."""
    try:
        angles = [math.radians(float(part)) for part in text.split(",")]
    except ValueError:
        angles = []
    if len(angles) != 6 or not all(abs(a) <= 2 * math.pi for a in angles):
        raise ScenarioError(f"--joints: expected six angles within 360 degrees, with commas, got {text!r}")
    return np.array(angles)
