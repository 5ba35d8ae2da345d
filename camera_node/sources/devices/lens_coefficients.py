"""Approximates lenses with many coefficients by the four of a frame's header: OpenCV's k1, k2, p1, p2."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from freshfield.geometry import Pinhole

_RASTER = 25


def fit_opencv_distortion(width: int, height: int, k: ArrayLike, distortion: Sequence[float]) -> tuple[Pinhole, float]:
    """Least-squares fit of k1, k2, p1, p2 to a lens, over a grid of points in the image.

    width, height: of the image, pixels.
    k: OpenCV's camera matrix (3, 3), with pixel centers at whole numbers.
    distortion: OpenCV's coefficients (k1, k2, p1, p2, k3, k4, k5, k6, s1 .. s4, tx, ty), up to 14; the rest
        are zero.
    Returns the camera (corner origin) and the largest error on the grid, in pixels.
    """
    matrix = np.asarray(k, dtype=np.float64).reshape(3, 3)
    given = np.zeros(max(5, len(distortion)))
    given[: len(distortion)] = distortion
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    u, v = np.meshgrid(np.linspace(0, width - 1, _RASTER), np.linspace(0, height - 1, _RASTER))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    # Only rays that the image shows, so that the fit holds for all of it and for nothing beyond.
    straight = cv2.undistortPointsIter(
        pixels[:, None],
        matrix,
        given,
        np.eye(3),
        np.eye(3),
        (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12),
    ).reshape(-1, 2)
    x, y = straight.T
    r2 = x * x + y * y
    rows_x = np.stack([x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x], axis=-1)
    rows_y = np.stack([y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y], axis=-1)
    seen = (pixels - [cx, cy]) / [fx, fy]
    wanted = np.concatenate([seen[:, 0] - x, seen[:, 1] - y])
    found: NDArray[np.float64] = np.zeros(4)
    if any(distortion):  # otherwise rounding errors would make the lens count as distorted
        found, *_ = np.linalg.lstsq(np.concatenate([rows_x, rows_y]), wanted, rcond=None)
    lens = Pinhole(width, height, float(fx), float(fy), float(cx) + 0.5, float(cy) + 0.5, tuple(map(float, found)))  # type: ignore[arg-type]
    shown = lens.project(np.stack([x, y, np.ones_like(x)], axis=-1))
    return lens, float(np.abs(shown - 0.5 - pixels).max())
