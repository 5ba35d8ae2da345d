"""Bundle adjustment of cameras and a flat target held still at several moments (Triggs et al. 2000).

Least squares of reprojection errors over the cameras' poses, the target's, and the lenses. OpenCV gives the derivatives
(``composeRT``, ``projectPoints``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from camera_node.robot.calibration.settings import FIRST_DAMPING, LAST_DAMPING, MOST_STEPS, ROBUST_PX, SMALLEST_GAIN
from camera_node.robot.calibration.targets import Array, Corners
from freshfield.geometry import Pinhole, se3, so3_log

_LENS = 8  # fx, fy, cx, cy, k1, k2, p1, p2, in the order of projectPoints' derivatives


@dataclass(frozen=True)
class Sighting:
    """One camera's view of the target at one moment."""

    camera: str
    moment: str
    corners: Corners


@dataclass(frozen=True)
class Bundle:
    """What fits the sightings best.

    cameras: name -> (4, 4), from the first camera's axes to its own.
    boards: moment -> (4, 4), from the target's axes to the first camera's.
    lenses: by camera.
    error_px: (S,) root mean square reprojection error of each sighting.
    std: name -> standard deviations of a camera's rotation (3) in radians and translation (3) in meters.
    """

    cameras: Mapping[str, Array]
    boards: Mapping[str, Array]
    lenses: Mapping[str, Pinhole]
    error_px: Array
    std: Mapping[str, Array]


def adjust(
    sightings: Sequence[Sighting],
    cameras: Mapping[str, Array],
    boards: Mapping[str, Array],
    lenses: Mapping[str, Pinhole],
    refine_lenses: bool,
) -> Bundle:
    """Adjust start values to what was seen.

    cameras, boards: start values, as in ``Bundle``; the first camera stays where it is.
    refine_lenses: whether lenses are estimated, too.
    """
    layout = _Layout(sightings, list(cameras), list(boards), lenses, refine_lenses)
    start = np.concatenate(
        [
            *(_six(cameras[name]) for name in layout.cameras[1:]),
            *(_six(pose) for pose in boards.values()),
            *(_lens_numbers(lenses[name]) for name in layout.cameras if refine_lenses),
        ]
    )
    found = _minimize(layout, start)
    residuals, jacobian = layout.residuals(found), layout.jacobian(found)
    freedom = max(1, len(residuals) - len(found))
    scale = (1.4826 * np.median(np.abs(residuals))) ** 2 * len(residuals) / freedom  # outliers do not count
    variance = np.diag(np.linalg.pinv((jacobian.T @ jacobian).toarray())) * scale
    ends = np.cumsum([2 * len(s.corners.points) for s in sightings])
    squares = [float(np.mean(part**2)) * 2 for part in np.split(residuals, ends[:-1])]
    std = np.sqrt(np.maximum(variance[: 6 * (len(cameras) - 1)], 0.0)).reshape(-1, 6)
    numbers = layout.unpacked(found)
    return Bundle(
        {name: _matrix(numbers[0][k]) for k, name in enumerate(layout.cameras)},
        {name: _matrix(numbers[1][k]) for k, name in enumerate(layout.moments)},
        {
            name: Pinhole.from_opencv(lenses[name].width, lenses[name].height, *_opencv(numbers[2][k]))
            for k, name in enumerate(layout.cameras)
        },
        np.sqrt(squares),
        dict(zip(layout.cameras, np.concatenate([np.zeros((1, 6)), std]))),
    )


def _minimize(layout: _Layout, start: Array) -> Array:
    """Levenberg's and Marquardt's descent of Huber's loss, by normal equations.

    These have a few hundred unknowns, however many corners were seen. scipy's solver for sparse problems does not come
    to an end here, and the one for dense ones takes seconds.
    """
    values, damping = start, FIRST_DAMPING
    residuals = layout.residuals(values)
    for _ in range(MOST_STEPS):
        jacobian = layout.jacobian(values)
        weights = np.minimum(1.0, ROBUST_PX / np.maximum(np.abs(residuals), 1e-12))
        normal = (jacobian.T @ jacobian.multiply(weights[:, None])).toarray()
        gradient = jacobian.T @ (weights * residuals)
        before = _huber(residuals)
        while damping < LAST_DAMPING:
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
            tried = layout.residuals(values + step)
            if (loss := _huber(tried)) < before:
                break
            damping *= 10
        else:
            break
        values, residuals, damping = values + step, tried, damping / 10
        if before - loss < SMALLEST_GAIN * before:
            break
    return values


