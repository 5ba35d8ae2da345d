"""Hand-eye calibration on samples whose truth is known, and on real ones whose answer was published."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.calibrate import ALL_METHODS, calibrate
from camera_node.robot.calibration.hand_eye.closed_form import METHODS, Residuals, solve
from camera_node.robot.calibration.hand_eye.refinement import flange_residuals, refine
from camera_node.robot.calibration.hand_eye.samples import Samples, angle_deg, distance_mm, diversity
from camera_node.robot.calibration.inputs import read_visp_folder
from camera_node.robot.calibration.targets import parse_target
from freshfield.geometry import se3, se3_inverse, so3_exp
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.known_truth import noisy_samples
from tests.conftest import data_dir

X, Y = known_truth.CAMERA_IN_FLANGE, known_truth.TARGET_IN_BASE
SETUPS = (EYE_IN_HAND, EYE_TO_HAND)


@pytest.mark.parametrize("setup", SETUPS)
def test_every_method_is_exact_on_exact_samples(setup):
    exact = noisy_samples(12, np.random.default_rng(1), 0.0, 0.0, setup)
    with warnings.catch_warnings():  # nothing overflows or divides by zero
        warnings.simplefilter("error")
        found = calibrate(exact)
    for name in ALL_METHODS:
        np.testing.assert_allclose(found.results[name], X, atol=1e-8 if name == "refined" else 2e-6)
    np.testing.assert_allclose(found.refined.y, Y, atol=1e-8)
    assert Residuals.of(exact, X).rms[0] < 1e-9 and found.refined.std_mm < 1e-3


def test_residuals_have_units():
    """Of a target put 3 mm aside in one of four samples, and of one turned by 0.02 rad."""
    moved = np.array([np.eye(4)] * 4)
    targets = moved.copy()
    targets[0, 0, 3], targets[1, :3, :3] = 0.003, so3_exp([0.0, 0.0, 0.02])
    off = Residuals.of(Samples(moved, targets), np.eye(4), np.eye(4))
    np.testing.assert_allclose(off.mm, [3.0, 0.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(off.deg, [0.0, np.degrees(0.02), 0.0, 0.0], atol=1e-9)
    assert off.rms[0] == pytest.approx(1.5)
    # A rotation counts as the motion of a point at 330 mm.
    assert Residuals(np.array([2.0]), np.array([np.degrees(0.01)])).score_mm == pytest.approx(2.0 + 3.3)


@pytest.mark.parametrize(
    ("turns_deg", "reason"),
    [
        ([[0, 0, 0], [5.1, 0, 0], [0, 5.1, 0]], None),
        ([[0, 0, 0], [4.9, 0, 0], [0, 4.9, 0]], "hardly turned"),
        ([[0, 0, 0], [30, 0, 0], [-30 * np.cos(0.350), 30 * np.sin(0.350), 0]], None),  # axes spread by 8.2 degrees
        ([[0, 0, 0], [30, 0, 0], [-30 * np.cos(0.335), 30 * np.sin(0.335), 0]], "parallel axes"),  # by 7.8
        ([[0, 0, 0], [169, 0, 0], [0, 169, 0]], None),
        ([[0, 0, 0], [171, 0, 0], [0, 171, 0]], "near 180"),
    ],
)
def test_how_much_the_flange_must_turn(turns_deg, reason):
    flanges = np.array([se3(so3_exp(np.radians(turn)), np.zeros(3)) for turn in turns_deg])
    found = diversity(Samples(flanges, flanges)).reason
    assert found is None if reason is None else reason in str(found)


def test_the_flanges_residual_is_the_motion_from_the_reported_to_the_predicted_pose():
    exact = noisy_samples(4, np.random.default_rng(1), 0.0, 0.0)
    off = se3(so3_exp([0.01, -0.02, 0.03]), [0.001, 0.002, -0.003])
    found = flange_residuals(Samples(exact.flange @ np.linalg.inv(off), exact.target), X, Y)
    np.testing.assert_allclose(found, [[0.01, -0.02, 0.03, 0.001, 0.002, -0.003]] * 4, atol=1e-9)


def test_with_noise_on_the_arm_the_refinement_is_as_exact_as_can_be_and_says_so():
    """15 poses, arm noise .5 mm and .002 rad an axis. The Cramer-Rao bound is .0768 degrees, .410 mm."""
    trials = [noisy_samples(15, np.random.default_rng([7, trial])) for trial in range(24)]
    refined = [refine(samples) for samples in trials]
    found = ([each.x for each in refined], [solve(samples, "tsai") for samples in trials])
    off, off_tsai = ([(angle_deg(x, X), distance_mm(x, X)) for x in each] for each in found)
    said = [(each.std_deg, each.std_mm) for each in refined]
    rms, rms_tsai, rms_said = (np.sqrt(np.mean(np.square(v), axis=0)) for v in (off, off_tsai, said))
    bound = np.array([0.0768, 0.410])
    assert np.all(rms < 1.25 * bound) and np.all(rms > 0.75 * bound) and np.all(rms < rms_tsai)
    np.testing.assert_allclose(rms, rms_said, rtol=0.35)
    noise = [(each.arm_noise_rad, each.arm_noise_m) for each in refined]
    np.testing.assert_allclose(np.mean(noise, axis=0), [0.002, 0.0005], rtol=0.1)


def test_a_few_wrong_samples_are_found_and_hardly_count():
    good = noisy_samples(20, np.random.default_rng(5))
    bad = good.target.copy()
    bad[[3, 11, 17]] = known_truth.add_noise(bad[[3, 11, 17]], np.random.default_rng(6), 0.3, 0.08)
    found = calibrate(Samples(good.flange, bad))
    assert found.refined.outliers == [3, 11, 17]
    assert distance_mm(found.transform, X) < 1.0 < distance_mm(found.results["park"], X)
    assert sum("does not fit the others" in w for w in found.warnings) == 3
    noisy = noisy_samples(12, np.random.default_rng(5), 0.1, 0.02)
    assert any("residuals are large" in warning for warning in calibrate(noisy).warnings)


@pytest.mark.parametrize(
    ("setup", "factor", "says"),
    [(EYE_IN_HAND, 20 / 24, "too small .*24 mm, not 20"), (EYE_TO_HAND, 1.05, "too large .*19 mm, not 20")],
)
def test_a_board_of_another_size_than_said_is_told_and_its_size_found(setup, factor, says):
    said = noisy_samples(15, np.random.default_rng(2), 0.0005, 0.0002, setup).rescaled(1.0 / factor)
    found = calibrate(said, square_m=0.02)
    assert re.search(says, found.warnings[0]) and "--fit-size" in found.warnings[0]
    assert distance_mm(found.transform, X) > 5.0
    fitted = calibrate(said, square_m=0.02, fit_size=True)
    assert re.search(says, fitted.warnings[0]) and distance_mm(fitted.transform, X) < 1.0
    assert refine(said, with_scale=True).scale == pytest.approx(factor, abs=0.003)
    right = said.rescaled(factor)
    assert calibrate(right, fit_size=True).warnings == calibrate(right).warnings == ()


@pytest.mark.parametrize(
    ("scale", "says"), [(1e-3, "targets seem to be in millimeters"), (1e3, "flanges in millimeters")]
)
def test_meters_and_millimeters_do_not_mix(scale, says):
    with pytest.raises(CalibrationError, match=says):
        calibrate(noisy_samples(12, np.random.default_rng(3)).rescaled(scale))


def test_a_real_arm_whose_calibration_was_published():
    folder = data_dir("handeye_visp_franka")
    board = parse_target("chessboard:9x6:23.6mm")
    samples, unused = read_visp_folder(folder, board, None, EYE_IN_HAND, lambda done: None)
    assert len(samples) == 8 and not unused
    published = np.loadtxt(folder / "expected_eMc.txt")
    found = calibrate(samples)
    assert angle_deg(found.transform, published) < 0.13 and distance_mm(found.transform, published) < 0.2
    assert found.residuals.rms == pytest.approx((5.405, 0.459), abs=0.002)
    # This arm is off by millimeters.
    assert 1e-3 < found.refined.arm_noise_m < 1e-2
    park = found.results["park"]
    assert distance_mm(park, published) < 0.05 and angle_deg(park, published) < 0.02
    assert list(found.results) == [*METHODS, "refined"]


def of_turns(turns, noise=(0.002, 0.0005)) -> Samples:
    """Samples of a flange turned by rotation vectors (N, 3) from where it began, somewhere else each time."""
    rng = np.random.default_rng(0)
    flanges = np.array([known_truth.random_flanges(1, rng)[0]] * len(turns)).reshape(-1, 4, 4)
    for flange, turn in zip(flanges, turns):
        flange[:3, :3] = flange[:3, :3] @ so3_exp(turn)
        flange[:3, 3] += rng.normal(0, 0.05, 3)
    targets = known_truth.observed_targets(flanges)
    return Samples(known_truth.add_noise(flanges, rng, *noise) if turns else flanges, targets)


@pytest.mark.stability
@pytest.mark.parametrize(
    ("turns", "reason"),
    [
        ([[0.02 * (-1) ** k, 0.01 * k, 0.3 * k] for k in range(8)], "parallel axes"),
        ([np.eye(3)[k % 3] * 0.035 * (k // 3) for k in range(6)], "hardly turned"),
        ([[0, 0, 0], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi]], "near 180 degrees"),
        ([[0, 0, 0], [0.5, 0.5, 0]], "too few poses: 2"),
        ([], "too few poses: 0"),
    ],
)
def test_degenerate_motions_are_refused_with_the_reason(turns, reason):
    with pytest.raises(CalibrationError, match=reason):
        calibrate(of_turns(turns))


@pytest.mark.stability
def test_the_least_that_determines_something_does():
    """Three poses, two turns about axes at right angles."""
    found = refine(of_turns([[0, 0, 0], [0.9, 0, 0], [0, 0.9, 0]], (1e-6, 1e-7)))
    assert distance_mm(found.x, X) < 0.05 and np.isfinite(found.std_mm)


@pytest.mark.stability
def test_motions_that_turn_by_nearly_half_a_turn_among_others_do_no_harm():
    turns = [[0, 0, 0], [np.pi - 0.01, 0, 0], [0, np.pi, 0], [0.6, 0, 0.2], [0, 0.7, 0]]
    found = calibrate(of_turns([*turns, [0.3, -0.4, 0.5], [-0.5, 0.2, 0], [0.1, 0.2, -0.8]]))
    assert distance_mm(found.transform, X) < 4 * found.refined.std_mm + 0.5
    assert any("nearly 180 degrees" in w for w in found.warnings)


@pytest.mark.stability
def test_a_target_seen_at_exactly_half_a_turn():
    flanges = known_truth.random_flanges(10, np.random.default_rng(1))
    targets = se3_inverse(X) @ se3_inverse(flanges) @ (flanges[0] @ X @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert np.trace(targets[0][:3, :3]) == pytest.approx(-1.0)
    for method in METHODS:
        assert distance_mm(solve(Samples(flanges, targets), method), X) < 0.01
    assert distance_mm(refine(Samples(flanges, targets)).x, X) < 1e-3


@pytest.mark.stability
def test_numbers_that_are_none_are_refused():
    samples = noisy_samples(8, np.random.default_rng(2))
    for value in (np.nan, np.inf):
        samples.flange[3, 0, 3] = value
        with pytest.raises(CalibrationError, match="finite"):
            Samples(samples.flange, samples.target)
