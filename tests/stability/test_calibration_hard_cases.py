"""Calibration where the motion or the data is hard: refused with the reason, or right."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.calibrate import calibrate, distance_mm
from camera_node.robot.calibration.hand_eye.closed_form import METHODS, solve
from camera_node.robot.calibration.hand_eye.joint_refinement import refine
from camera_node.robot.calibration.hand_eye.samples import Samples, inverse
from freshfield.geometry import so3_exp
from tests.camera_node.robot.calibration import known_truth as simulated
from tests.camera_node.robot.calibration.pictures import noisy_samples

X = simulated.CAMERA_IN_HAND
SETUPS = (EYE_IN_HAND, EYE_TO_HAND)


def of_turns(turns, setup=EYE_IN_HAND, noise=(0.002, 0.0005)) -> Samples:
    """Samples of a hand turned by rotation vectors (N, 3) from where it began, somewhere else each time."""
    rng = np.random.default_rng(0)
    base = simulated.random_hands(1, rng)[0]
    hands = np.array([base] * len(turns))
    for hand, turn in zip(hands, turns):
        hand[:3, :3] = hand[:3, :3] @ so3_exp(turn)
        hand[:3, 3] += rng.normal(0, 0.05, 3)
    targets = simulated.observed_targets(hands)
    if setup == EYE_TO_HAND:
        hands = inverse(hands)
    return Samples(simulated.add_noise(hands, rng, *noise), targets, setup)


Z = np.array([0.0, 0.0, 1.0])
DEGENERATE = {
    "parallel axes": ([0.3 * k * Z for k in range(8)], "parallel axes"),
    "nearly parallel axes": ([[0.02 * (-1) ** k, 0.01 * k, 0.3 * k] for k in range(8)], "parallel axes"),
    "no turn at all": ([[0, 0, 0]] * 8, "hardly turned"),
    "turns of two degrees": ([np.eye(3)[k % 3] * 0.035 * (k // 3) for k in range(6)], "hardly turned"),
    "half turns": ([[0, 0, 0], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi]], "near 180 degrees"),
    "two poses": ([[0, 0, 0], [0.5, 0.5, 0]], "too few poses: 2"),
    "one pose": ([[0, 0, 0]], "too few poses: 1"),
    "none": ([], "too few poses: 0"),
}


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_motions_are_refused_with_the_reason(case, setup):
    turns, reason = DEGENERATE[case]
    samples = of_turns(turns, setup) if turns else Samples(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), setup)
    with pytest.raises(CalibrationError, match=reason):
        calibrate(samples)


@pytest.mark.parametrize("setup", SETUPS)
def test_the_least_that_determines_something_does(setup):
    """Three poses, two turns about axes at right angles."""
    found = refine(of_turns([[0, 0, 0], [0.9, 0, 0], [0, 0.9, 0]], setup, (1e-6, 1e-7)))
    assert distance_mm(found.x, X) < 0.05 and np.isfinite(found.covariance).all()


def test_motions_that_turn_by_nearly_half_a_turn_among_others_do_no_harm():
    turns = [
        [0, 0, 0],
        [np.pi - 0.01, 0, 0],
        [0, np.pi, 0],
        [0.6, 0, 0.2],
        [0, 0.7, 0],
        [0.3, -0.4, 0.5],
        [-0.5, 0.2, 0],
        [0.1, 0.2, -0.8],
    ]
    found = calibrate(of_turns(turns))
    assert distance_mm(found.transform, X) < 4 * found.refined.std_mm + 0.5
    assert any("nearly 180 degrees" in w for w in found.warnings)


def test_a_target_seen_at_exactly_half_a_turn():
    """T_i with rotations by pi about any axis: the closed forms and the refinement agree with the truth."""
    hands = simulated.random_hands(10, np.random.default_rng(1))
    target_in_base = X.copy()
    targets = inverse(X) @ inverse(hands) @ (hands[0] @ X @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert np.trace(targets[0][:3, :3]) == pytest.approx(-1.0)
    for method in METHODS:
        assert distance_mm(solve(Samples(hands, targets), method), target_in_base) < 0.01
    assert distance_mm(refine(Samples(hands, targets)).x, X) < 1e-3


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_poses_in_other_units_scale_the_answer(factor):
    """All lengths in kilometers or millimeters: the same calibration in that unit."""
    samples = noisy_samples(12, np.random.default_rng(2))
    hand, target = samples.hand.copy(), samples.target.copy()
    hand[:, :3, 3] *= factor
    target[:, :3, 3] *= factor
    found = refine(Samples(hand, target)).x
    reference = refine(samples).x
    np.testing.assert_allclose(found[:3, :3], reference[:3, :3], atol=1e-3)
    np.testing.assert_allclose(found[:3, 3] / factor, reference[:3, 3], atol=5e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_none_are_refused(value):
    samples = noisy_samples(8, np.random.default_rng(2))
    samples.hand[3, 0, 3] = value
    with pytest.raises(CalibrationError, match="finite"):
        Samples(samples.hand, samples.target)


def test_the_same_pose_again_and_again_changes_nothing_but_the_weight():
    samples = noisy_samples(10, np.random.default_rng(3))
    often = samples.take([*range(10), *[4] * 30])
    found = refine(often)
    assert np.isfinite(found.covariance).all() and distance_mm(found.x, X) < 3.0


def test_nothing_overflows_or_divides_by_zero_on_exact_data():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = calibrate(noisy_samples(12, np.random.default_rng(4), 0.0, 0.0))
    assert distance_mm(found.transform, X) < 1e-6


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_wrong_samples_up_to_three_in_ten(share):
    good = noisy_samples(30, np.random.default_rng(6))
    rng = np.random.default_rng(7)
    bad = rng.choice(30, int(30 * share), replace=False)
    target = good.target.copy()
    target[bad] = simulated.add_noise(target[bad], rng, 0.5, 0.1)
    found = refine(Samples(good.hand, target))
    assert set(bad) == set(found.outliers)
    assert distance_mm(found.x, X) < 1.5


@pytest.mark.parametrize("rad, meters", [(1e-5, 1e-6), (0.02, 0.005), (0.1, 0.03)])
def test_arms_from_superb_to_hopeless(rad, meters):
    """The error stays what the answer says of itself."""
    ratios = []
    for k in range(12):
        found = refine(noisy_samples(20, np.random.default_rng([8, k]), rad, meters))
        ratios.append(distance_mm(found.x, X) / found.std_mm)
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.6
