"""Exposure varies as a sine of the configured stops and period, independently for each camera."""

from __future__ import annotations

import math

import numpy as np
import pytest

from camera_node.synthetic.effects.exposure_drift import ExposureDrift


def make(seed: int = 0, **parameters: float) -> ExposureDrift:
    return ExposureDrift(**parameters).start(np.random.default_rng(seed))


def test_a_stop_doubles_and_white_is_the_end():
    drift = make(amplitude_stops=1.0, period_s=8.0, offset_spread_stops=0.0)
    peak_s = (0.25 - drift.phase) % 1.0 * 8.0
    image = np.array([[[0, 1, 60], [100, 127, 128], [200, 254, 255]]], np.uint8)
    assert drift.stops(peak_s) == pytest.approx(1.0)
    assert drift.apply(image, 0, peak_s).ravel().tolist() == [0, 2, 120, 200, 254, 255, 255, 255, 255]
    trough = drift.apply(image, 0, peak_s + 4.0).ravel().tolist()
    assert trough == [0, 0, 30, 50, 64, 64, 100, 127, 128]  # halves round to the nearest even count


def test_it_is_a_sine_of_time_and_repeats():
    drift = make(amplitude_stops=0.5, period_s=10.0, offset_spread_stops=0.3)
    for t in (0.0, 1.7, 4.9):
        expected = drift.offset_stops + 0.5 * math.sin(2 * math.pi * (t / 10 + drift.phase))
        assert drift.stops(t) == pytest.approx(expected)
        assert drift.stops(t + 1e7) == pytest.approx(expected, abs=1e-6)
    assert drift.stops(2.0) + drift.stops(7.0) == pytest.approx(2 * drift.offset_stops)


def test_cameras_differ_by_the_spread_and_begin_anywhere():
    drifts = [make(seed, offset_spread_stops=0.4) for seed in range(2000)]
    offsets, phases = (np.array([getattr(d, n) for d in drifts]) for n in ("offset_stops", "phase"))
    assert offsets.std() == pytest.approx(0.4, rel=0.06) and abs(offsets.mean()) < 0.04
    assert np.histogram(phases, 10, (0, 1))[0] == pytest.approx(200, abs=60)
    assert make(3).phase == drifts[3].phase
