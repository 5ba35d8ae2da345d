"""Sensor noise has the configured variance and depends only on the random stream and frame number."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic.effects.sensor_noise import SensorNoise


def make(seed: int = 0, **parameters: float) -> SensorNoise:
    return SensorNoise(**parameters).start(np.random.default_rng(seed))


@pytest.mark.parametrize("level", [20, 128, 220])
def test_mean_and_variance(level):
    noise = make(read_noise_counts=2.0, full_well_electrons=2000.0)
    image = np.full((256, 256, 3), level, np.uint8)
    out = noise.apply(image, 0).astype(float)
    # Rounding to whole counts adds 1/12.
    expected = 4.0 + level * 255 / 2000 + 1 / 12
    assert out.mean() == pytest.approx(level, abs=0.05)
    assert out.var() == pytest.approx(expected, rel=0.02)


def test_neighbors_and_channels_are_independent():
    image = np.full((256, 256, 3), 128, np.uint8)
    noise = make(read_noise_counts=4.0)
    a, b = (noise.apply(image, k).astype(float) - 128 for k in (0, 1))
    for x, y in ((a, b), (a[..., 0], a[..., 1]), (a[1:], a[:-1]), (a[:, 1:], a[:, :-1])):
        assert abs(np.corrcoef(x.ravel(), y.ravel())[0, 1]) < 0.01


def test_black_and_white_stay_in_range():
    for level in (0, 255):
        out = make(read_noise_counts=50.0).apply(np.full((64, 64, 3), level, np.uint8), 0)
        assert out.dtype == np.uint8 and (out == level).mean() > 0.4  # clipped, not wrapped around
