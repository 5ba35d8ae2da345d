"""Closed-form solutions of A X = X B (4.6) from OpenCV: Tsai-Lenz, which the thesis uses, and four others."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.samples import Array, Rotation, Samples, angles, inverse, transform_of

METHODS = {
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "park": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
# OpenCV pairs every sample with every other: more samples take seconds and gain nothing.
MAX_CLOSED_FORM = 60
# Random subsets for the start of the refinement: some of them contain no outlier.
_SUBSETS, _SUBSET_SIZE = 24, 5


@dataclass(frozen=True)
class Residuals:
    """Distances of each sample's target from the mean of all, in the frame where it is at rest.

    mm, deg: (N,) of translation and rotation.
    """

    mm: Array
    deg: Array

    @property
    def rms_mm(self) -> float:
        return float(np.sqrt(np.mean(self.mm**2)))

    @property
    def rms_deg(self) -> float:
        return float(np.sqrt(np.mean(self.deg**2)))

    @property
    def medians(self) -> tuple[float, float]:
        """Medians of mm and deg."""
        return float(np.median(self.mm)), float(np.median(self.deg))


def solve(samples: Samples, method: str) -> Array:
    """X (4, 4) by one of ``METHODS``. Raises CalibrationError if it finds no solution."""
    few = samples.subsample(MAX_CLOSED_FORM)
    moved, target = few.moved, few.target
    try:
        # By keyword: as a positional argument the method would be an output, and OpenCV would run Tsai-Lenz.
        rotation, translation = cv2.calibrateHandEye(
            list(moved[:, :3, :3]),
            list(moved[:, :3, 3]),
            list(target[:, :3, :3]),
            list(target[:, :3, 3]),
            method=METHODS[method],
        )
    except cv2.error as error:
        raise CalibrationError(f"{method}: found no solution ({error.err})") from None
    found = transform_of(np.asarray(rotation), np.asarray(translation).ravel())
    if not np.isfinite(found).all():
        raise CalibrationError(f"{method}: found no solution (the motions do not determine one)")
    u, _, vt = np.linalg.svd(found[:3, :3])
    found[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return found


def target_at_rest(samples: Samples, x: Array) -> Array:
    """(N, 4, 4): each sample's target pose in the frame where it is at rest, G_i X T_i."""
    return np.asarray(samples.moved @ x @ samples.target)


def _mean_transform(transforms: Array) -> Array:
    """Chordal mean of rotations and mean of translations."""
    rotation = Rotation.from_matrix(transforms[:, :3, :3]).mean().as_matrix()
    return transform_of(np.asarray(rotation), transforms[:, :3, 3].mean(axis=0))


def residuals(samples: Samples, x: Array) -> Residuals:
    """Residuals of any X (4, 4)."""
    places = target_at_rest(samples, x)
    return _residuals_from(places, _mean_transform(places))


def _residuals_from(places: Array, center: Array) -> Residuals:
    turned = angles(center[:3, :3].T @ places[:, :3, :3])
    off = np.linalg.norm(places[:, :3, 3] - center[:3, 3], axis=1)
    return Residuals(off * 1e3, np.degrees(turned))


def predicted_hand(samples: Samples, x: Array, y: Array) -> Array:
    """Hand poses in base (N, 4, 4) that follow from X, Y and the target poses."""
    if samples.setup == EYE_IN_HAND:
        return np.asarray(y @ inverse(samples.target) @ inverse(x))
    return np.asarray(x @ samples.target @ inverse(y))


def robust_start(samples: Samples) -> tuple[Array, Array]:
    """Start of the refinement, X and Y (4, 4): the closed form with the smallest median residual, tried on
    all samples and on small random subsets, which are the same in every run. Raises CalibrationError."""
    few = samples.subsample(MAX_CLOSED_FORM)
    rng = np.random.default_rng(0)
    subsets = []
    if len(few) > _SUBSET_SIZE + 1:
        subsets = [rng.choice(len(few), _SUBSET_SIZE, replace=False) for _ in range(_SUBSETS)]
    tried = [(few, "park"), (few, "daniilidis"), *((few.take(s), "park") for s in subsets)]
    best: tuple[float, Array, Array] | None = None
    for chosen, method in tried:
        try:
            x = solve(chosen, method)
        except CalibrationError:
            continue
        places = target_at_rest(few, x)
        y = _median_transform(places)
        off = _residuals_from(places, y)
        # A rotation counts as the motion of a point at a third of a meter.
        score = float(np.median(off.mm + np.deg2rad(off.deg) * 330.0))
        if best is None or score < best[0]:
            best = score, x, y
    if best is None:
        raise CalibrationError("no closed form finds a solution: are the poses those of one hand and target?")
    return best[1], best[2]


def _median_transform(places: Array) -> Array:
    """The transform nearest to all others, a center that is robust to outliers."""
    distance = np.linalg.norm(places[:, None, :3, :] - places[None, :, :3, :], axis=(2, 3))
    return places[int(np.argmin(np.median(distance, axis=1)))]
