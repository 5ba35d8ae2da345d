"""Joint refinement of the hand-eye calibration: robust maximum likelihood of X, Y and the arm's noise.

The arm is not exact: in each sample the true flange pose differs a little from the reported one. With e_i the
six numbers by which the predicted flange differs from the reported one (rotation vector and translation, in the
flange's axes),

    e_i ~ t_8(0, diag(s_rot^2 I, s_pos^2 I)),

with s_rot and s_pos estimated too. Student's t over whole samples, not over single numbers, gives an outlier
little weight (Lange, Little & Taylor, Journal of the American Statistical Association 84, 1989).

A board of another size than was said makes all distances to it too long or too short by one factor, which the arm's
own motion tells: it can be estimated beside X and Y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND
from camera_node.robot.calibration import calibration_constants as tuned
from camera_node.robot.calibration.hand_eye.closed_form import start as closed_form_start
from camera_node.robot.calibration.hand_eye.samples import Array, Rotation, Samples, rotation_vectors
from freshfield.geometry import se3, se3_inverse


@dataclass(frozen=True)
class Refinement:
    """Result of the refinement.

    x, y: (4, 4).
    std_deg, std_mm: standard deviations of x, each the root of the sum of three variances.
    arm_noise_rad, arm_noise_m: the arm's noise.
    scale, scale_std: said by true distance to the target, and its standard deviation; 1 and 0 if not estimated.
    weights: (N,), about 1 for a good sample.
    """

    x: Array
    y: Array
    std_deg: float
    std_mm: float
    arm_noise_rad: float
    arm_noise_m: float
    weights: Array
    scale: float = 1.0
    scale_std: float = 0.0

    @property
    def outliers(self) -> list[int]:
        return [int(i) for i in np.flatnonzero(self.weights < tuned.OUTLIER_WEIGHT)]


def refine(samples: Samples, with_scale: bool = False) -> Refinement:
    """Maximize the likelihood of X and Y, and of the scale if asked to. Raises CalibrationError."""
    scale, (x, y) = 1.0, closed_form_start(samples)
    start = np.zeros(13 if with_scale else 12)

    def residuals(step: Array) -> Array:
        seen = samples.rescaled(scale * np.exp(step[12])) if with_scale else samples
        return flange_residuals(seen, _retract(x, step[:6]), _retract(y, step[6:12]))

    noise = _robust_scale(residuals(start))
    for _ in range(tuned.ROUNDS):
        widths = np.repeat(noise, 3)
        solved = least_squares(
            lambda step, widths=widths: (residuals(step) / widths).ravel(),
            start,
            x_scale="jac",
            loss=_student_t,
            ftol=tuned.SMALLEST_LIKELIHOOD_GAIN,
        )
        e = residuals(solved.x)
        x, y = _retract(x, solved.x[:6]), _retract(y, solved.x[6:12])
        scale *= float(np.exp(solved.x[12])) if with_scale else 1.0
        before, noise = noise, _noise(e, noise)
        if np.abs(noise / before - 1.0).max() < tuned.SETTLED:
            break
    covariance = np.linalg.pinv(solved.jac.T @ solved.jac, hermitian=True)
    turn, shift = (float(np.sqrt(np.trace(covariance[k : k + 3, k : k + 3]))) for k in (0, 3))
    deg, mm = float(np.degrees(turn)), shift * 1e3
    scale_std = scale * float(np.sqrt(covariance[12, 12])) if with_scale else 0.0
    return Refinement(x, y, deg, mm, float(noise[0]), float(noise[1]), _weights(e, noise), scale, scale_std)


def flange_residuals(samples: Samples, x: Array, y: Array) -> Array:
    """(N, 6): predicted minus reported flange (rotation vector, translation), in the flange's axes."""
    if samples.setup == EYE_IN_HAND:
        predicted = y @ se3_inverse(samples.target) @ se3_inverse(x)
    else:
        predicted = x @ samples.target @ se3_inverse(y)
    off = se3_inverse(samples.flange) @ predicted
    return np.concatenate([rotation_vectors(off[:, :3, :3]), off[:, :3, 3]], axis=1)


def _retract(transform: Array, step: Array) -> Array:
    """A transform (4, 4), turned about its own axes and shifted by a step (6,)."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    return se3(transform[:3, :3] @ turn, transform[:3, 3] + step[3:])


def _student_t(squares: Array) -> Array:
    """scipy's loss (3, 6 N) for squared whitened residuals (6 N,): its value, of which each of a sample's six
    numbers has a sixth, and its slope, which is the sample's weight. The second derivative is taken as 0."""
    total = squares.reshape(-1, 6).sum(axis=1)
    value = (tuned.DEGREES_OF_FREEDOM + 6.0) * np.log1p(total / tuned.DEGREES_OF_FREEDOM) / 6.0
    slope = (tuned.DEGREES_OF_FREEDOM + 6.0) / (tuned.DEGREES_OF_FREEDOM + total)
    return np.stack([np.repeat(value, 6), np.repeat(slope, 6), np.zeros(len(squares))])


def _weights(e: Array, noise: Array) -> Array:
    """Weights (N,) of the samples under Student's t."""
    whitened = e / np.repeat(noise, 3)
    return np.asarray((tuned.DEGREES_OF_FREEDOM + 6.0) / (tuned.DEGREES_OF_FREEDOM + (whitened**2).sum(axis=1)))


def _noise(e: Array, noise: Array) -> Array:
    """The arm's noise (rad, m) that is most likely for residuals (N, 6), starting from ``noise`` (2,). Of each
    three coordinates a sample, six parameters are taken as fitted."""
    squares = (e**2).reshape(-1, 2, 3).sum(axis=2)
    freedom = max(3 * len(e) - 6, 1)
    for _ in range(tuned.NOISE_STEPS):
        before = noise
        noise = np.maximum(np.sqrt(_weights(e, noise) @ squares / freedom), tuned.MIN_NOISE)
        if np.abs(noise / before - 1.0).max() < tuned.NOISE_SETTLED:
            break
    return noise


def _robust_scale(e: Array) -> Array:
    """Robust first estimate of the arm's noise (rad, m), by median absolute deviation."""
    scale = [1.4826 * float(np.median(np.abs(part))) for part in (e[:, :3], e[:, 3:])]
    return np.maximum(scale, tuned.MIN_NOISE)
