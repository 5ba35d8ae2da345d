"""``camera-node drive-arm``: moves the camera on an arm around its target, from viewpoint to viewpoint.

A move is started and then polled, so the library does not block until its end. Ctrl-C, SIGTERM, a closed
terminal, a stalled arm, a stale state or a program stopped at the pendant end the drive and bring the arm to
rest.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import threading
import time
from typing import Any

import numpy as np

from camera_node.robot.arm import ArmError
from camera_node.robot.arm import arm_constants as tuned
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, mount_on_flange, require_arm
from camera_node.robot.arm.control import (
    confirm_motion,
    connect_control,
    joints_in_motion,
    open_stream,
    stop_event,
    stop_within_timeout,
)
from camera_node.robot.arm.joint_states import ArmStream
from camera_node.robot.arm.settings import PathConfig
from camera_node.robot.arm.tour_planning import Tour, plan_tour
from camera_node.settings import errors_of
from freshfield.scenario import ScenarioError, load


def run(args: argparse.Namespace) -> int:
    """Drive until Ctrl-C or the last round. Raises ScenarioError and ArmError before the arm moves."""
    if args.rounds < 0:
        raise ScenarioError(f"--rounds: expected 0 (without end) or more, got {args.rounds}")
    scenario = load(args.scenario)
    config = require_arm(scenario)
    if config.path is None:
        raise ScenarioError(f"{scenario.path}: source.arm.path: missing: it says where the arm is to go")
    mount, model, base = mount_on_flange(scenario, config), arm_model(scenario, config), base_matrix(config)
    stream = open_stream(config)
    try:
        stream.start()
        start = stream.now()
        with errors_of(f"{scenario.path}: source.arm.path"):
            tour = plan_tour(model, base, mount, config.path, start)
        first_rad = float(np.abs(tour.stops[0] - start).max())
        _print_tour(tour, start, first_rad)
        if args.show:
            return 0
        if first_rad > tuned.FARTHEST_RAD and not config.simulated:
            raise ArmError(
                f"arm at {config.host}: the first move would turn a joint by {np.rad2deg(first_rad):.0f} "
                f"degrees, more than {np.rad2deg(tuned.FARTHEST_RAD):.0f}: bring it nearer to the first viewpoint "
                "with the pendant"
            )
        if not (args.yes or config.simulated or confirm_motion(config.host, "move")):
            return 2
        if np.abs(stream.now() - start).max() > tuned.MOVED_RAD:
            raise ArmError(f"arm at {config.host}: it has been moved since the tour was printed: start again")
        return _drive(stream, tour.stops, config.path, args.rounds)
    finally:
        stream.stop()


def _print_tour(tour: Tour, start: np.ndarray, first_rad: float) -> None:
    """Print the number of viewpoints and the joint angles of every stop, in the order of the drive."""
    print(f"{tour.reached} viewpoints in {len(tour.stops)} stops")
    for name, joints in [("stands at", start), *((str(k), joints) for k, joints in enumerate(tour.stops, 1))]:
        print(f"{name:>10} " + " ".join(f"{angle:8.2f}" for angle in np.rad2deg(joints)))
    print(f"(degrees); the first move turns a joint by {np.rad2deg(first_rad):.0f}", flush=True)


def _drive(stream: ArmStream, stops: list[np.ndarray], path: PathConfig, rounds: int) -> int:
    """Move the arm to each of ``stops`` (joint angles (6,), radians) in turn, there and back, then bring it to rest,
    also after an error. Returns 0; ends the process after an error."""
    control = connect_control(stream.host)
    stop_requested = stop_event()

    def stop() -> None:
        control.stopJ(tuned.STOP_RAD_S2)
        control.stopScript()

    try:
        try:
            if not control.setWatchdog(1.0 / stream.stale_s):
                raise ArmError(f"arm at {stream.host}: it takes no watchdog: {_reason(stream)}")
            # There and back, so that each round begins where the last one ended.
            for k in itertools.count() if rounds == 0 else range(rounds):
                for joints in stops if k % 2 == 0 else stops[::-1]:
                    if stop_requested.is_set():
                        return 0
                    if not control.moveJ(joints.tolist(), path.speed_rad_s, path.acceleration_rad_s2, True):
                        raise ArmError(f"arm at {stream.host}: it refuses to move: {_reason(stream)}")
                    _wait_until_arrived(stream, control, joints, stop_requested)
        finally:
            stop_within_timeout(stop, stream.host)
    except ArmError as error:
        print(f"camera-node: {error}", file=sys.stderr, flush=True)
        os._exit(1)  # the library's destructor would wait for an arm that may be gone
    return 0


def _reason(stream: ArmStream) -> str:
    return stream.trouble or "see the pendant"


def _wait_until_arrived(stream: ArmStream, control: Any, goal: np.ndarray, stop_requested: threading.Event) -> None:
    """Wait until the joints reach ``goal``, or until asked to stop. Raises ArmError if the arm's state is too
    old, or if it stalls or its program ends on the way."""
    patience_s = max(tuned.STALLED_S, stream.stale_s)
    at, moved_s = np.full(6, np.inf), 0.0
    while not stop_requested.wait(tuned.POLL_S):
        joints, now_s = joints_in_motion(stream), time.monotonic()
        left_rad = float(np.abs(joints - goal).max())
        if left_rad < tuned.ARRIVED_RAD:
            return
        where = f"{np.rad2deg(left_rad):.1f} degrees from its goal"
        if not (control.isProgramRunning() and control.kickWatchdog()):
            raise ArmError(
                f"arm at {stream.host}: its program was ended {where}: at the pendant, by a fault, or by "
                "leaving remote control"
            )
        if np.abs(joints - at).max() > tuned.STALLED_RAD:
            at, moved_s = joints, now_s
        elif now_s - moved_s > patience_s:
            raise ArmError(
                f"arm at {stream.host}: it stands still, {where}: is it paused, or the speed slider at zero?"
            )
