"""Errors of images, poses and clocks are as large as asked for, and each camera's own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.effects.clock_drift import ClockDrift
from camera_node.synthetic.effects.exposure_drift import ExposureDrift
from camera_node.synthetic.effects.pose_noise import PoseNoise
from camera_node.synthetic.effects.sensor_noise import SensorNoise
from freshfield.geometry import Pose, look_at

TODAY_NS = 1_790_000_000_123_456_789
POSE = Pose.from_matrix(look_at([1.0, -2.0, 1.5], [0.3, 0.2, 0.4]))


def start(parameters: EffectParameters, seed: int = 0):
    return parameters.start(np.random.default_rng(seed))


def test_a_clock_is_off_by_offset_and_drift_to_the_nanosecond():
    clock = start(ClockDrift(offset_ms=12.5, drift_ppm=50.0))
    assert clock.node_ns(TODAY_NS) == TODAY_NS + 12_500_000
    later = TODAY_NS + 3600 * 10**9
    assert clock.node_ns(np.int64(later)) == later + 12_500_000 + 180_000_000  # 50 ppm of an hour is 180 ms


@given(st.floats(-200, 200), st.lists(st.integers(0, 10**15), min_size=2, max_size=20))
def test_a_clock_never_runs_backwards(drift_ppm, times):
    clock = start(ClockDrift(drift_ppm=drift_ppm))
    clock.node_ns(TODAY_NS)
    shown = [clock.node_ns(TODAY_NS + t) for t in sorted(times)]
    assert shown == sorted(shown)


def test_cameras_differ_by_the_spread_that_is_asked_for():
    clocks = [start(ClockDrift(offset_spread_ms=4.0, drift_spread_ppm=20.0), k) for k in range(2000)]
    exposures = [start(ExposureDrift(offset_spread_stops=0.4), k) for k in range(2000)]
    for values, spread in (
        ([1e-6 * c.offset_ns for c in clocks], 4.0),
        ([1e-3 * c.drift_ppb for c in clocks], 20.0),
        ([e.offset_stops for e in exposures], 0.4),
    ):
        assert np.std(values) == pytest.approx(spread, rel=0.06) and abs(np.mean(values)) < 0.1 * spread
    assert np.histogram([e.phase for e in exposures], 10, (0, 1))[0] == pytest.approx(200, abs=60)


def test_exposure_is_a_sine_in_stops_and_a_stop_doubles_as_far_as_white():
    drift = start(ExposureDrift(amplitude_stops=1.0, period_s=8.0, offset_spread_stops=0.0))
    peak_s = (0.25 - drift.phase) % 1.0 * 8.0
    image = np.array([[[0, 1, 60], [100, 127, 128], [200, 254, 255]]], np.uint8)
    for t_s, stops in ((peak_s, 1.0), (peak_s + 8e7, 1.0), (peak_s + 1.0, 0.5**0.5), (peak_s + 4.0, -1.0)):
        assert drift.stops(t_s) == pytest.approx(stops, abs=1e-6)
    assert drift.apply(image, 0, peak_s).ravel().tolist() == [0, 2, 120, 200, 254, 255, 255, 255, 255]
    trough = drift.apply(image, 0, peak_s + 4.0).ravel().tolist()
    assert trough == [0, 0, 30, 50, 64, 64, 100, 127, 128]  # halves round to the nearest even count
    assert (drift.apply(np.full((1, 1, 4), 100, np.uint8), 0, peak_s)[..., 3:] == 100).all(), "transparency is no color"


@pytest.mark.parametrize("level", [20, 220])
def test_sensor_noise_has_the_stated_variance_and_is_white(level):
    noise = start(SensorNoise(read_noise_counts=2.0, full_well_electrons=2000.0))
    image = np.full((256, 256, 3), level, np.uint8)
    a, b = (noise.apply(image, k).astype(float) - level for k in (0, 1))
    assert a.mean() == pytest.approx(0.0, abs=0.05)
    # Rounding to whole counts adds 1/12.
    assert a.var() == pytest.approx(4.0 + level * 255 / 2000 + 1 / 12, rel=0.02)
    for x, y in ((a, b), (a[..., 0], a[..., 1]), (a[1:], a[:-1]), (a[:, 1:], a[:, :-1])):
        assert abs(np.corrcoef(x.ravel(), y.ravel())[0, 1]) < 0.01
    for end in (0, 255):
        out = start(SensorNoise(read_noise_counts=50.0)).apply(np.full((64, 64, 3), end, np.uint8), 0)
        assert out.dtype == np.uint8 and (out == end).mean() > 0.4  # clipped, not wrapped around


def errors(poses: list[Pose]) -> np.ndarray:
    """Translations in mm and rotation vectors in degrees, in camera axes (N, 6)."""
    true = POSE.matrix()
    moved = np.array([p.translation_m for p in poses]) - true[:3, 3]
    turned = Rotation.from_matrix([true[:3, :3].T @ p.matrix()[:3, :3] for p in poses]).as_rotvec()
    return np.hstack([1e3 * moved, np.rad2deg(turned)])


def test_pose_noise_is_as_large_as_asked_for_and_white():
    noise = start(PoseNoise(translation_mm=8.0, rotation_deg=0.5))
    found = errors([noise.reported(POSE, k, 0.0) for k in range(3000)])
    assert found.std(axis=0) == pytest.approx([8.0] * 3 + [0.5] * 3, rel=0.04)
    assert np.abs(found.mean(axis=0) / found.std(axis=0)).max() < 0.06
    # One frame's error says nothing about the next one's, nor one axis about another.
    assert np.abs(np.corrcoef(found.T) - np.eye(6)).max() < 0.06
    assert max(abs(np.corrcoef(e[1:], e[:-1])[0, 1]) for e in found.T) < 0.06


def test_correlated_pose_noise_is_as_large_and_smooth():
    noise = start(PoseNoise(translation_mm=8.0, rotation_deg=0.5, correlation_s=2.0))
    found = errors([noise.reported(POSE, 0, 1.2 * k) for k in range(3300)])
    assert found.std(axis=0) == pytest.approx([8.0] * 3 + [0.5] * 3, rel=0.06)
    far = [np.corrcoef(axis[5:], axis[:-5])[0, 1] for axis in found.T]
    assert np.abs(far).max() < 0.06, "after three times that time nothing is left"
    near = errors([noise.reported(POSE, 0, 0.1 * k) for k in range(1000)]) / ([8.0] * 3 + [0.5] * 3)
    assert np.abs(np.diff(near, axis=0)).max() < 0.6, "in a twentieth of the time"
    assert noise.reported(POSE, 5, 3.7) == noise.reported(POSE, 9, 3.7) != noise.reported(POSE, 5, 3.8)


def test_the_bias_of_poses_is_a_cameras_own_and_for_good():
    bias = PoseNoise(translation_mm=0.0, rotation_deg=0.0, translation_bias_mm=12.0, rotation_bias_deg=0.8)
    cameras = [start(bias, k) for k in range(2000)]
    assert not cameras[0].varies
    assert cameras[5].reported(POSE, 0, 0.0) == cameras[5].reported(POSE, 900, 60.0)
    found = errors([c.reported(POSE, 0, 0.0) for c in cameras])
    assert found.std(axis=0) == pytest.approx([12.0] * 3 + [0.8] * 3, rel=0.05)
