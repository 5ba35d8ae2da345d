"""A simulated controller in a process of its own, as the client library needs it."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from camera_node.robot.hand_camera import TruthClient
from freshfield.clock import WallClock

_numbers = itertools.count(1)


def own_address() -> str:
    """A loopback address that no other test uses: clients know a controller's ports by heart."""
    pid, number = os.getpid(), next(_numbers)
    return f"127.{1 + pid // 256 % 254}.{pid % 256}.{number}"


def require_ur_rtde() -> None:
    """Skip where the client library is missing."""
    for module in ("rtde_receive", "rtde_control"):
        pytest.importorskip(module, reason="needs ur-rtde: pip install -e '.[ur]'")


@contextlib.contextmanager
def simulated_arm(host: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """``camera-node simulate-arm`` at ``host``, from when it serves until the block ends."""
    command = [sys.executable, "-m", "camera_node.cli", "simulate-arm", "--host", host, *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        for _ in range(600):
            with contextlib.suppress(OSError), socket.create_connection((host, 30004), 1.0):
                break
            if process.poll() is not None:
                pytest.fail(f"simulate-arm ended: {process.communicate()[0]}")
            time.sleep(0.05)
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_until_moving(truth: TruthClient, process: subprocess.Popen[str]) -> None:
    """Until the arm has moved visibly; fails where ``process``, which is to move it, ends first."""
    clock = WallClock()
    start = truth.joints(clock.now_ns())
    while np.abs(truth.joints(clock.now_ns()) - start).max() < 0.05:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
