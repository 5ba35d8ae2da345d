"""Proposed poses: the target stays in the image, and fewer poses are needed."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
from camera_node.robot.calibration.accuracy_study import _proposed_hands
from camera_node.robot.calibration.hand_eye import simulated
from camera_node.robot.calibration.hand_eye.joint_refinement import cramer_rao_bound
from camera_node.robot.calibration.hand_eye.next_pose import MAX_TILT_DEG, describe_motion, propose_pose
from camera_node.robot.calibration.hand_eye.samples import Samples, inverse
from freshfield.geometry import so3_exp

X, Y = simulated.CAMERA_IN_HAND, simulated.TARGET_IN_BASE
NOISE = (simulated.ARM_RAD, simulated.ARM_M)
MIDDLE = (inverse(Y) @ np.append(simulated.TARGET_MIDDLE, 1.0))[:3]


def known(count: int, seed: int, setup: str = EYE_IN_HAND) -> Samples:
    hands = simulated.random_hands(count, np.random.default_rng(seed))
    targets = simulated.observed_targets(hands)
    return Samples(hands if setup == EYE_IN_HAND else inverse(hands), targets, setup)


@pytest.mark.parametrize("setup", [EYE_IN_HAND, EYE_TO_HAND])
@pytest.mark.parametrize("seed", range(5))
def test_the_target_is_seen_and_the_bound_falls(seed, setup):
    samples = known(5, seed, setup)
    hand, again = (propose_pose(samples, X, Y, NOISE, MIDDLE, np.random.default_rng(seed)) for _ in range(2))
    np.testing.assert_array_equal(hand, again)
    target = inverse(X) @ (inverse(hand) if setup == EYE_IN_HAND else hand) @ Y
    middle = target @ np.append(MIDDLE, 1.0)
    assert 0.1 < middle[2] < 0.4 and np.all(np.abs(middle[:2]) < 0.1 * middle[2])
    assert target[2, 2] > np.cos(np.deg2rad(MAX_TILT_DEG)) - 1e-9  # faces the camera
    more = Samples(np.append(samples.hand, [hand], 0), np.append(samples.target, [target], 0), setup)
    before = cramer_rao_bound(samples, X, Y, NOISE)[1]
    assert cramer_rao_bound(more, X, Y, NOISE)[1] < 0.85 * before


def test_eight_planned_poses_are_worth_fifteen_of_chance():
    planned = [cramer_rao_bound(_proposed_hands(8, np.random.default_rng(k))[0], X, Y, NOISE) for k in range(8)]
    chance = [cramer_rao_bound(known(15, k), X, Y, NOISE) for k in range(8)]
    assert np.mean(planned, axis=0)[1] < 1.05 * np.mean(chance, axis=0)[1]


@pytest.mark.parametrize(
    ("turn", "shift", "words"),
    [
        ((0.5, 0.1, 0), (0.1, 0, -0.03), "by about 29 degrees, mostly about its +x, move +10 cm x, -3 cm z"),
        ((0, -1.0, 0), (0, 0, 0.001), "by about 57 degrees, mostly about its -y"),
    ],
)
def test_a_way_in_words(turn, shift, words):
    now = simulated.random_hands(1, np.random.default_rng(0))[0]
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = so3_exp(turn), shift
    assert describe_motion(now, now @ step) == f"turn {words}"
