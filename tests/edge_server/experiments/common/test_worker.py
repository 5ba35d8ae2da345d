"""Workers of a computation end with it, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

PARENT = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from edge_server.experiments.common.worker import init_worker

if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, get_context("spawn"), init_worker, (1,))
    print(pool.submit(os.getpid).result(), flush=True)
    pool.submit(time.sleep, 600.0).result()
"""


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_a_worker_does_not_outlive_its_parent(how, tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    os.kill(worker, 0)  # it is there
    parent.send_signal(how)
    parent.wait(10.0)
    until = time.monotonic() + 20.0
    while _alive(worker):
        assert time.monotonic() < until, "the worker goes on without its parent"
        time.sleep(0.05)


def _alive(pid: int) -> bool:
    """A process that has ended may wait for whoever adopted it to notice."""
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False
