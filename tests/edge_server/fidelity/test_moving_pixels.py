from __future__ import annotations

import itertools

import numpy as np
import pytest

from edge_server.fidelity.moving_pixels import BOUND, NoiseEstimate, frames_at_lags, moving_mask, pair_noise

MS = 1_000_000


def test_a_pixel_moves_if_any_channel_of_any_earlier_frame_differs():
    now = np.full((4, 4, 3), 0.5)
    one, two = now.copy(), now.copy()
    one[0, 0, 2] += 1.1 * BOUND
    two[3, 3, 1] -= 1.1 * BOUND
    two[1, 1] += 0.9 * BOUND
    assert list(zip(*np.nonzero(moving_mask(now, [one, two])))) == [(0, 0), (3, 3)]
    assert not moving_mask(now, []).any(), "without earlier frames nothing is known to move"


def test_frames_are_chosen_nearest_to_their_lags_without_repeats():
    times = [i * 100 * MS for i in range(11)]  # ten frames a second, present at 1000 ms
    assert frames_at_lags(times, 1000 * MS) == [9, 8, 7]  # 60 and 120 ms ago share the frame of 900 ms
    assert frames_at_lags(times, 0) == []
    assert frames_at_lags([0], 5 * MS) == [0]


@pytest.mark.parametrize("sigma", [0.001, 0.004, 0.02])
def test_noise_is_measured_through_8_bits_and_a_moving_third(sigma):
    rng = np.random.default_rng(3)
    scene = np.clip(rng.random((12, 16, 3)).repeat(8, 0).repeat(8, 1), 0.2, 0.8)
    estimate = NoiseEstimate()
    frames = []
    for i in range(6):
        moved = scene.copy()
        moved[:, :40] = np.roll(scene[:, :40], i * 5, axis=0)
        noisy = moved + rng.normal(0, sigma, scene.shape)
        frames.append(np.round(noisy * 255).astype(np.uint8))
    for a, b in itertools.pairwise(frames):
        estimate.add(a, b)
    # Rounding to 8 bits is noise too: 1/sqrt(12) of a step, though none where noise is far below a step.
    upper = np.hypot(sigma, 1 / 255 / np.sqrt(12))
    assert 0.6 * sigma <= estimate.sigma <= 1.05 * upper
    assert estimate.bound == max(BOUND, 4 * estimate.sigma)


def test_black_and_saturated_blocks_have_no_vote_and_noise_has_a_bound():
    rng = np.random.default_rng(6)
    a, b = np.zeros((64, 64, 3)), np.zeros((64, 64, 3))
    assert pair_noise(a, b) is None
    a[:16], b[:16] = 0.5 + rng.normal(0, 0.01, (2, 16, 64, 3))
    assert pair_noise(a, b) == pytest.approx(0.01, rel=0.1)
    a, b = rng.uniform(0.1, 0.9, (2, 32, 32, 3))
    estimate = NoiseEstimate()
    assert estimate.bound == BOUND
    estimate.add(a, b)
    assert estimate.bound == pytest.approx(0.2), "a moving camera does not pass for infinite noise"
    assert pair_noise(np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.6)) is None, "smaller than a block"
