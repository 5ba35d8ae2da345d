"""Joint refinement of the hand-eye calibration: robust maximum likelihood of X, Y and the arm's noise.

The arm is not exact: in each sample the true hand pose differs a little from the reported one. With e_i the
six numbers by which the predicted hand differs from the reported one (rotation vector and translation, in the
hand's axes),

    e_i ~ t_8(0, S_i),   S_i = diag(s_rot^2 I, s_pos^2 I) + J_i C_i J_i^T,

where C_i is the covariance of the target's pose from detection. Marginalizing a latent hand pose for each
sample gives the same to first order, so there are 12 unknowns for any number of samples. s_rot and s_pos are
estimated too, by restricted likelihood, which accounts for the 12 fitted numbers: a minorize-maximize step
(Zhou et al., Journal of Computational and Graphical Statistics 28(2), 2019) follows each solution. Student's
t over whole samples, not over single numbers, gives an outlier little weight
(Lange, Little & Taylor, Journal of the American Statistical Association 84, 1989).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from camera_node.robot.calibration.hand_eye.closed_form import predicted_hand, robust_start
from camera_node.robot.calibration.hand_eye.samples import (
    Array,
    Rotation,
    Samples,
    inverse,
    rotation_vectors,
    transform_of,
)

# Of Student's t. ``calibrate accuracy`` shows the loss of efficiency on data without outliers.
_DEGREES_OF_FREEDOM = 8.0
_ROUNDS, _INNER_ROUNDS = 12, 60
# Radians, meters and seconds: smaller steps are far below what can be measured.
_CONVERGED = 1e-8
# Step of the central differences: radians and meters.
_STEP = 1e-6
# Lower bound of the noise: perfect data would make the likelihood infinite.
_MIN_RAD, _MIN_M = 1e-7, 1e-7
# A sample's weight is lower if its six whitened residuals have a sum of squares above 32. This happens to one
# good sample in sixty thousand.
OUTLIER_WEIGHT = 0.35


@dataclass(frozen=True)
class Refinement:
    """Result of the refinement.

    x, y: (4, 4).
    covariance: (6, 6) of x: rotation (radians, camera axes) and translation (meters).
    arm_noise_rad, arm_noise_m: the arm's noise, estimated or given.
    weights: (N,), about 1 for a good sample.
    offset_s, offset_std_s: time offset and its deviation, if velocities were given.
    """

    x: Array
    y: Array
    covariance: Array
    arm_noise_rad: float
    arm_noise_m: float
    weights: Array
    offset_s: float = 0.0
    offset_std_s: float = 0.0

    @property
    def std_deg(self) -> float:
        return _deviations(self.covariance)[0]

    @property
    def std_mm(self) -> float:
        return _deviations(self.covariance)[1]

    @property
    def outliers(self) -> list[int]:
        return [int(i) for i in np.flatnonzero(self.weights < OUTLIER_WEIGHT)]


def refine(
    samples: Samples,
    start: tuple[Array, Array] | None = None,
    arm_noise: tuple[float, float] | None = None,
    velocity: Array | None = None,
) -> Refinement:
    """Maximize the likelihood of X and Y.

    start: X and Y (4, 4) to begin with; None: those of ``robust_start``.
    arm_noise: (radians, meters), fixed instead of estimated. Near zero takes the arm as exact, which makes
        sense only if the target's covariance is known.
    velocity: (N, 6) of the hand in its own axes (rad/s, m/s), to refine the time offset too.
    Raises CalibrationError.
    """
    x, y = start if start is not None else robust_start(samples)
    offset_s = 0.0
    if start is None:
        x, y = _converge_start(samples, x, y)
    noise = np.array(arm_noise or _robust_scale(_residuals(samples, x, y)))
    for _ in range(_ROUNDS):
        # Step, noise and weights are solved together on the linearized problem, which is cheap.
        e, jacobian = _residuals(samples, x, y), _jacobian(samples, x, y, velocity)
        if velocity is not None:
            e = e - velocity * offset_s
        seen = _target_covariance(samples, x, y)
        step, noise, w = _solve_linearized(e, jacobian, seen, noise, arm_noise is None)
        x, y = _retract(x, step[:6]), _retract(y, step[6:12])
        if velocity is not None:
            offset_s += step[12]
        if np.abs(step).max() < _CONVERGED:
            break
    root = _whitener(_covariances(seen, len(samples), noise))
    covariance: Array = np.asarray(np.linalg.pinv(_information(root @ jacobian, w), hermitian=True))
    return Refinement(
        x,
        y,
        covariance[:6, :6],
        float(noise[0]),
        float(noise[1]),
        w,
        float(offset_s),
        float(np.sqrt(covariance[12, 12])) if velocity is not None else 0.0,
    )


def cramer_rao_bound(samples: Samples, x: Array, y: Array, arm_noise: tuple[float, float]) -> tuple[float, float]:
    """Cramer-Rao bound of X in degrees and mm at the truth, with Y unknown too. arm_noise: (radians,
    meters)."""
    return _deviations(np.linalg.inv(sample_information(samples, x, y, arm_noise).sum(axis=0)))


def _deviations(covariance: Array) -> tuple[float, float]:
    """Degrees and mm, each the root of the sum of three variances."""
    turn, shift = (np.sqrt(np.trace(covariance[k : k + 3, k : k + 3])) for k in (0, 3))
    return float(np.degrees(turn)), float(shift * 1e3)


def sample_information(samples: Samples, x: Array, y: Array, arm_noise: tuple[float, float]) -> Array:
    """Fisher information (N, 12, 12) of each sample on X and Y (rotation and translation of each)."""
    covariances = _covariances(_target_covariance(samples, x, y), len(samples), np.array(arm_noise))
    slopes = _whitener(covariances) @ _jacobian(samples, x, y, None)
    return np.asarray(np.swapaxes(slopes, 1, 2) @ slopes)


def derivative(of: Callable[[Array], Array], count: int) -> Array:
    """Derivative (..., count) of a function of a step (count,), at zero, by central differences."""
    steps = _STEP * np.eye(count)
    return np.stack([(of(step) - of(-step)) / (2 * _STEP) for step in steps], axis=-1)


def _retract(transform: Array, step: Array) -> Array:
    """Transforms (..., 4, 4), turned about their own axes and shifted by a step (6,)."""
    turn = np.asarray(Rotation.from_rotvec(step[:3]).as_matrix())
    return transform_of(transform[..., :3, :3] @ turn, transform[..., :3, 3] + step[3:])


def _residuals(samples: Samples, x: Array, y: Array) -> Array:
    """(N, 6): predicted minus reported hand (rotation vector, translation), in the hand's axes."""
    off = inverse(samples.hand) @ predicted_hand(samples, x, y)
    return np.concatenate([rotation_vectors(off[:, :3, :3]), off[:, :3, 3]], axis=1)


