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

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND
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
_JACKKNIFE_GROUPS = 30
# Radians, metres and seconds: smaller steps are far below what can be measured.
_CONVERGED = 1e-8
# Lower bound of the noise: perfect data would make the likelihood infinite.
_MIN_RAD, _MIN_M = 1e-7, 1e-7
# A sample's weight is lower if its six whitened residuals have a sum of squares above 32. This happens to one
# good sample in sixty thousand.
OUTLIER_WEIGHT = 0.35


@dataclass(frozen=True)
class Refinement:
    """Result of the refinement.

    x, y: (4, 4).
    covariance: (6, 6) of x: rotation (radians, camera axes) and translation (metres).
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
    weights: Array | None = None,
) -> Refinement:
    """Maximize the likelihood of X and Y.

    start: X and Y (4, 4) to begin with; None: those of ``robust_start``.
    arm_noise: (radians, metres), fixed instead of estimated. Near zero takes the arm as exact, which makes
        sense only if the target's covariance is known.
    velocity: (N, 6) of the hand in its own axes (rad/s, m/s), to refine the time offset too.
    weights: (N,), fixed instead of estimated.
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
        step, noise, w = _solve_linearized(e, jacobian, seen, noise, weights, arm_noise is None)
        x, y = _retract(x, step[:6]), _retract(y, step[6:12])
        if velocity is not None:
            offset_s += step[12]
        if np.abs(step).max() < _CONVERGED:
            break
    root = _whitener(_covariances(seen, len(samples), noise))
    covariance: Array = np.asarray(np.linalg.pinv(_information(root @ jacobian, w), hermitian=True))
    return Refinement(
        x, y, covariance[:6, :6], float(noise[0]), float(noise[1]), w, float(offset_s),
        float(np.sqrt(covariance[12, 12])) if velocity is not None else 0.0,
    )  # fmt: skip


def cramer_rao_bound(
    samples: Samples, x: Array, y: Array, arm_noise: tuple[float, float]
) -> tuple[float, float]:
    """Cramer-Rao bound of X in degrees and mm at the truth, with Y unknown too. arm_noise: (radians,
    metres)."""
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


def jackknife(samples: Samples, found: Refinement) -> tuple[float, float, int]:
    """Jackknife deviations of X in degrees and mm (roots of summed variances), and the number of groups: one
    per sample, or at most 30 stretches of the recording."""
    parts = np.array_split(np.arange(len(samples)), min(_JACKKNIFE_GROUPS, len(samples)))
    rotations, shifts = [], []
    for part in parts:
        kept = np.setdiff1d(np.arange(len(samples)), part)
        again = refine(
            samples.take(kept), (found.x, found.y), (found.arm_noise_rad, found.arm_noise_m),
            weights=found.weights[kept],
        )  # fmt: skip
        rotations.append(rotation_vectors(found.x[:3, :3].T @ again.x[:3, :3]))
        shifts.append(again.x[:3, 3] - found.x[:3, 3])
    factor = (len(parts) - 1) / len(parts)
    spread = [np.sqrt(factor * ((v - v.mean(axis=0)) ** 2).sum()) for v in map(np.array, (rotations, shifts))]
    return float(np.degrees(spread[0])), float(spread[1] * 1e3), len(parts)


def _retract(transform: Array, step: Array) -> Array:
    turn = np.asarray(Rotation.from_rotvec(step[:3]).as_matrix())
    return transform_of(transform[:3, :3] @ turn, transform[:3, 3] + step[3:])


def _residuals(samples: Samples, x: Array, y: Array) -> Array:
    """(N, 6): predicted minus reported hand (rotation vector, translation), in the hand's axes."""
    off = inverse(samples.hand) @ predicted_hand(samples, x, y)
    return np.concatenate([rotation_vectors(off[:, :3, :3]), off[:, :3, 3]], axis=1)


