from __future__ import annotations

import os

import pytest

from edge_server.report.machine import load_average, machine, outside_load, versions


def use(cpu):
    return {"rss_mb": 1.0, "cpu": cpu, "pid": 1}


def test_versions_name_what_figures_depend_on():
    found = versions()
    assert found["numpy"] and found["freshfield"] and found["python"].count(".") == 2


def test_machine_knows_itself():
    found = machine()
    assert found["cores"] == len(os.sched_getaffinity(0)) and found["memory_gb"] > 0


def test_a_machine_without_proc_is_unknown_and_no_error(tmp_path):
    found = machine(tmp_path)
    assert found["memory_gb"] is None and found["cores"] >= 1
    assert load_average(tmp_path) is None


def test_outside_load_is_what_the_machine_used_minus_ours():
    rows = [{"t_s": 2.0 * i, "machine": {"cpu": 2.0}, "edge": use(1.2), "node": use(0.1)} for i in range(5)]
    assert outside_load(rows) == {"cores": pytest.approx(0.7), "ours": 1.3, "method": "machine minus ours"}


def test_without_the_machines_own_count_the_load_average_must_do(tmp_path):
    (tmp_path / "loadavg").write_text("2.50 1.00 0.50 3/200 999\n")
    rows = [{"t_s": t, "edge": use(cpu)} for t, cpu in ((0.0, 9.0), (100.0, 1.0), (110.0, 2.0))]
    found = outside_load(rows, tmp_path)
    assert found["cores"] == 1.0 and found["method"] == "load average minus ours"  # 2.5 less a mean of 1.5


def test_ours_can_be_more_than_the_load_average_but_others_never_negative(tmp_path):
    (tmp_path / "loadavg").write_text("0.10 1.00 0.50 3/200 999\n")
    assert outside_load([{"t_s": 0.0, "edge": use(1.0)}], tmp_path)["cores"] == 0.0


def test_nothing_known_is_none(tmp_path):
    assert outside_load([], tmp_path) == {"cores": None, "ours": None, "method": None}
