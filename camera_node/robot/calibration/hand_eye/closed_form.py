"""Closed-form solutions of A X = X B (4.6) from OpenCV: Tsai-Lenz, which the thesis uses, and four others."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.calibration_constants import MAX_CLOSED_FORM
from camera_node.robot.calibration.hand_eye.samples import Array, Rotation, Samples, angle_deg, distance_mm, medoid
from freshfield.geometry import se3

METHODS = {
    "tsai": cv2.CALIB_HAND_EYE_TSAI,
    "park": cv2.CALIB_HAND_EYE_PARK,
    "horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}


@dataclass(frozen=True)
class Residuals:
    """Distances of each sample's target from their mean, in the frame where it is at rest.

    mm, deg: (N,) of translation and rotation.
    """

    mm: Array
    deg: Array

    @staticmethod
    def of(samples: Samples, x: Array) -> Residuals:
        """Residuals of any X (4, 4): from the chordal mean of rotations and the mean of translations."""
        places = target_at_rest(samples, x)
        center = se3(Rotation.from_matrix(places[:, :3, :3]).mean().as_matrix(), places[:, :3, 3].mean(axis=0))
        return Residuals(distance_mm(center, places), angle_deg(center, places))

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean squares of mm and deg."""
        return float(np.sqrt(np.mean(self.mm**2))), float(np.sqrt(np.mean(self.deg**2)))

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
    if not np.isfinite(rotation).all() or not np.isfinite(translation).all():
        raise CalibrationError(f"{method}: found no solution (the motions do not determine one)")
    u, _, vt = np.linalg.svd(np.asarray(rotation))
    return se3(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, np.ravel(translation))


def target_at_rest(samples: Samples, x: Array) -> Array:
    """(N, 4, 4): each sample's target pose in the frame where it is at rest, G_i X T_i."""
    return np.asarray(samples.moved @ x @ samples.target)


def start(samples: Samples) -> tuple[Array, Array]:
    """Start of the refinement, X and Y (4, 4): Park's closed form, and of the targets at rest the one nearest to all
    others. Raises CalibrationError."""
    few = samples.subsample(MAX_CLOSED_FORM)
    x = solve(few, "park")
    return x, medoid(target_at_rest(few, x))
