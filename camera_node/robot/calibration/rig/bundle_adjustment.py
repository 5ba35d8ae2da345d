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

from camera_node.robot.calibration import calibration_constants as tuned
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
    names, moments = list(cameras), list(boards)
    lenses_at = 6 * (len(names) + len(moments))
    problem = _Problem(
        [(names.index(s.camera), moments.index(s.moment), s.corners) for s in sightings],
        len(names),
        lenses_at,
        slice(6, None if refine_lenses else lenses_at),
    )
    poses = [_six(pose) for pose in (*cameras.values(), *boards.values())]
    found = _minimize(problem, np.concatenate([*poses, *(_lens_numbers(lenses[name]) for name in names)]))
    residuals, jacobian = problem.residuals(found), problem.jacobian(found)
    freedom = max(1, len(residuals) - jacobian.shape[1])
    scale = (1.4826 * np.median(np.abs(residuals))) ** 2 * len(residuals) / freedom  # outliers do not count
    variance = np.diag(np.linalg.pinv((jacobian.T @ jacobian).toarray())) * scale
    std = np.sqrt(np.maximum(variance[: 6 * (len(names) - 1)], 0.0)).reshape(-1, 6)
    ends = np.cumsum([2 * len(s.corners.points) for s in sightings])
    squares = [float(np.mean(part**2)) * 2 for part in np.split(residuals, ends[:-1])]
    in_cameras, in_boards, in_lenses = problem.parts(found)
    sizes = [(lenses[name].width, lenses[name].height) for name in names]
    return Bundle(
        dict(zip(names, map(_matrix, in_cameras))),
        dict(zip(moments, map(_matrix, in_boards))),
        {n: Pinhole.from_opencv(*size, *_opencv(lens)) for n, size, lens in zip(names, sizes, in_lenses)},
        np.sqrt(squares),
        dict(zip(names, np.concatenate([np.zeros((1, 6)), std]))),
    )


def _minimize(problem: _Problem, start: Array) -> Array:
    """Levenberg's and Marquardt's descent of Huber's loss, by normal equations.

    These have a few hundred unknowns, however many corners were seen. scipy's solver for sparse problems does not come
    to an end here, and the one for dense ones takes a minute.
    """
    values, damping = start, tuned.FIRST_DAMPING
    residuals = problem.residuals(values)
    for _ in range(tuned.MOST_STEPS):
        jacobian = problem.jacobian(values)
        weights = np.minimum(1.0, tuned.ROBUST_PX / np.maximum(np.abs(residuals), 1e-12))
        normal = (jacobian.T @ jacobian.multiply(weights[:, None])).toarray()
        gradient = jacobian.T @ (weights * residuals)
        before = _huber(residuals)
        while damping < tuned.LAST_DAMPING:
            stepped = values.copy()
            stepped[problem.free] -= np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            tried = problem.residuals(stepped)
            if (loss := _huber(tried)) < before:
                break
            damping *= tuned.DAMPING_FACTOR
        else:
            break
        values, residuals, damping = stepped, tried, damping / tuned.DAMPING_FACTOR
        if before - loss < tuned.SMALLEST_GAIN * before:
            break
    return values


def _huber(residuals: Array) -> float:
    size = np.abs(residuals)
    return float(np.where(size < tuned.ROBUST_PX, size**2, tuned.ROBUST_PX * (2 * size - tuned.ROBUST_PX)).sum())


@dataclass(frozen=True)
class _Problem:
    """What was seen, of values in one vector: poses of cameras and boards (6 each), lenses (8 each).

    seen: number of the camera, number of the board, corners. cameras: how many. lenses_at: where the lenses begin.
    free: the values that are estimated; the first camera's pose is none.
    """

    seen: Sequence[tuple[int, int, Corners]]
    cameras: int
    lenses_at: int
    free: slice

    def parts(self, values: Array) -> tuple[Array, Array, Array]:
        """Poses of cameras (C, 6) and boards (M, 6), and lenses (C, 8)."""
        poses = values[: self.lenses_at].reshape(-1, 6)
        return poses[: self.cameras], poses[self.cameras :], values[self.lenses_at :].reshape(-1, _LENS)

    def residuals(self, values: Array) -> Array:
        """Projected minus seen, pixels: x and y of each corner in turn."""
        cameras, boards, lenses = self.parts(values)
        found = []
        for c, b, corners in self.seen:
            turn, shift = cv2.composeRT(boards[b, :3], boards[b, 3:], cameras[c, :3], cameras[c, 3:])[:2]
            pixels, _ = cv2.projectPoints(corners.points, turn, shift, *_opencv(lenses[c]))
            found.append((pixels.reshape(-1, 2) - (corners.pixels - 0.5)).ravel())
        return np.concatenate(found)

    def jacobian(self, values: Array) -> csr_matrix:
        """Derivatives of ``residuals`` by the free values."""
        cameras, boards, lenses = self.parts(values)
        rows, columns, entries = [], [], []
        row = 0
        for c, b, corners in self.seen:
            turn, shift, *by = cv2.composeRT(boards[b, :3], boards[b, 3:], cameras[c, :3], cameras[c, 3:])
            # (6, 12): the composed pose by the board's and the camera's.
            composed = np.block([[by[0], by[1], by[2], by[3]], [by[4], by[5], by[6], by[7]]])
            _, by_view = cv2.projectPoints(corners.points, turn, shift, *_opencv(lenses[c]))
            by_poses = by_view[:, :6] @ composed
            at = [6 * (self.cameras + b), 6 * c, self.lenses_at + _LENS * c]
            for first, block in zip(at, (by_poses[:, :6], by_poses[:, 6:], by_view[:, 6 : 6 + _LENS])):
                height, width = block.shape
                rows.append(np.repeat(np.arange(row, row + height), width))
                columns.append(np.tile(np.arange(first, first + width), height))
                entries.append(block.ravel())
            row += len(by_view)
        where = np.concatenate(rows), np.concatenate(columns)
        return coo_matrix((np.concatenate(entries), where), shape=(row, len(values))).tocsr()[:, self.free]


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
