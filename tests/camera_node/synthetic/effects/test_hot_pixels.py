"""Damaged pixels keep their positions, hits are a Poisson process, and both have the configured means."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic.effects.hot_pixels import HotPixels

BLACK = np.zeros((500, 400, 3), np.uint8)
QUIET = {"hot_ppm": 0.0, "hits_per_megapixel": 0.0}


def make(seed: int = 0, **parameters: float) -> HotPixels:
    return HotPixels(**{**QUIET, **parameters}).start(np.random.default_rng(seed))


def test_the_share_of_damaged_pixels_and_what_they_add():
    out = make(hot_ppm=20_000.0, hot_counts=40.0).apply(BLACK, 0, 0.0).astype(float)
    # 4000 expected of 200,000; an exponential of mean 40 rounds to 0 for 1.2 % of them.
    assert np.count_nonzero(out) == pytest.approx(4000 * np.exp(-0.5 / 40), abs=4 * 63)
    values = out[out > 0]
    below = values[values < 200]
    assert np.median(values) == pytest.approx(40 * np.log(2), rel=0.08)
    assert (values > 80).mean() == pytest.approx(np.exp(-80 / 40), rel=0.15)
    assert below.size > 0.98 * values.size
    # Damage affects one of a pixel's three values.
    assert (np.count_nonzero(out, axis=2) <= 1).all()
    assert np.count_nonzero(out, axis=(0, 1)) == pytest.approx(out.astype(bool).sum() / 3, rel=0.1)


def test_damage_is_the_same_in_every_frame_and_another_in_every_camera():
    sensor = make(hot_ppm=2000.0)
    first = sensor.apply(BLACK, 0, 0.0)
    assert np.array_equal(sensor.apply(BLACK, 7, 0.5), first)
    assert np.array_equal(make(hot_ppm=2000.0).apply(BLACK, 3, 0.2), first)
    other = make(seed=1, hot_ppm=2000.0).apply(BLACK, 0, 0.0)
    both = np.count_nonzero(first.any(axis=2) & other.any(axis=2))
    assert both < 10 < np.count_nonzero(other.any(axis=2))


def test_hits_are_a_poisson_process_that_repeats_by_frame():
    sensor = make(hits_per_megapixel=150.0, hit_counts=1e6)  # 30 a frame here, each visible
    numbers = np.array([np.count_nonzero(sensor.apply(BLACK, k, 0.0)) for k in range(400)])
    assert numbers.mean() == pytest.approx(30.0, abs=4 * np.sqrt(30 / 400))
    assert numbers.var() == pytest.approx(30.0, rel=0.3)
    late = sensor.apply(BLACK, 2**40, 0.0)
    again = make(hits_per_megapixel=150.0, hit_counts=1e6)
    assert np.array_equal(again.apply(BLACK, 2**40, 0.0), late)
    assert not np.array_equal(again.apply(BLACK, 1, 0.0), late)


def test_it_adds_up_to_white_and_leaves_the_rest_of_the_image_alone():
    image = np.random.default_rng(0).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    kept = image.copy()
    out = make(hot_ppm=5000.0, hits_per_megapixel=1000.0, hit_counts=1e6).apply(image, 0, 0.0)
    assert np.array_equal(image, kept)
    changed = out != image
    assert (out >= image).all() and 0 < changed.sum() < 300
    assert (out[changed] == 255).sum() >= 20
    assert np.array_equal(make().apply(image, 0, 0.0), image)
