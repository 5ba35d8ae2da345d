"""Hand-eye calibration where the motion or the data is hard: refused with the reason, or right."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.calibrate import calibrate
from camera_node.robot.calibration.hand_eye.closed_form import METHODS, solve
from camera_node.robot.calibration.hand_eye.refinement import refine
from camera_node.robot.calibration.hand_eye.samples import Samples, distance_mm
from freshfield.geometry import se3_inverse, so3_exp
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.rendered import noisy_samples

pytestmark = pytest.mark.stability

X = known_truth.CAMERA_IN_FLANGE
SETUPS = (EYE_IN_HAND, EYE_TO_HAND)


def of_turns(turns, setup=EYE_IN_HAND, noise=(0.002, 0.0005)) -> Samples:
    """Samples of a flange turned by rotation vectors (N, 3) from where it began, somewhere else each time."""
    rng = np.random.default_rng(0)
    flanges = np.array([known_truth.random_flanges(1, rng)[0]] * len(turns)).reshape(-1, 4, 4)
    for flange, turn in zip(flanges, turns):
        flange[:3, :3] = flange[:3, :3] @ so3_exp(turn)
        flange[:3, 3] += rng.normal(0, 0.05, 3)
    targets = known_truth.observed_targets(flanges)
    if setup == EYE_TO_HAND:
        flanges = se3_inverse(flanges)
    return Samples(known_truth.add_noise(flanges, rng, *noise) if turns else flanges, targets, setup)


DEGENERATE = {
    "parallel axes": ([[0, 0, 0.3 * k] for k in range(8)], "parallel axes"),
    "nearly parallel axes": ([[0.02 * (-1) ** k, 0.01 * k, 0.3 * k] for k in range(8)], "parallel axes"),
    "no turn at all": ([[0, 0, 0]] * 8, "hardly turned"),
    "turns of two degrees": ([np.eye(3)[k % 3] * 0.035 * (k // 3) for k in range(6)], "hardly turned"),
    "half turns": ([[0, 0, 0], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi]], "near 180 degrees"),
    "two poses": ([[0, 0, 0], [0.5, 0.5, 0]], "too few poses: 2"),
    "none": ([], "too few poses: 0"),
}


@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_motions_are_refused_with_the_reason(case, setup):
    turns, reason = DEGENERATE[case]
    with pytest.raises(CalibrationError, match=reason):
        calibrate(of_turns(turns, setup))


@pytest.mark.parametrize("setup", SETUPS)
def test_the_least_that_determines_something_does(setup):
    """Three poses, two turns about axes at right angles."""
    found = refine(of_turns([[0, 0, 0], [0.9, 0, 0], [0, 0.9, 0]], setup, (1e-6, 1e-7)))
    assert distance_mm(found.x, X) < 0.05 and np.isfinite(found.std_mm)


def test_motions_that_turn_by_nearly_half_a_turn_among_others_do_no_harm():
    turns = [
        [0, 0, 0],
        [np.pi - 0.01, 0, 0],
        [0, np.pi, 0],
        [0.6, 0, 0.2],
        [0, 0.7, 0],
        [0.3, -0.4, 0.5],
        [-0.5, 0.2, 0],
    ]
    found = calibrate(of_turns([*turns, [0.1, 0.2, -0.8]]))
    assert distance_mm(found.transform, X) < 4 * found.refined.std_mm + 0.5
    assert any("nearly 180 degrees" in w for w in found.warnings)


def test_a_target_seen_at_exactly_half_a_turn():
    flanges = known_truth.random_flanges(10, np.random.default_rng(1))
    targets = se3_inverse(X) @ se3_inverse(flanges) @ (flanges[0] @ X @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert np.trace(targets[0][:3, :3]) == pytest.approx(-1.0)
    for method in METHODS:
        assert distance_mm(solve(Samples(flanges, targets), method), X) < 0.01
    assert distance_mm(refine(Samples(flanges, targets)).x, X) < 1e-3


def test_numbers_that_are_none_are_refused():
    samples = noisy_samples(8, np.random.default_rng(2))
    for value in (np.nan, np.inf):
        samples.flange[3, 0, 3] = value
        with pytest.raises(CalibrationError, match="finite"):
            Samples(samples.flange, samples.target)


def test_the_same_pose_again_and_again_changes_nothing_but_the_weight():
    found = refine(noisy_samples(10, np.random.default_rng(3)).take([*range(10), *[4] * 30]))
    assert np.isfinite(found.std_mm) and distance_mm(found.x, X) < 3.0


def test_nothing_overflows_or_divides_by_zero_on_exact_data():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = calibrate(noisy_samples(12, np.random.default_rng(4), 0.0, 0.0))
    assert distance_mm(found.transform, X) < 1e-6
