"""What a measurement cost: this process's own cores and memory, and the machine's."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from edge_server.experiments.common.machine_load import Usage, cpu_s, peak_rss_mb, rss_mb


@pytest.mark.alone
def test_a_busy_loop_is_counted_as_ours_and_not_as_others():
    usage = Usage("me")
    before, until = time.process_time(), time.perf_counter() + 0.5
    while time.perf_counter() < until:
        pass
    used = time.process_time() - before
    row = usage.row(1.0)
    assert row["t_s"] == 1.0 and row["me"]["pid"] == os.getpid()
    assert abs(row["me"]["cpu"] - used / 0.5) < 0.15
    outside = usage.outside(row)
    assert outside is not None and 0.0 <= outside <= (os.cpu_count() or 1) + 0.2


def test_memory_and_processor_time_of_a_process():
    block = np.ones(8 * 2**20)  # 64 MB that are touched
    assert rss_mb() > 60.0 and peak_rss_mb() >= rss_mb() * 0.9
    assert cpu_s(os.getpid()) > 0.0 and block[0] == 1.0


def test_the_peak_of_a_child_is_its_own():
    block = np.ones(60 * 2**20)  # 500 MB that are touched; numpy and OpenCV alone take less than 200
    program = "from edge_server.experiments.common.machine_load import peak_rss_mb; print(peak_rss_mb())"
    child = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert peak_rss_mb() > 500.0 and block[-1] == 1.0
    assert float(child.stdout) < 400.0


def test_a_process_that_is_gone_tells_nothing():
    assert rss_mb(2**22 + 1) is None and cpu_s(2**22 + 1) is None
