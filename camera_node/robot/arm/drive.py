"""``camera-node drive-arm``: moves the camera on an arm around its target, viewpoint by viewpoint, endlessly.

Moves are started and then polled, never waited for inside the library: Ctrl-C, SIGTERM, a closed terminal,
a stalled arm or state, and a program that was stopped at the pendant end the drive, and the arm
comes to rest. If this process dies, the controller's own watchdog stops the arm.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from camera_node.config import ArmConfig, PathConfig
from camera_node.pose.providers import PoseGapError
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.hand_eye_mount import EYE_TO_HAND
from camera_node.robot.arm.joint_states import STALE_S, ArmError, ArmStream, probe
from camera_node.robot.arm.roadmap import FARTHEST_RAD
from camera_node.robot.arm.viewpoint_tour import PathError, Tour, plan_tour
from camera_node.robot.simulated_controller.command import read_joints, require_arm
from freshfield.clock import WallClock
from freshfield.scenario import ScenarioError, load

log = logging.getLogger("camera-node.arm")

CONTROL_S = 8
STOPPING_S = 5.0
_SIMULATED_STALE_S = 10.0
_ARRIVED_RAD = 1e-3
# In this time even a slow arm turns farther than its encoder noise.
_STALLED_S, _STALLED_RAD = 5.0, 1e-3
_POLL_S = 0.05
_STOP_RAD_S2 = 2.0
_MOVED_RAD = 0.01


def run(args: argparse.Namespace) -> int:
    """Drive until Ctrl-C or the rounds are over. Raises ScenarioError and ArmError before anything moves."""
    logging.basicConfig(
        level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S"
    )
    if args.joints is not None and not args.show:
        raise ScenarioError("--joints: goes with --show: a drive begins where the arm stands")
    scenario = load(args.scenario)
    config = require_arm(scenario)
    if config.path is None:
        raise ScenarioError(f"{scenario.path}: source.arm.path: missing: it says where the arm is to go")
    mounts = load_hand_eyes(scenario, config, config.cameras)
    carried = [mount for mount in mounts.values() if mount.setup != EYE_TO_HAND]
    if not carried:
        raise ScenarioError(f"{scenario.path}: source.arm.cameras: none of them is on the hand")
    model, base = arm_model(scenario, config), base_matrix(config)
    stream = open_stream(config)
    try:
        start = _start(args, stream)
        try:
            found = plan_tour(model, base, carried[0].transform, config.path, start)
        except PathError as error:
            raise ScenarioError(f"{scenario.path}: source.arm.path: {error}") from None
        stops = found.stops
        _print_tour(found, start)
        if args.show:
            return 0
        assert start is not None
        first_rad = np.abs(stops[0] - start).max()
        if first_rad > FARTHEST_RAD and not config.simulated:
            raise ArmError(
                f"arm at {config.host}: the first move would turn a joint by {np.rad2deg(first_rad):.0f} "
                f"degrees, more than {np.rad2deg(FARTHEST_RAD):.0f}: bring it nearer to the first viewpoint "
                "with the pendant"
            )
        if not (args.yes or config.simulated or confirm_motion(config.host)):
            return 2
        if np.abs(stream.at(WallClock().now_ns(), 0.0)[0] - start).max() > _MOVED_RAD:
            raise ArmError(f"arm at {config.host}: it has been moved since the tour was printed: start again")
        return _drive(stream, stops, DriveLimits.of(config, config.path), args.rounds)
    finally:
        stream.stop()


def _start(args: argparse.Namespace, stream: ArmStream) -> np.ndarray | None:
    """Joints (6,) where the tour begins: --joints, or those of the arm; None for --show without an arm.
    Raises ArmError."""
    if args.joints is not None:
        return read_joints(args.joints)
    try:
        stream.start()
        return stream.at(WallClock().now_ns(), 0.0)[0]
    except ArmError as error:
        if not args.show:
            raise
        print(
            f"{error}\nWithout it, this is the tour of an arm near its first viewpoint: from elsewhere other "
            "postures may be nearer (--joints)",
            file=sys.stderr,
        )
        return None


def _print_tour(found: Tour, start: np.ndarray | None) -> None:
    """The number of viewpoints, and joint angles line by line, as they will be driven."""
    stops = found.stops
    print(f"{found.reached} viewpoints in {len(stops)} stops")
    rows = [(str(k), joints) for k, joints in enumerate(stops, 1)]
    for name, joints in rows if start is None else [("stands at", start), *rows]:
        print(f"{name:>10} " + " ".join(f"{angle:8.2f}" for angle in np.rad2deg(joints)))
    if start is not None:
        far_deg = np.rad2deg(np.abs(stops[0] - start).max())
        print(f"(degrees); the first move turns a joint by {far_deg:.0f}")
    sys.stdout.flush()


def confirm_motion(host: str, will: str = "move") -> bool:
    """Ask the operator whether the arm may move. Raises ArmError where standard input is no terminal."""
    if not sys.stdin.isatty():
        raise ArmError(f"the arm at {host} would move: say that its space is clear with --yes")
    # Not on standard output, which may be for a program.
    question = f"The arm at {host} will {will}. Is its space clear, and a hand on the stop? [y/N] "
    print(question, end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


@dataclass(frozen=True)
class DriveLimits:
    """Speeds, and how long controller and process may go without hearing from each other."""

    speed_rad_s: float
    acceleration_rad_s2: float
    patience_s: float

    @classmethod
    def of(cls, config: ArmConfig, path: PathConfig) -> DriveLimits:
        return cls(path.speed_rad_s, path.acceleration_rad_s2, patience_s(config))


def open_stream(config: ArmConfig) -> ArmStream:
    """Joint-state stream of the arm to drive, not started yet."""
    stale_s = patience_s(config)
    return ArmStream(config.host, WallClock(), 50.0, max_gap_ms=1e3 * stale_s, stale_s=stale_s)


def patience_s(config: ArmConfig) -> float:
    """Seconds without a new joint state before a stop. A simulated arm hits nothing, so it may lag longer."""
    return _SIMULATED_STALE_S if config.simulated else STALE_S


def _drive(stream: ArmStream, stops: list[np.ndarray], limits: DriveLimits, rounds: int) -> int:
    control = connect_control(stream.host)
    stop_requested = stop_event()
    # There and back, so that each round begins where the last one ended.
    each = itertools.count() if rounds == 0 else range(rounds)
    there_and_back = (joints for k in each for joints in (stops if k % 2 == 0 else stops[::-1]))
    try:
        visit_stops(control, stream, there_and_back, limits, stop_requested)
    except ArmError as error:
        print(f"camera-node: {error}", file=sys.stderr, flush=True)
        os._exit(1)  # the library's destructor would wait for an arm that may be gone
    return 0


def stop_event() -> threading.Event:
    """Event that SIGINT, SIGTERM and SIGHUP (unless ignored, as under nohup) set from now on."""
    requested = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: requested.set())
    return requested


def visit_stops(
    control: Any,
    stream: ArmStream,
    stops: Iterable[np.ndarray],
    limits: DriveLimits,
    stop_requested: threading.Event,
) -> None:
    """Move the arm to each of ``stops`` in turn until ``stop_requested``; always bring it to rest at the end.
    Raises ArmError."""
    try:
        if not control.setWatchdog(1.0 / limits.patience_s):
            raise ArmError(f"arm at {stream.host}: it takes no watchdog: {_reason(stream)}")
        for joints in stops:
            if stop_requested.is_set():
                return
            if not control.moveJ(joints.tolist(), limits.speed_rad_s, limits.acceleration_rad_s2, True):
                raise ArmError(f"arm at {stream.host}: it refuses to move: {_reason(stream)}")
            if not _wait_until_arrived(stream, control, joints, stop_requested, limits.patience_s):
                return
    finally:
        stop_within_timeout(lambda: _stop_arm(control))


def _reason(stream: ArmStream) -> str:
    return stream.trouble or "see the pendant"


def _stop_arm(control: Any) -> None:
    control.stopJ(_STOP_RAD_S2)
    control.stopScript()


def stop_within_timeout(ask: Callable[[], None]) -> None:
    """Call ``ask`` to stop an arm, but give up after ``STOPPING_S``: the library waits without a timeout."""
    # The default action ends this process even if the library holds Python's lock.
    signal.setitimer(signal.ITIMER_REAL, 2 * STOPPING_S)
    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(STOPPING_S)
    signal.setitimer(signal.ITIMER_REAL, 0)


def _wait_until_arrived(
    stream: ArmStream, control: Any, goal: np.ndarray, stop_requested: threading.Event, patience_s: float
) -> bool:
    """Wait until the joints reach ``goal``; False if asked to stop. Raises ArmError if the arm is silent,
    stalls on the way, or whose program has ended."""
    clock = WallClock()
    still_ns = round(max(_STALLED_S, patience_s) * 1e9)
    at, since_ns = np.full(6, np.inf), 0
    while not stop_requested.wait(_POLL_S):
        now_ns = clock.now_ns()
        try:
            joints, _ = stream.at(now_ns)
        except PoseGapError as error:
            raise ArmError(f"{error}: stopped") from None
        if stream.trouble:  # joint angles still come, but the arm has been stopped
            raise ArmError(f"{stream.trouble}: stopped")
        left_rad = float(np.abs(joints - goal).max())
        if left_rad < _ARRIVED_RAD:
            return True
        where = f"{np.rad2deg(left_rad):.1f} degrees from its goal"
        if not (control.isProgramRunning() and control.kickWatchdog()):
            raise ArmError(
                f"arm at {stream.host}: its program was ended {where}: at the pendant, by a fault, or by "
                "leaving remote control"
            )
        if np.abs(joints - at).max() > _STALLED_RAD:
            at, since_ns = joints, now_ns
        elif now_ns - since_ns > still_ns:
            raise ArmError(
                f"arm at {stream.host}: it stands still, {where}: is it paused, or the speed slider at zero?"
            )
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
