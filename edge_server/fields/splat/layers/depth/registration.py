"""Poses of cameras and scales of their depth, corrected until their depth plates lie on one another.

Gauss-Newton over seven numbers a camera: turn, shift, and log of the scale. Points of one camera, placed before another
one, differ from its surface along the normal, and from its plate in brightness. What calibration says is the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.surfaces import Surface
from freshfield.geometry import seen_from, so3_exp, so3_log

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Correction:
    """What a camera's calibration should have been.

    pose: camera-to-world (4, 4). scale: factor on its depth.
    turn_deg, shift_m: how far the pose is from the one that was reported.
    """

    pose: Array
    scale: float
    turn_deg: float
    shift_m: float

    @property
    def is_large(self) -> bool:
        """Whether the camera was bumped, or its depth is of another scale: calibration and sensors err less."""
        off = self.turn_deg / tuned.LARGE_TURN_DEG, self.shift_m / tuned.LARGE_SHIFT_M
        return bool(max(*off, abs(np.log(self.scale)) / tuned.LARGE_LOG_SCALE) > 1.0)

    def __str__(self) -> str:
        stands = f"stands {self.turn_deg:.1f} degrees and {100 * self.shift_m:.1f} cm from where its frames say"
        measures = f"; its depth is {self.scale:.3f} times what the others measure"
        return stands if self.scale == 1.0 else stands + measures

    def applied(self, surface: Surface) -> Surface:
        """The surface of the camera at its pose and scale."""
        by = np.float32(1.0 / self.scale)
        return replace(surface, pose=self.pose, inverse=surface.inverse * by, slope=surface.slope * by)


class _Camera(NamedTuple):
    """A surface as it is compared: in its camera's axes, at its reported scale.

    surface: as given. points, normals: (H, W, 3). depth: (H, W).
    rows, columns: (N,), of the pixels that are placed before other cameras.
    gray, right, down: (H, W), brightness in [0, 1], and its slopes a pixel.
    """

    surface: Surface
    points: Array
    normals: Array
    depth: NDArray[np.float32]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    gray: NDArray[np.float32]
    right: NDArray[np.float32]
    down: NDArray[np.float32]

    @classmethod
    def of(cls, surface: Surface) -> _Camera:
        depth = surface.depth()
        stride = max(1, round(np.sqrt(depth.size / tuned.REGISTERED_POINTS)))
        rows, columns = (stride * k for k in np.nonzero(depth[::stride, ::stride]))
        gray = cv2.cvtColor(np.clip(surface.color / np.float32(255.0), 0, 1).astype(np.float32), cv2.COLOR_RGB2GRAY)
        gray = cv2.GaussianBlur(gray, (0, 0), tuned.GRAY_BLUR_PX)
        right, down = (cv2.Sobel(gray, cv2.CV_32F, x, 1 - x, scale=0.125) for x in (1, 0))
        points, normals = surface.rays() * depth[..., None], surface.normals() @ surface.pose[:3, :3]
        images = (np.asarray(image, np.float32) for image in (gray, right, down))
        return cls(surface, points, normals, depth, rows, columns, *images)


class _Pair(NamedTuple):
    """Residuals (N,) of points of one camera before another one, their weights, and their slopes by both cameras' seven
    numbers, (N, 7)."""

    error: Array
    weight: Array
    by_first: Array
    by_second: Array


def register_stereo(surfaces: Sequence[Surface], reported: Sequence[Array], distance_m: float) -> list[Correction]:
    """Corrections of cameras whose depth stereo has found. It found what fits the poses, so that distances between
    surfaces say nothing of them: brightness alone tells how far plates lie beside one another, and scales stay.

    surfaces: at the poses with which to begin. reported: poses that calibration says, camera-to-world (4, 4).
    distance_m: of the cameras to the scene, in whose unit nothing was measured: the errors of a calibration are taken
        to grow with it.
    """
    by = tuned.REGISTERED_M / distance_m
    alike = [
        replace(s, pose=_scaled(s.pose, by), inverse=s.inverse / np.float32(by), slope=s.slope / np.float32(by))
        for s in surfaces
    ]
    found = register(alike, [_scaled(pose, by) for pose in reported], by_stereo=True)
    return [replace(c, pose=_scaled(c.pose, 1.0 / by), shift_m=c.shift_m / by) for c in found]


def _scaled(pose: Array, by: float) -> Array:
    return np.concatenate([np.concatenate([pose[:3, :3], by * pose[:3, 3:]], axis=1), pose[3:]])


def register(
    surfaces: Sequence[Surface], reported: Sequence[Array] | None = None, by_stereo: bool = False
) -> list[Correction]:
    """Corrections of cameras from their surfaces. The surfaces' poses are kept where others do not fit better.

    surfaces: at the poses with which to begin, and at the reported scales.
    reported: poses that calibration says, camera-to-world (4, 4); None: those of the surfaces.
    by_stereo: see ``register_stereo``.
    """
    cameras, count = [_Camera.of(s) for s in surfaces], len(surfaces)
    poses, scales = [s.pose.copy() for s in surfaces], np.ones(count)
    reported = [s.pose for s in surfaces] if reported is None else reported
    deviation = np.tile([np.deg2rad(tuned.TURN_DEG)] * 3 + [tuned.SHIFT_M] * 3 + [tuned.LOG_SCALE], count)
    total = np.concatenate([_numbers(told, pose) for told, pose in zip(reported, poses, strict=True)])
    before = _cost(cameras, poses, scales, by_stereo)
    for k in range(tuned.REGISTRATION_ROUNDS):
        # Most cameras are as calibrated, but one that was bumped is far off: its prior is a Cauchy distribution's.
        prior = 1.0 / (deviation**2 * (1.0 + (total / (tuned.PRIOR_DEVIATIONS * deviation)) ** 2))
        h, g = np.diag(prior), -total * prior
        near_m = tuned.NEAR_M * (tuned.NEAR_AT_FIRST if 2 * k < tuned.REGISTRATION_ROUNDS else 1.0)
        for i, j in _pairs(count):
            for found in _compare(cameras, poses, scales, i, j, near_m, by_stereo):
                _add(h, g, i, j, found)
        step = np.linalg.solve(h, g)
        total += step
        for i in range(count):
            turn, shift, grow = np.split(step[7 * i : 7 * i + 7], [3, 6])
            poses[i][:3, :3] = so3_exp(turn) @ poses[i][:3, :3]
            poses[i][:3, 3] += shift
            scales[i] *= np.exp(np.clip(grow[0], -tuned.LARGEST_LOG_SCALE, tuned.LARGEST_LOG_SCALE))
        if np.abs(step / deviation).max() < tuned.SETTLED:
            break
    if not _cost(cameras, poses, scales, by_stereo) < before - (_least_gain(surfaces) if by_stereo else 0.0):
        poses, scales = [s.pose for s in surfaces], np.ones(count)
    return [_correction(told, pose, float(scale)) for told, pose, scale in zip(reported, poses, scales)]


def _least_gain(surfaces: Sequence[Surface]) -> float:
    """Of cost, from which on poses are not exact: what lies between pixels grows with the square of their angle."""
    focal_px = float(np.median([s.lens.fx for s in surfaces]))
    return tuned.STEREO_GAIN * max(1.0, (tuned.STEREO_FOCAL_PX / focal_px) ** 2)


def _numbers(reported: Array, pose: Array) -> Array:
    """Turn, shift and log scale of a camera at a pose, (7,)."""
    return np.concatenate([so3_log(pose[:3, :3] @ reported[:3, :3].T), pose[:3, 3] - reported[:3, 3], [0.0]])


def _correction(reported: Array, pose: Array, scale: float) -> Correction:
    turn, shift, _ = np.split(_numbers(reported, pose), [3, 6])
    return Correction(pose, scale, float(np.rad2deg(np.linalg.norm(turn))), float(np.linalg.norm(shift)))


def _pairs(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(count) if i != j]


def _cost(cameras: Sequence[_Camera], poses: Sequence[Array], scales: Array, by_stereo: bool = False) -> float:
    """Mean robust cost (Geman and McClure) of distances along normals, or of differences of brightness, at most 1."""
    near_m = tuned.NEAR_M * tuned.NEAR_AT_FIRST
    near = tuned.NEAR_GRAY if by_stereo else near_m
    found = [_compare(cameras, poses, scales, i, j, near_m, by_stereo)[:1] for i, j in _pairs(len(cameras))]
    square = np.concatenate([np.zeros(1), *[(p.error / near) ** 2 for pair in found for p in pair]])
    # Points that no surface is near to count in full.
    most = sum(len(c.rows) for c in cameras) * (len(cameras) - 1)
    return 1.0 - float((1.0 / (1.0 + square)).sum()) / max(most, 1)


def _compare(
    cameras: Sequence[_Camera], poses: Sequence[Array], scales: Array, i: int, j: int, near_m: float, by_stereo: bool
) -> list[_Pair]:
    """Points of camera i before camera j: distances along normals, but not by stereo, then differences of brightness;
    empty where the two share too few. A camera turns about its own center."""
    ours, theirs = cameras[i], cameras[j]
    turn_i, turn_j, lens = poses[i][:3, :3], poses[j][:3, :3], theirs.surface.lens
    to_i = (ours.points[ours.rows, ours.columns] * scales[i]) @ turn_i.T  # from camera i
    points = to_i + poses[i][:3, 3]
    with np.errstate(invalid="ignore", over="ignore"):
        local, at, inside = seen_from(lens, poses[j], points)
    u, v = np.nan_to_num(at, nan=-1.0).T
    inside &= (local[:, 2] > tuned.NEAREST_M) & (u >= 1) & (v >= 1) & (u < lens.width - 1) & (v < lens.height - 1)
    x, y = np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int)
    normal = theirs.normals[y, x] @ turn_j.T
    to_j = (theirs.points[y, x] * scales[j]) @ turn_j.T  # from camera j to its own surface
    error = ((points - poses[j][:3, 3] - to_j) * normal).sum(axis=1)
    facing = -(normal * to_j).sum(axis=1) / np.maximum(np.linalg.norm(to_j, axis=1), 1e-9)
    alike = (normal * (ours.normals[ours.rows, ours.columns] @ turn_i.T)).sum(axis=1)
    use = inside & (theirs.depth[y, x] > 0) & (np.abs(error) < tuned.NEAR_MOST * near_m)
    use &= (alike > tuned.LEAST_ALIKE) & (facing > tuned.REGISTERED_FACING)
    if np.count_nonzero(use) < tuned.OVERLAP_LEAST:
        return []
    to_i, to_j, points, local, normal, error = (a[use] for a in (to_i, to_j, points, local, normal, error))
    noise = tuned.DEPTH_NOISE * local[:, 2] + tuned.DEPTH_NOISE_M
    weight = 1.0 / (noise**2 * (1.0 + (error / near_m) ** 2) ** 2 * tuned.ERR_ALIKE)
    distance = _Pair(error, weight, _by_numbers(to_i, normal, True), -_by_numbers(to_j, normal, True))
    map_x, map_y = (np.asarray(a[use] - 0.5, np.float32)[None] for a in (u, v))
    gray, right, down = (
        cv2.remap(a, map_x, map_y, cv2.INTER_LINEAR)[0].astype(float) for a in (theirs.gray, theirs.right, theirs.down)
    )
    error = gray - ours.gray[ours.rows, ours.columns][use]
    a, b, z = right * lens.fx, down * lens.fy, local[:, 2]
    slope = np.stack([a / z, b / z, -(a * local[:, 0] + b * local[:, 1]) / z**2], axis=1) @ turn_j.T
    robust = 1.0 + (error / tuned.NEAR_GRAY) ** 2
    weight = (1.0 if by_stereo else tuned.GRAY_WEIGHT) / (tuned.GRAY_NOISE**2 * robust**2 * tuned.ERR_ALIKE)
    away = points - poses[j][:3, 3]
    gray_pair = _Pair(error, weight, _by_numbers(to_i, slope, not by_stereo), -_by_numbers(away, slope, False))
    return [gray_pair] if by_stereo else [distance, gray_pair]


def _by_numbers(arm: Array, slope: Array, scales: bool) -> Array:
    """Slopes by turn, shift and log scale of a camera, (N, 7), of what changes by ``slope`` (N, 3) a meter of a point.

    arm: (N, 3), from the camera to the point. scales: whether the point moves with the scale.
    """
    by_scale = (arm * slope).sum(axis=1, keepdims=True) * scales
    return np.concatenate([np.cross(arm, slope), slope, by_scale], axis=1)


def _add(h: Array, g: Array, i: int, j: int, pair: _Pair) -> None:
    """Add residuals to the normal equations."""
    a, b = slice(7 * i, 7 * i + 7), slice(7 * j, 7 * j + 7)
    first, second = pair.by_first * pair.weight[:, None], pair.by_second * pair.weight[:, None]
    h[a, a] += pair.by_first.T @ first
    h[b, b] += pair.by_second.T @ second
    h[a, b] += pair.by_first.T @ second
    h[b, a] += pair.by_second.T @ first
    g[a] -= first.T @ pair.error
    g[b] -= second.T @ pair.error
