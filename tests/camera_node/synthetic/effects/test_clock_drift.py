"""The node clock is exact to the nanosecond at any date."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.synthetic.effects.clock_drift import ClockDrift

TODAY_NS = 1_790_000_000_123_456_789


def make(seed: int = 0, **parameters: float) -> ClockDrift:
    return ClockDrift(**parameters).start(np.random.default_rng(seed))


def test_offset_and_drift():
    clock = make(offset_ms=12.5, drift_ppm=50.0)
    assert clock.node_ns(TODAY_NS) == TODAY_NS + 12_500_000
    later = TODAY_NS + 3600 * 10**9
    assert clock.node_ns(later) == later + 12_500_000 + 180_000_000  # 50 ppm of an hour is 180 ms
    assert isinstance(clock.node_ns(np.int64(later)), int)


@given(st.floats(-200, 200), st.lists(st.integers(0, 10**15), min_size=2, max_size=20))
def test_a_clock_never_runs_backwards(drift_ppm, times):
    clock = make(drift_ppm=drift_ppm)
    clock.node_ns(TODAY_NS)
    shown = [clock.node_ns(TODAY_NS + t) for t in sorted(times)]
    assert shown == sorted(shown)


def test_cameras_differ_by_the_spread_and_repeat_by_their_stream():
    clocks = [make(seed=k, offset_spread_ms=4.0, drift_spread_ppm=20.0) for k in range(2000)]
    offsets = np.array([c.offset_ns for c in clocks]) * 1e-6
    drifts = np.array([c.drift_ppb for c in clocks]) * 1e-3
    assert offsets.std() == pytest.approx(4.0, rel=0.06) and abs(offsets.mean()) < 0.4
    assert drifts.std() == pytest.approx(20.0, rel=0.06)
    assert make(seed=3, offset_spread_ms=4.0).offset_ns == clocks[3].offset_ns
