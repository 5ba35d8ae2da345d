"""A simulated controller in a process of its own, as the client library needs it; the scenario ``cell``."""

import contextlib
import itertools
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from camera_node.robot.flange_camera import TruthClient
from camera_node.robot.simulated_controller.server import SCRIPT_PORT
from freshfield.clock import WallClock
from freshfield.scenario import load

_numbers = itertools.count(1)


def own_address() -> str:
    """A loopback address that no other test uses: clients know a controller's ports by heart."""
    pid, number = os.getpid(), next(_numbers)
    return f"127.{1 + pid // 256 % 254}.{pid % 256}.{number}"


def require_ur_rtde() -> None:
    """Skip where the client library is missing."""
    for module in ("rtde_receive", "rtde_control"):
        pytest.importorskip(module, reason="needs ur-rtde: pip install -e '.[ur]'")


def write_cell(folder: Path, host: str, path: dict[str, Any] | None = None, **arm: Any) -> Path:
    """The scenario ``cell`` with its arm at ``host`` and other keys of ``source.arm`` and its path."""
    data = yaml.safe_load(load("cell").path.read_text())
    data["source"]["arm"] |= {"host": host, "cameras": {"hand": None}, **arm}
    data["source"]["arm"]["path"] |= path or {}
    file = folder / "cell.yaml"
    file.write_text(yaml.safe_dump(data))
    return file


def start_cli(*words: object) -> subprocess.Popen[str]:
    """A ``camera-node`` command in a process of its own."""
    command = [sys.executable, "-m", "camera_node.cli", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@contextlib.contextmanager
def simulated_arm(host: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """``camera-node simulate-arm`` at ``host``, from when it serves until the block ends."""
    process = start_cli("simulate-arm", "--host", host, *options)
    try:
        for _ in range(600):
            # The last port that it opens: all others are served by then.
            with contextlib.suppress(OSError), socket.create_connection((host, SCRIPT_PORT), 1.0):
                break
            if process.poll() is not None:
                pytest.fail(f"simulate-arm ended: {process.communicate()}")
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
