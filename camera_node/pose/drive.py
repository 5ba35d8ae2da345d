"""``camera-node drive-arm``: takes the camera on an arm round its target, viewpoint by viewpoint, for ever.

Moves are started and then watched, never waited for inside the library: Ctrl-C, SIGTERM or a state that
stands still stop the arm where it is.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
from typing import Any

import numpy as np

from camera_node.pose.arm import STALE_S, ArmError, ArmStream, probe
from camera_node.pose.controller.command import arm_of
from camera_node.pose.mount import EYE_TO_HAND
from camera_node.pose.mounted import arm_model, base_matrix, hand_eyes
from camera_node.pose.path import PathError, tour
from camera_node.pose.rig import PoseGapError
from freshfield.clock import WallClock
from freshfield.scenario import ScenarioError, load

log = logging.getLogger("camera-node.arm")

CONTROL_S = 8
STOPPING_S = 5.0
_SIMULATED_STALE_S = 10.0
_ARRIVED_RAD = 1e-3
_POLL_S = 0.05
_STOP_RAD_S2 = 2.0


def run(args: argparse.Namespace) -> int:
    """Drive until Ctrl-C or the rounds are over. Raises ScenarioError and ArmError before anything moves."""
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S"
    )
    scenario = load(args.scenario)
    config = arm_of(scenario)
    if config.path is None:
        raise ScenarioError(f"{scenario.path}: source.arm.path: missing: it says where the arm is to go")
    mounts = hand_eyes(scenario, config, config.cameras)
    carried = [mount for mount in mounts.values() if mount.setup != EYE_TO_HAND]
    if not carried:
        raise ScenarioError(f"{scenario.path}: source.arm.cameras: none of them is on the hand")
    model, base = arm_model(scenario, config), base_matrix(config)
    stream: ArmStream | None = None
    start = None
    if not args.show:
        # Where nothing can be hit, a machine too busy to simulate is no reason to stop.
        patience_s = _SIMULATED_STALE_S if config.simulated else STALE_S
        stream = ArmStream(config.host, WallClock(), 50.0, max_gap_ms=1e3 * patience_s, stale_s=patience_s)
        stream.start()
        start = stream.at(WallClock().now_ns(), 0.0)[0]
    try:
        stops = tour(model, base, carried[0].transform, config.path, start)
    except PathError as error:
        raise ScenarioError(f"{scenario.path}: source.arm.path: {error}") from None
    print(f"{len(stops)} viewpoints", flush=True)
    if stream is None:
        for joints in stops:
            print(" ".join(f"{angle:8.2f}" for angle in np.rad2deg(joints)))
        return 0
    try:
        if not (args.yes or config.simulated or _agreed(config.host)):
            return 2
        return _drive(stream, stops, config.path.speed_rad_s, config.path.acceleration_rad_s2, args.rounds)
    finally:
        stream.stop()


def _agreed(host: str) -> bool:
    if not sys.stdin.isatty():
        raise ArmError(f"the arm at {host} would move: say that its space is clear with --yes")
    answer = input(f"The arm at {host} will move. Is its space clear, and a hand on the stop? [y/N] ")
    return answer.strip().lower() in ("y", "yes")


def _drive(stream: ArmStream, stops: list[np.ndarray], speed: float, acceleration: float, rounds: int) -> int:
    control = connect_control(stream.host)
    asked = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: asked.set())
    done = 0
    try:
        while not asked.is_set() and (rounds == 0 or done < rounds):
            # There and back, so that the end of a round is the beginning of the next.
            for joints in stops if done % 2 == 0 else stops[::-1]:
                if not control.moveJ(joints.tolist(), speed, acceleration, True):
                    raise ArmError(
                        f"arm at {stream.host}: it refuses to move: {stream.trouble or 'see the pendant'}"
                    )
                if not _arrive(stream, joints, asked):
                    break
            done += 1
    except ArmError as error:
        print(f"camera-node: {error}", file=sys.stderr, flush=True)
        _stop(control)
        os._exit(1)  # the library's destructor would wait for an arm that may be gone
    _stop(control)
    return 0


def _stop(control: Any) -> None:
    """Bring the arm to rest, as far as it still listens: the library waits for answers without an end."""

    def ask() -> None:
        control.stopJ(_STOP_RAD_S2)
        control.stopScript()

    # The default action ends this process even if the library holds Python's lock.
    signal.setitimer(signal.ITIMER_REAL, 2 * STOPPING_S)
    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(STOPPING_S)
    signal.setitimer(signal.ITIMER_REAL, 0)


def _arrive(stream: ArmStream, goal: np.ndarray, asked: threading.Event) -> bool:
    """Wait until the joints are there; False if asked to stop. Raises ArmError for one that says nothing."""
    clock = WallClock()
    while not asked.wait(_POLL_S):
        try:
            joints, _ = stream.at(clock.now_ns())
        except PoseGapError as error:
            raise ArmError(f"{error}: stopped") from None
        if stream.trouble:  # joint angles still come, but the arm has been stopped
            raise ArmError(f"{stream.trouble}: stopped")
        if np.abs(joints - goal).max() < _ARRIVED_RAD:
            return True
    return False


def connect_control(host: str) -> Any:
    """The library's control interface. Raises ArmError; a controller that goes silent while it connects ends
    this process, because the library cannot be interrupted there."""
    from rtde_control import RTDEControlInterface

    probe(host)
    log.info("arm at %s: taking control, within %d s or not at all", host, CONTROL_S)
    signal.alarm(CONTROL_S)
    try:
        return RTDEControlInterface(host)
    except RuntimeError as error:
        raise ArmError(
            f"arm at {host}: it cannot be controlled: {error}; is it in remote control, with brakes released?"
        ) from None
    finally:
        signal.alarm(0)
