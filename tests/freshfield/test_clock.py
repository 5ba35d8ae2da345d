"""Wall and virtual clocks."""

import time

import pytest

from freshfield.clock import VirtualClock, WallClock
from tests.support import refused

MS = 1_000_000


def test_the_wall_clock_is_utc_and_never_steps_back(monkeypatch):
    clock = WallClock()
    assert abs(clock.now_ns() - time.time_ns()) < 50 * MS
    monkeypatch.setattr(time, "time_ns", lambda: 0)  # somebody sets the machine's clock
    readings = [clock.now_ns() for _ in range(1000)]
    assert readings == sorted(readings) and readings[0] > 10**18


def test_a_wrong_clock_is_wrong_as_told(monkeypatch):
    monotonic = 10**12
    monkeypatch.setattr(time, "monotonic_ns", lambda: monotonic)
    right, wrong = WallClock(), WallClock(offset_ns=-3 * MS, drift_ppm=100.0)
    begin = wrong.now_ns() - right.now_ns()
    monotonic += 1000 * 10**9
    assert begin == pytest.approx(-3 * MS, abs=MS)
    assert wrong.now_ns() - right.now_ns() - begin == pytest.approx(100 * MS, abs=9)  # 100 ppm of 1000 s


def test_virtual_time_only_goes_forward():
    clock = VirtualClock(5)
    clock.advance_to(5)
    clock.advance_to(9)
    assert clock.now_ns() == 9
    refused(ValueError, "cannot go back", clock.advance_to, 8)
