"""Detects whether a fixed camera was bumped: its image is its plate, rotated.

A camera that somebody bumps turns by some degrees and shifts little, so its whole image moves as under a rotation.
That rotation is found by aligning a frame to the camera's plate: inverse compositional Gauss-Newton (Baker and
Matthews, "Lucas-Kanade 20 Years On", 2004) over the three rotation parameters, with Cauchy weights, coarse to fine. A
person in front of the camera moves only a part of the image, which no rotation explains.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat.layers import layer_constants as tuned
from freshfield.geometry import Pinhole, so3_exp, so3_log

Array = NDArray[np.float64]


def find_turn(
    plate: NDArray[np.float32], known: NDArray[np.bool_], image: NDArray[np.uint8], lens: Pinhole
) -> Array | None:
    """The rotation (3, 3) from the camera's current axes to its axes when the plate was taken: a direction d now was
    ``turn @ d`` then. None if no rotation of more than BUMP_LEAST_DEG explains the frame.

    plate: (H, W, 3), in steps of 255, at the frame's exposure. known: (H, W), where there is a plate.
    image: (H, W, 3), the frame.
    """
    turn, unchanged, aligned = np.eye(3), 1.0, 1.0
    for side_px in tuned.BUMP_SIDES_PX:
        scale = min(side_px / max(lens.width, lens.height), 1.0)
        small = lens.scaled(scale)
        gray = [_gray(picture, small) for picture in (plate, image)]
        there = cv2.resize(known.astype(np.float32), (small.width, small.height), interpolation=cv2.INTER_AREA)
        turn, unchanged, aligned = _align(gray[0], there > 0.5, gray[1], small, turn)
        if not tuned.BUMP_LEAST_DEG < degrees_of(turn) < tuned.BUMP_MOST_DEG:
            return None
    explains = unchanged - aligned > tuned.BUMP_GAINS and aligned < tuned.BUMP_LEAVES * unchanged
    return turn if explains else None


def degrees_of(turn: Array) -> float:
    """The angle of a rotation (3, 3)."""
    return float(np.rad2deg(np.linalg.norm(so3_log(turn))))


def _gray(picture: NDArray, lens: Pinhole) -> NDArray[np.float32]:
    small = cv2.resize(picture.astype(np.float32), (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small.mean(axis=2), (0, 0), tuned.BUMP_BLUR_PX), np.float32)


def _align(
    plate: NDArray[np.float32], known: NDArray[np.bool_], frame: NDArray[np.float32], lens: Pinhole, turn: Array
) -> tuple[Array, float, float]:
    """The rotation, and the shares of the pixels that differ: without it, and with it."""
    rays = lens.rays().reshape(-1, 3)
    pixels = lens.project(rays)
    slopes = np.stack([cv2.Sobel(frame, cv2.CV_32F, x, 1 - x, scale=0.125).ravel() for x in (1, 0)], axis=1)
    step = 1e-4
    flows = [(lens.project(rays + step * np.cross(axis, rays)) - pixels) / step for axis in np.eye(3)]
    by_turn = np.stack([(slopes * flow).sum(axis=1) for flow in flows], axis=1)
    values = frame.ravel()

    def differences(turn: Array) -> tuple[Array, NDArray[np.bool_]]:
        at = lens.project(rays @ turn.T)
        column, row = (np.nan_to_num(at[:, k].reshape(frame.shape) - 0.5, nan=-1.0).astype(np.float32) for k in (0, 1))
        inside = (column >= 0) & (row >= 0) & (column <= lens.width - 1) & (row <= lens.height - 1)
        there = cv2.remap(known.astype(np.uint8), column, row, cv2.INTER_NEAREST) > 0
        use = (inside & there).ravel()
        return np.where(use, cv2.remap(plate, column, row, cv2.INTER_LINEAR).ravel() - values, 0.0), use

    for _ in range(tuned.BUMP_ROUNDS):
        error, use = differences(turn)
        weight = use / (1.0 + (error / tuned.BUMP_NEAR) ** 2)
        h = by_turn.T @ (by_turn * weight[:, None]) + 1e-3 * np.eye(3)
        change = np.linalg.solve(h, by_turn.T @ (weight * error))
        turn = turn @ so3_exp(change).T
        if np.linalg.norm(change) < 1e-4:
            break
    return turn, _share_off(*differences(np.eye(3))), _share_off(*differences(turn))


def _share_off(error: Array, use: NDArray[np.bool_]) -> float:
    return float((np.abs(error[use]) > tuned.BUMP_NEAR).mean()) if use.any() else 1.0