def _jacobian(samples: Samples, x: Array, y: Array, velocity: Array | None) -> Array:
    """(N, 6, 12 or 13): Jacobian of the residuals by X, Y and the time offset.

    Both setups predict the hand as a M b^-1: a = Y, M = T^-1, b = X for eye-in-hand; a = X, M = T, b = Y for
    eye-to-hand.
    """
    held = samples.setup == EYE_IN_HAND
    a, b, m = (y, x, inverse(samples.target)) if held else (x, y, samples.target)
    lever = b[:3, :3].T @ b[:3, 3]
    arm = m[:, :3, 3] - m[:, :3, :3] @ lever
    am = a[:3, :3] @ m[:, :3, :3]
    of_a = np.zeros((len(samples), 6, 6))
    of_b = np.zeros((len(samples), 6, 6))
    of_a[:, :3, :3] = np.swapaxes(m[:, :3, :3] @ b[:3, :3].T, 1, 2)
    of_a[:, 3:, :3] = -a[:3, :3] @ _skew(arm)
    of_a[:, 3:, 3:] = np.eye(3)
    of_b[:, :3, :3] = -b[:3, :3]
    of_b[:, 3:, :3] = -am @ _skew(lever)
    of_b[:, 3:, 3:] = -am @ b[:3, :3].T
    both = _to_hand_frame(samples, x, y, np.concatenate([of_b, of_a] if held else [of_a, of_b], axis=2))
    return both if velocity is None else np.concatenate([both, -velocity[:, :, None]], axis=2)


def _to_hand_frame(samples: Samples, x: Array, y: Array, slopes: Array) -> Array:
    """Jacobian (N, 6, P) of the predicted hand (rotation about its own axes, position in the base) as a
    Jacobian of the residuals, which are rotation vectors and positions in the reported hand."""
    turns = _residuals(samples, x, y)[:, :3]
    k = _skew(turns)
    out = np.empty_like(slopes)
    # The inverse right Jacobian of SO(3), to second order in the error.
    out[:, :3] = (np.eye(3) + k / 2 + k @ k / 12) @ slopes[:, :3]
    out[:, 3:] = np.swapaxes(samples.hand[:, :3, :3], 1, 2) @ slopes[:, 3:]
    return out


def _skew(v: Array) -> Array:
    """(..., 3, 3): cross-product matrices of vectors (..., 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _target_covariance(samples: Samples, x: Array, y: Array) -> Array | None:
    """(N, 6, 6): covariance of the predicted hand from the target's, None if the target is exact."""
    if samples.covariance is None:
        return None
    turn, shift = samples.target[:, :3, :3], samples.target[:, :3, 3:]
    back = np.swapaxes(turn, 1, 2)
    slopes = np.zeros((len(samples), 6, 6))
    if samples.setup == EYE_IN_HAND:  # Y T^-1 X^-1
        lever = back @ (shift + (x[:3, :3].T @ x[:3, 3])[:, None])
        slopes[:, :3, :3] = -x[:3, :3] @ turn
        slopes[:, 3:, :3] = -y[:3, :3] @ _skew(lever[..., 0])
        slopes[:, 3:, 3:] = -y[:3, :3] @ back
    else:  # X T Y^-1
        slopes[:, :3, :3] = y[:3, :3]
        slopes[:, 3:, :3] = x[:3, :3] @ turn @ _skew(y[:3, :3].T @ y[:3, 3])
        slopes[:, 3:, 3:] = x[:3, :3]
    slopes = _to_hand_frame(samples, x, y, slopes)
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

    def slopes(step: Array) -> Array:
        # Derivative by a further step, not by this one: equal for small rotations.
        found = _jacobian(samples, _retract(x, step[:6]), _retract(y, step[6:]), None)
        return np.asarray((found / scale[:, None]).reshape(-1, 12))

    step = least_squares(whitened, np.zeros(12), slopes, loss="soft_l1", x_scale=0.1, max_nfev=20).x
    return _retract(x, step[:6]), _retract(y, step[6:])


def _solve_linearized(
    e: Array, jacobian: Array, seen: Array | None, noise: Array, weights: Array | None, estimate: bool
) -> tuple[Array, Array, Array]:
    """Consistent step (12 or 13,), noise (2,) and weights (N,) for residuals e + J step."""
    w = np.ones(len(e)) if weights is None else weights
    step = np.zeros(jacobian.shape[2])
    for _ in range(_INNER_ROUNDS):
        covariances = _covariances(seen, len(e), noise)
        root = _whitener(covariances)
        now = np.einsum("nij,nj->ni", root, e + jacobian @ step)
        if weights is None:
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
