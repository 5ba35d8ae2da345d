"""What a measurement cost: this process's own cores and memory, and the machine's."""

from __future__ import annotations

import os

import numpy as np
import pytest

from freshfield.machine_load import cpu_s, outside_load, rss_mb


def test_memory_and_processor_time_of_a_process():
    block = np.ones(8 * 2**20)  # 64 MB that are touched
    assert rss_mb() > 60.0
    assert cpu_s(os.getpid()) > 0.0 and block[0] == 1.0


def test_a_process_that_is_gone_tells_nothing():
    assert rss_mb(2**22 + 1) is None and cpu_s(2**22 + 1) is None


def use(cpu):
    return {"rss_mb": 1.0, "cpu": cpu, "pid": 1}


def test_outside_load_is_what_the_machine_used_minus_ours():
    rows = [{"t_s": 2.0 * i, "machine": {"cpu": 2.0}, "edge": use(1.2), "node": use(0.1)} for i in range(5)]
    assert outside_load(rows) == {"cores": pytest.approx(0.7), "ours": 1.3, "method": "machine minus ours"}


def test_nothing_known_is_none():
    assert outside_load([]) == {"cores": None, "ours": None, "method": None}
    assert outside_load([{"t_s": 0.0, "edge": use(1.0)}])["cores"] is None
