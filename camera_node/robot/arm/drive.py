"""``camera-node drive-arm``: moves the camera on an arm around its target, from viewpoint to viewpoint.

A move is started and then polled, so the library does not block until its end. Ctrl-C, SIGTERM, a closed
terminal, a stalled arm, a stale state or a program stopped at the pendant end the drive and bring the arm to
rest. If this process dies, the controller's own watchdog stops the arm.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from camera_node.config import ArmConfig, PathConfig, errors_of
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, mount_on_hand
from camera_node.robot.arm.joint_states import STALE_S, ArmError, ArmStream, probe
from camera_node.robot.arm.roadmap import FARTHEST_RAD
from camera_node.robot.arm.viewpoint_tour import Tour, plan_tour
from camera_node.robot.simulated_controller.command import read_joints, require_arm
from freshfield.clock import WallClock
from freshfield.scenario import ScenarioError, load

log = logging.getLogger("camera-node.arm")

STOP_RAD_S2 = 2.0
"""Deceleration of every stop."""
_CONTROL_S = 8  # longest connection of the control interface
_STOPPING_S = 5.0
_SIMULATED_STALE_S = 10.0
_ARRIVED_RAD = 1e-3
# Within this time even a slow arm turns by more than its encoder noise.
_STALLED_S, _STALLED_RAD = 5.0, 1e-3
_POLL_S = 0.05
_MOVED_RAD = 0.01


def run(args: argparse.Namespace) -> int:
    """Drive until Ctrl-C or the last round. Raises ScenarioError and ArmError before the arm moves."""
    if args.joints is not None and not args.show:
        raise ScenarioError("--joints: goes with --show: a drive begins where the arm stands")
    if args.rounds < 0:
        raise ScenarioError(f"--rounds: expected 0 (without end) or more, got {args.rounds}")
    scenario = load(args.scenario)
    config = require_arm(scenario)
    if config.path is None:
        raise ScenarioError(f"{scenario.path}: source.arm.path: missing: it says where the arm is to go")
    mount, model, base = mount_on_hand(scenario, config), arm_model(scenario, config), base_matrix(config)
    stream = open_stream(config)
    try:
        start = _start(args, stream)
        with errors_of(f"{scenario.path}: source.arm.path"):
            tour = plan_tour(model, base, mount, config.path, start)
        _print_tour(tour, start)
        if args.show:
            return 0
        assert start is not None
        first_rad = np.abs(tour.stops[0] - start).max()
        if first_rad > FARTHEST_RAD and not config.simulated:
            raise ArmError(
                f"arm at {config.host}: the first move would turn a joint by {np.rad2deg(first_rad):.0f} "
                f"degrees, more than {np.rad2deg(FARTHEST_RAD):.0f}: bring it nearer to the first viewpoint "
                "with the pendant"
            )
        if not (args.yes or config.simulated or confirm_motion(config.host)):
            return 2
        if np.abs(stream.now() - start).max() > _MOVED_RAD:
            raise ArmError(f"arm at {config.host}: it has been moved since the tour was printed: start again")
        return _drive(stream, tour.stops, config.path, args.rounds)
    finally:
        stream.stop()


def _start(args: argparse.Namespace, stream: ArmStream) -> np.ndarray | None:
    """Joints (6,) at which the tour begins: --joints, or the arm's; None for --show without an arm. Raises
    ArmError."""
    if args.joints is not None:
        return read_joints(args.joints)
    try:
        stream.start()
        return stream.now()
    except ArmError as error:
        if not args.show:
            raise
        print(
            f"{error}\nWithout it, this is the tour of an arm near its first viewpoint: from elsewhere other "
            "postures may be nearer (--joints)",
            file=sys.stderr,
        )
        return None


def _print_tour(tour: Tour, start: np.ndarray | None) -> None:
    """Print the number of viewpoints and the joint angles of every stop, in the order of the drive."""
    print(f"{tour.reached} viewpoints in {len(tour.stops)} stops")
    rows = [(str(k), joints) for k, joints in enumerate(tour.stops, 1)]
    for name, joints in rows if start is None else [("stands at", start), *rows]:
        print(f"{name:>10} " + " ".join(f"{angle:8.2f}" for angle in np.rad2deg(joints)))
    if start is not None:
        far_deg = np.rad2deg(np.abs(tour.stops[0] - start).max())
        print(f"(degrees); the first move turns a joint by {far_deg:.0f}")
    sys.stdout.flush()


def confirm_motion(host: str, will: str = "move") -> bool:
    """Ask the operator whether the arm may move. Raises ArmError if standard input is not a terminal."""
    if not sys.stdin.isatty():
        raise ArmError(f"the arm at {host} would move: say that its space is clear with --yes")
    # Not on standard output, which a program may read.
    question = f"The arm at {host} will {will}. Is its space clear, and a hand on the stop? [y/N] "
    print(question, end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def open_stream(config: ArmConfig, frequency_hz: float = 50.0) -> ArmStream:
    """Joint-state stream of an arm that will be moved, not started yet. A simulated arm hits nothing, so its
    state may be older before it is stopped."""
    stale_s = _SIMULATED_STALE_S if config.simulated else STALE_S
    return ArmStream(config.host, WallClock(), frequency_hz, False, max_gap_ms=1e3 * stale_s, stale_s=stale_s)


def _drive(stream: ArmStream, stops: list[np.ndarray], path: PathConfig, rounds: int) -> int:
    control = connect_control(stream.host)
    stop_requested = stop_event()
    # There and back, so that each round begins where the last one ended.
    each = itertools.count() if rounds == 0 else range(rounds)
    there_and_back = (joints for k in each for joints in (stops if k % 2 == 0 else stops[::-1]))
    try:
        visit_stops(control, stream, there_and_back, path, stop_requested)
    except ArmError as error:
        print(f"camera-node: {error}", file=sys.stderr, flush=True)
        os._exit(1)  # the library's destructor would wait for an arm that may be gone
    return 0


def stop_event() -> threading.Event:
    """Event that ``stop_signals`` set from now on."""
    requested = threading.Event()
    for number in stop_signals():
        signal.signal(number, lambda *_: requested.set())
    return requested


def stop_signals() -> list[signal.Signals]:
    """The signals that stop the arm: SIGHUP is left out if it is ignored, as under nohup."""
    ignores_hangup = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return [signal.SIGINT, signal.SIGTERM, *([] if ignores_hangup else [signal.SIGHUP])]


def visit_stops(
    control: Any, stream: ArmStream, stops: Iterable[np.ndarray], path: PathConfig, stop_requested: threading.Event
) -> None:
    """Move the arm to each of ``stops`` in turn, then bring it to rest, also after an error.

    control: from ``connect_control``.
    stream: joint states of the same arm.
    stops: joint angles (6,), radians.
    path: gives speed and acceleration.
    stop_requested: set by another thread to end the drive.
    Raises ArmError.
    """

    def stop() -> None:
        control.stopJ(STOP_RAD_S2)
        control.stopScript()

    try:
        if not control.setWatchdog(1.0 / stream.stale_s):
            raise ArmError(f"arm at {stream.host}: it takes no watchdog: {_reason(stream)}")
        for joints in stops:
            if stop_requested.is_set():
                return
            if not control.moveJ(joints.tolist(), path.speed_rad_s, path.acceleration_rad_s2, True):
                raise ArmError(f"arm at {stream.host}: it refuses to move: {_reason(stream)}")
            if not _wait_until_arrived(stream, control, joints, stop_requested):
                return
    finally:
        stop_within_timeout(stop)


def _reason(stream: ArmStream) -> str:
    return stream.trouble or "see the pendant"


def stop_within_timeout(stop: Callable[[], None]) -> None:
    """Call ``stop`` to stop an arm, but give up after ``_STOPPING_S``: the library has no timeout."""
    # The default action ends this process even if the library holds Python's lock.
    signal.setitimer(signal.ITIMER_REAL, 2 * _STOPPING_S)
    thread = threading.Thread(target=stop, daemon=True)
    thread.start()
    thread.join(_STOPPING_S)
    signal.setitimer(signal.ITIMER_REAL, 0)


def joints_in_motion(stream: ArmStream) -> np.ndarray:
    """Current joint angles (6,) of an arm that this process moves. Raises ArmError if its state is too old or
    the arm was stopped."""
    try:
        joints = stream.now()
    except ArmError as error:
        raise ArmError(f"{error}: stopped") from None
    if stream.trouble:  # joint angles still come, but the arm has been stopped
        raise ArmError(f"{stream.trouble}: stopped")
    return joints


def _wait_until_arrived(stream: ArmStream, control: Any, goal: np.ndarray, stop_requested: threading.Event) -> bool:
    """Wait until the joints reach ``goal``; False if asked to stop. Raises ArmError if the arm's state is too
    old, or if it stalls or its program ends on the way."""
    patience_s = max(_STALLED_S, stream.stale_s)
    at, moved_s = np.full(6, np.inf), 0.0
    while not stop_requested.wait(_POLL_S):
        joints, now_s = joints_in_motion(stream), time.monotonic()
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
            at, moved_s = joints, now_s
        elif now_s - moved_s > patience_s:
            raise ArmError(
                f"arm at {stream.host}: it stands still, {where}: is it paused, or the speed slider at zero?"
            )
    return False


def connect_control(host: str) -> Any:
    """The library's control interface. Raises ArmError. The process ends if the controller stops answering
    while it connects, because the library cannot be interrupted there."""
    from rtde_control import RTDEControlInterface

    probe(host)
    log.info("arm at %s: taking control, within %d s or not at all", host, _CONTROL_S)
    signal.alarm(_CONTROL_S)
    try:
        return RTDEControlInterface(host)
    except RuntimeError as error:
        raise ArmError(
            f"arm at {host}: it cannot be controlled: {error}; is it in remote control, with brakes released?"
        ) from None
    finally:
        signal.alarm(0)
