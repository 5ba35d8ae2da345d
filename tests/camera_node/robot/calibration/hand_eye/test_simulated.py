"""The simulated hand: what the other tests and the study take for the truth."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.robot.calibration.hand_eye import simulated
from camera_node.robot.calibration.hand_eye.closed_form import target_at_rest
from camera_node.robot.calibration.hand_eye.samples import Samples, diversity, inverse


@pytest.mark.parametrize("speed", [0.05, 0.5])
def test_the_sweep_keeps_its_speed_and_within_reach(speed):
    t_s = np.arange(0.0, 600.0 * 0.1 / speed, 0.1 * 0.1 / speed)
    sweep = simulated.Sweep(speed)
    steps = np.linalg.norm(np.diff(sweep.cameras(t_s)[:, :3, 3], axis=0), axis=1)
    assert steps.sum() / t_s[-1] == pytest.approx(speed, rel=0.02)
    assert np.linalg.norm(sweep.hands(t_s[::4])[:, :3, 3], axis=1).max() < simulated.REACH_M


def test_the_target_stands_still_and_the_camera_looks_at_it():
    hands = simulated.random_hands(20, np.random.default_rng(0))
    exact = Samples(hands, simulated.observed_targets(hands))
    np.testing.assert_allclose(
        target_at_rest(exact, simulated.CAMERA_IN_HAND), [simulated.TARGET_IN_BASE] * 20, atol=1e-12
    )
    middle = np.array([*simulated.TARGET_MIDDLE, 1.0])
    seen = inverse(hands @ simulated.CAMERA_IN_HAND) @ middle
    assert np.all(seen[:, 2] > 0.1) and np.all(np.abs(seen[:, :2]) < 0.3 * seen[:, 2:3])
    assert diversity(exact).reason is None


def test_noise_has_the_size_that_is_said():
    poses = simulated.random_hands(500, np.random.default_rng(1))
    off = inverse(poses) @ simulated.add_noise(poses, np.random.default_rng(2), 0.002, 0.0005)
    assert off[:, :3, 3].std() == pytest.approx(0.0005, rel=0.1)
    assert off[:, [2, 0, 1], [1, 2, 0]].std() == pytest.approx(0.002, rel=0.1)
