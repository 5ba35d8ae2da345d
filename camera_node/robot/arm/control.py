"""Taking control of an arm and stopping it, for the commands that move one.

The manufacturer's library has no timeouts. If this process dies, the controller's own watchdog stops the arm.
"""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.arm_constants import CONTROL_S, DRIVE_HZ, SIMULATED_STALE_S, STALE_S, STOPPING_S
from camera_node.robot.arm.joint_states import ArmStream, probe
from camera_node.robot.arm.settings import ArmConfig
from freshfield.clock import WallClock

log = logging.getLogger("camera-node.arm")


def open_stream(config: ArmConfig, frequency_hz: float = DRIVE_HZ) -> ArmStream:
    """Joint-state stream of an arm that will be moved, not started yet. A simulated arm hits nothing, so its
    state may be older before it is stopped."""
    stale_s = SIMULATED_STALE_S if config.simulated else STALE_S
    return ArmStream(config.host, WallClock(), frequency_hz, False, max_gap_ms=1e3 * stale_s, stale_s=stale_s)


def confirm_motion(host: str, will: str) -> bool:
    """Ask the operator whether the arm may move. Raises ArmError if standard input is not a terminal."""
    if not sys.stdin.isatty():
        raise ArmError(f"the arm at {host} would move: say that its space is clear with --yes")
    # Not on standard output, which a program may read.
    question = f"The arm at {host} will {will}. Is its space clear, and a hand on the stop? [y/N] "
    print(question, end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def stop_event() -> threading.Event:
    """Event that SIGINT, SIGTERM and SIGHUP set from now on; SIGHUP not if it is ignored, as under nohup."""
    requested = threading.Event()
    hangs_up = signal.getsignal(signal.SIGHUP) != signal.SIG_IGN
    for number in (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hangs_up else [])):
        signal.signal(number, lambda *_: requested.set())
    return requested


def stop_within_timeout(stop: Callable[[], None], host: str) -> None:
    """Call ``stop`` to stop the arm at ``host``, but give up after ``STOPPING_S``: the library has no timeout. Raises
    ArmError then; where another error is on its way already, says it beside that."""
    # The default action ends this process even if the library holds Python's lock.
    signal.setitimer(signal.ITIMER_REAL, 2 * STOPPING_S)
    thread = threading.Thread(target=stop, daemon=True)
    thread.start()
    thread.join(STOPPING_S)
    signal.setitimer(signal.ITIMER_REAL, 0)
    if thread.is_alive():
        unconfirmed = f"arm at {host}: it has not confirmed its stop within {STOPPING_S:g} s: does it stand still?"
        if sys.exception() is None:
            raise ArmError(unconfirmed)
        print(f"camera-node: {unconfirmed}", file=sys.stderr, flush=True)


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


def connect_control(host: str) -> Any:
    """The library's control interface. Raises ArmError. The process ends if the controller stops answering
    while it connects, because the library cannot be interrupted there."""
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
