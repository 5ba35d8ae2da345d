"""The small parts of the live emulator: timer, histogram, priority."""

import asyncio
import os
import sys
import time
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel_emu.live import priority, timer
from channel_emu.live.histogram import Histogram
from channel_emu.live.timer import LoopTimer


@pytest.mark.parametrize("platform", [sys.platform, "elsewhere"])
async def test_timer_fires_once_armed_and_never_early(platform, monkeypatch):
    monkeypatch.setattr(timer.sys, "platform", platform)
    fired: list[int] = []
    woken = asyncio.Event()

    def fire() -> None:
        fired.append(time.perf_counter_ns())
        woken.set()

    subject = LoopTimer(fire)
    for span_ns in (0, 3_000_000, 20_000_000):
        woken.clear()
        begun = time.perf_counter_ns()
        subject.arm(10 * 10**9)
        subject.arm(span_ns)  # instead of what was armed before
        async with asyncio.timeout(5):
            await woken.wait()
        assert fired[-1] >= begun + span_ns
    subject.arm(30_000_000)
    subject.close()
    await asyncio.sleep(0.06)
    assert len(fired) == 3


@given(st.lists(st.floats(-3, 1e6), max_size=300), st.sampled_from([1, 50, 95, 99, 100]))
def test_histogram_percentiles_are_within_a_bin(values, percent):
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    found = histogram.percentile_ms(percent)
    if not values:
        assert found is None and histogram.mean_ms is None and histogram.linear() == ([], [])
        return
    counted = np.maximum(values, 0.0)
    exact = float(np.percentile(counted, percent, method="inverted_cdf"))
    assert found <= counted.max()
    assert exact * 0.999999 <= found
    if exact < 9e4:  # longer ones share a bin
        assert found <= max(exact * 1.0234, 1e-4)
    assert histogram.count == len(values) and histogram.max_ms == counted.max()
    assert histogram.mean_ms == pytest.approx(counted.mean())


@pytest.mark.parametrize("short_slice, reached", [(True, "short-slice"), (False, "normal")])
def test_without_real_time_the_slices_are_short_where_that_is_permitted(monkeypatch, short_slice, reached):
    monkeypatch.setattr(os, "sched_setscheduler", Mock(side_effect=PermissionError), raising=False)
    monkeypatch.setattr(priority, "_shorten_slice", lambda: short_slice)
    assert priority.raise_priority() == reached
