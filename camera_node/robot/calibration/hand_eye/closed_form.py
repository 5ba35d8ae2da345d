"""Closed-form solutions of A X = X B (4.6) from OpenCV: Tsai-Lenz, which the thesis uses, and four others."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.samples import Array, Rotation, Samples, angle_deg, distance_mm
from freshfield.geometry import se3

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
_LEVER_MM = 330.0


@dataclass(frozen=True)
class Residuals:
    """Distances of each sample's target from a center, in the frame where it is at rest.

    mm, deg: (N,) of translation and rotation.
    """

    mm: Array
    deg: Array

    @staticmethod
    def of(samples: Samples, x: Array, center: Array | None = None) -> Residuals:
        """Residuals of any X (4, 4). center: (4, 4); None: the chordal mean of rotations and the mean of
        translations."""
        places = target_at_rest(samples, x)
        if center is None:
            rotation = Rotation.from_matrix(places[:, :3, :3]).mean().as_matrix()
            center = se3(rotation, places[:, :3, 3].mean(axis=0))
        return Residuals(distance_mm(center, places), angle_deg(center, places))

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean squares of mm and deg."""
        return float(np.sqrt(np.mean(self.mm**2))), float(np.sqrt(np.mean(self.deg**2)))

    @property
    def medians(self) -> tuple[float, float]:
        """Medians of mm and deg."""
        return float(np.median(self.mm)), float(np.median(self.deg))

    @property
    def score_mm(self) -> float:
        """Median over the samples, where a rotation counts as the motion of a point at a third of a meter."""
        return float(np.median(self.mm + np.deg2rad(self.deg) * _LEVER_MM))


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
    if not np.isfinite(rotation).all() or not np.isfinite(translation).all():
        raise CalibrationError(f"{method}: found no solution (the motions do not determine one)")
    u, _, vt = np.linalg.svd(np.asarray(rotation))
    return se3(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, np.ravel(translation))


def target_at_rest(samples: Samples, x: Array) -> Array:
    """(N, 4, 4): each sample's target pose in the frame where it is at rest, G_i X T_i."""
    return np.asarray(samples.moved @ x @ samples.target)


def robust_start(samples: Samples) -> tuple[Array, Array]:
    """Start of the refinement, X and Y (4, 4): the closed form with the smallest median residual, tried on
    all samples and on small random subsets, which are the same in every run. Raises CalibrationError."""
    few = samples.subsample(MAX_CLOSED_FORM)
    rng = np.random.default_rng(0)
    subsets = []
    if len(few) > _SUBSET_SIZE + 1:
        subsets = [rng.choice(len(few), _SUBSET_SIZE, replace=False) for _ in range(_SUBSETS)]
    best: tuple[float, Array, Array] | None = None
    for chosen, method in [(few, "park"), (few, "daniilidis"), *((few.take(s), "park") for s in subsets)]:
        try:
            x = solve(chosen, method)
        except CalibrationError:
            continue
        y = _median_transform(target_at_rest(few, x))
        score = Residuals.of(few, x, y).score_mm
        if best is None or score < best[0]:
            best = score, x, y
    if best is None:
        raise CalibrationError("no closed form finds a solution: are the poses those of one flange and target?")
    return best[1], best[2]


def _median_transform(places: Array) -> Array:
    """The transform nearest to all others, a center that is robust to outliers."""
    distance = np.linalg.norm(places[:, None, :3, :] - places[None, :, :3, :], axis=(2, 3))
    return places[int(np.argmin(np.median(distance, axis=1)))]