def _huber(residuals: Array) -> float:
    size = np.abs(residuals)
    return float(np.where(size < ROBUST_PX, size**2, ROBUST_PX * (2 * size - ROBUST_PX)).sum())


class _Layout:
    """Where each unknown stands: cameras but the first (6 each), moments (6 each), lenses (8 each, if refined)."""

    def __init__(
        self,
        sightings: Sequence[Sighting],
        cameras: list[str],
        moments: list[str],
        lenses: Mapping[str, Pinhole],
        refine_lenses: bool,
    ) -> None:
        self.cameras, self.moments = cameras, moments
        self._lenses = np.array([_lens_numbers(lenses[name]) for name in cameras])
        self._refine = refine_lenses
        self._seen = [(cameras.index(s.camera), moments.index(s.moment), s.corners) for s in sightings]
        self._boards_at = 6 * (len(cameras) - 1)
        self._lenses_at = self._boards_at + 6 * len(moments)
        self.size = self._lenses_at + (_LENS * len(cameras) if refine_lenses else 0)

    def unpacked(self, values: Array) -> tuple[Array, Array, Array]:
        """Poses of cameras (C, 6) and boards (M, 6), and lenses (C, 8)."""
        first = np.zeros((1, 6))
        cameras = np.concatenate([first, values[: self._boards_at].reshape(-1, 6)])
        boards = values[self._boards_at : self._lenses_at].reshape(-1, 6)
        lenses = values[self._lenses_at :].reshape(-1, _LENS) if self._refine else self._lenses
        return cameras, boards, lenses

    def residuals(self, values: Array) -> Array:
        """Projected minus seen, pixels: x and y of each corner in turn."""
        cameras, boards, lenses = self.unpacked(values)
        parts = []
        for camera, moment, corners in self._seen:
            turn, shift = cv2.composeRT(
                boards[moment, :3], boards[moment, 3:], cameras[camera, :3], cameras[camera, 3:]
            )[:2]
            pixels, _ = cv2.projectPoints(corners.points, turn, shift, *_opencv(lenses[camera]))
            parts.append((pixels.reshape(-1, 2) - (corners.pixels - 0.5)).ravel())
        return np.concatenate(parts)

    def jacobian(self, values: Array) -> csr_matrix:
        """Derivatives of ``residuals`` by the unknowns."""
        cameras, boards, lenses = self.unpacked(values)
        rows, columns, entries = [], [], []
        row = 0
        for camera, moment, corners in self._seen:
            turn, shift, *by = cv2.composeRT(
                boards[moment, :3], boards[moment, 3:], cameras[camera, :3], cameras[camera, 3:]
            )
            # (6, 12): the composed pose by the board's and the camera's.
            composed = np.block([[by[0], by[1], by[2], by[3]], [by[4], by[5], by[6], by[7]]])
            _, by_view = cv2.projectPoints(corners.points, turn, shift, *_opencv(lenses[camera]))
            by_poses = by_view[:, :6] @ composed
            blocks = [(self._boards_at + 6 * moment, by_poses[:, :6])]
            if camera:
                blocks.append((6 * (camera - 1), by_poses[:, 6:]))
            if self._refine:
                blocks.append((self._lenses_at + _LENS * camera, by_view[:, 6 : 6 + _LENS]))
            for at, block in blocks:
                height, width = block.shape
                rows.append(np.repeat(np.arange(row, row + height), width))
                columns.append(np.tile(np.arange(at, at + width), height))
                entries.append(block.ravel())
            row += len(by_view)
        where = np.concatenate(rows), np.concatenate(columns)
        return coo_matrix((np.concatenate(entries), where), shape=(row, self.size)).tocsr()


def _six(pose: Array) -> Array:
    """Rotation vector and translation."""
    return np.concatenate([so3_log(pose[:3, :3]), pose[:3, 3]])


def _matrix(six: Array) -> Array:
    return se3(cv2.Rodrigues(six[:3])[0], six[3:])


def _lens_numbers(lens: Pinhole) -> Array:
    matrix, distortion = lens.opencv()
    return np.concatenate([[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], distortion])


def _opencv(numbers: Array) -> tuple[Array, Array]:
    fx, fy, cx, cy = numbers[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), numbers[4:]