def _jacobian(samples: Samples, x: Array, y: Array, velocity: Array | None) -> Array:
    """(N, 6, 12 or 13): derivative of the residuals by X, Y and the time offset."""
    both = derivative(lambda step: _residuals(samples, _retract(x, step[:6]), _retract(y, step[6:])), 12)
    return both if velocity is None else np.concatenate([both, -velocity[:, :, None]], axis=2)


def _target_covariance(samples: Samples, x: Array, y: Array) -> Array | None:
    """(N, 6, 6): covariance of the residuals from the target's, None if the target is exact."""
    if samples.covariance is None:
        return None
    slopes = derivative(lambda step: _residuals(replace(samples, target=_retract(samples.target, step)), x, y), 6)
    return np.asarray(slopes @ samples.covariance @ np.swapaxes(slopes, 1, 2))


def _covariances(seen: Array | None, count: int, noise: Array) -> Array:
    own = np.diag(np.repeat(noise**2, 3))
    return np.broadcast_to(own, (count, 6, 6)) if seen is None else own + seen


def _whitener(covariances: Array) -> Array:
    """(N, 6, 6): W_i with W_i^T W_i the inverse of the covariance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))


def _information(whitened: Array, w: Array) -> Array:
    """Sum of w_i J_i^T J_i over whitened slopes (N, 6, P)."""
    flat = whitened.reshape(-1, whitened.shape[2])
    return np.asarray(flat.T @ (np.repeat(w, whitened.shape[1])[:, None] * flat))


def _converge_start(samples: Samples, x: Array, y: Array) -> tuple[Array, Array]:
    """Bring a poor start of X and Y near enough for the linearized rounds, by damped least squares with a
    robust loss."""
    scale = np.repeat(_robust_scale(_residuals(samples, x, y)), 3)

    def whitened(step: Array) -> Array:
        return (_residuals(samples, _retract(x, step[:6]), _retract(y, step[6:])) / scale).ravel()

    step = least_squares(whitened, np.zeros(12), loss="soft_l1", x_scale=0.1, max_nfev=20).x
    return _retract(x, step[:6]), _retract(y, step[6:])


def _solve_linearized(
    e: Array, jacobian: Array, seen: Array | None, noise: Array, estimate: bool
) -> tuple[Array, Array, Array]:
    """Consistent step (12 or 13,), noise (2,) and weights (N,) for residuals e + J step."""
    step = np.zeros(jacobian.shape[2])
    for _ in range(_INNER_ROUNDS):
        covariances = _covariances(seen, len(e), noise)
        root = _whitener(covariances)
        now = np.einsum("nij,nj->ni", root, e + jacobian @ step)
        w = (_DEGREES_OF_FREEDOM + 6.0) / (_DEGREES_OF_FREEDOM + (now**2).sum(axis=1))
        slopes = root @ jacobian
        inverse_information: Array = np.asarray(np.linalg.pinv(_information(slopes, w), hermitian=True))
        before = step
        step = step - inverse_information @ np.einsum("n,nki,nk->i", w, slopes, now)
        if not estimate:
            if np.abs(step - before).max() < _CONVERGED / 10:
                break
            continue
        left = np.einsum("nij,nj->ni", root, e + jacobian @ step)
        new = _update_noise(root, slopes, left, w, inverse_information, noise)
        settled = np.abs(new / noise - 1.0).max() < 1e-4
        noise = new
        if settled:
            break
    return step, noise, w


def _update_noise(root: Array, slopes: Array, left: Array, w: Array, inverse: Array, noise: Array) -> Array:
    """One minorize-maximize step of the arm's two deviations for the restricted likelihood."""
    # W^T times the whitened values: the inverse covariance times residuals and Jacobian.
    pull = np.einsum("nki,nk->ni", root, left)
    carried = np.swapaxes(root, 1, 2) @ slopes
    precision = np.einsum("nki,nki->ni", root, root)
    out = noise.copy()
    for k, part in enumerate((slice(0, 3), slice(3, 6))):
        found = float((w * (pull[:, part] ** 2).sum(axis=1)).sum())
        taken = _information(carried[:, part], w)
        freedom = float(precision[:, part].sum() - (inverse * taken).sum())
        out[k] = noise[k] * np.sqrt(np.sqrt(found / max(freedom, 1e-12)))
    return np.maximum(out, [_MIN_RAD, _MIN_M])


def _robust_scale(e: Array) -> tuple[float, float]:
    """Robust first estimate of the arm's noise (rad, m), by median absolute deviation."""
    turn, shift = (1.4826 * float(np.median(np.abs(part))) for part in (e[:, :3], e[:, 3:]))
    return max(turn, _MIN_RAD), max(shift, _MIN_M)
