"""Wall and virtual clocks; what a measurement cost: this process's own cores and memory, and the machine's."""

import os
import resource
import time

import pytest

from freshfield import machine_load
from freshfield.clock import VirtualClock, WallClock
from freshfield.machine_load import LoadMeter, outside_cores, outside_load
from tests.support import refused


def use(cpu):
    return {"rss_mb": 1.0, "cpu": cpu, "pid": 1}


def test_outside_load_is_what_the_machine_used_minus_ours():
    rows = [{"t_s": 2.0 * i, "machine": {"cpu": 2.0}, "edge": use(1.2), "node": use(0.1)} for i in range(5)]
    assert outside_load(rows) == {"cores": pytest.approx(0.7), "ours": 1.3, "method": "machine minus ours"}
    assert outside_load([]) == {"cores": None, "ours": None, "method": None}
    assert outside_load([{"t_s": 0.0, "edge": use(1.0)}])["cores"] is None


def test_a_row_has_the_cores_since_the_last_one(tmp_path, monkeypatch):
    """By hand: two seconds in which process 7 used 3 core-seconds, and the machine 5 of its 8."""
    ticks, now_s = os.sysconf("SC_CLK_TCK"), [100.0]
    monkeypatch.setattr(machine_load, "_PROC", tmp_path)
    monkeypatch.setattr(machine_load.time, "perf_counter", lambda: now_s[0])
    (tmp_path / "7").mkdir()
    (tmp_path / "7" / "statm").write_text("90000 50000 3")

    def used(process_s: tuple[float, float], machine_s: tuple[float, ...]) -> None:
        numbers = " ".join(str(round(s * ticks)) for s in process_s)
        (tmp_path / "7" / "stat").write_text(f"7 (a (b) S) {' '.join('9' * 11)} {numbers} 9")
        (tmp_path / "stat").write_text(f"cpu  {' '.join(str(round(s * ticks)) for s in machine_s)} 9 9\ncpu0 1")

    used((1.0, 1.0), (10, 0, 10, 50, 5, 0, 0, 0))
    meter = LoadMeter()
    assert meter.row(0.0, {"edge": 7})["edge"]["cpu"] == 0.0
    now_s[0] += 2.0
    used((3.0, 2.0), (11, 1, 11, 52, 6, 0.5, 0.5, 1))
    row = meter.row(2.0, {"edge": 7, "gone": 8})
    memory_mb = round(50_000 * resource.getpagesize() / 1e6, 1)
    assert row == {"t_s": 2.0, "edge": {"rss_mb": memory_mb, "cpu": 1.5, "pid": 7}, "machine": {"cpu": 2.5}}
    assert outside_cores(row) == 1.0


def test_the_wall_clock_is_utc_and_never_steps_back(monkeypatch):
    clock = WallClock()
    assert abs(clock.now_ns() - time.time_ns()) < 50_000_000
    monkeypatch.setattr(time, "time_ns", lambda: 0)  # somebody sets the machine's clock
    readings = [clock.now_ns() for _ in range(1000)]
    assert readings == sorted(readings) and readings[0] > 10**18


def test_virtual_time_only_goes_forward():
    clock = VirtualClock(5)
    clock.advance_to(5)
    clock.advance_to(9)
    assert clock.now_ns() == 9
    refused(ValueError, "cannot go back", clock.advance_to, 8)
