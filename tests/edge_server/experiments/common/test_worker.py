"""Workers of a computation end with it, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing.connection import wait

import pytest

from edge_server.experiments.common.worker import WorkerContext, end_at_once

PARENT = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from edge_server.experiments.common.worker import WorkerContext, init_worker

if __name__ == "__main__":
    pool = ProcessPoolExecutor(1, WorkerContext(), init_worker, (1,))
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


def test_ctrl_c_does_not_end_a_worker_that_still_imports():
    with ProcessPoolExecutor(1, WorkerContext()) as pool:
        assert signal.SIGINT in pool.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result()
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_a_pool_that_ends_at_once_after_ctrl_c_leaves_no_traceback(monkeypatch):
    """Ctrl-C in ``pool.map`` cancels what waits, before anybody ends the pool."""
    errors: list[object] = []
    monkeypatch.setattr(threading, "excepthook", errors.append)
    pool = ProcessPoolExecutor(1, WorkerContext())
    # One runs, one lies in the queue of calls, and two wait.
    _, queued, *waiting = [pool.submit(time.sleep, 600.0) for _ in range(4)]
    until = time.monotonic() + 20.0
    while not queued.running():
        assert time.monotonic() < until, "the queue of calls stays empty"
        time.sleep(0.01)
    assert all(future.cancel() for future in waiting)
    (process,) = pool._processes.values()
    end = process.terminate

    def slowly() -> None:
        end()
        wait([process.sentinel], 20.0)
        time.sleep(0.2)  # the pool's thread finds it dead meanwhile

    monkeypatch.setattr(process, "terminate", slowly)
    manager = pool._executor_manager_thread
    with pytest.raises(KeyboardInterrupt), pool:
        try:
            raise KeyboardInterrupt
        except BaseException:
            end_at_once(pool)
            raise
    manager.join(20.0)
    assert not manager.is_alive() and not errors


def _alive(pid: int) -> bool:
    """A process that has ended may wait for whoever adopted it to notice."""
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False
