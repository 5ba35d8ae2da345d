"""The starting viewpoint, the world's up direction, and the pinhole camera of a browser window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_server.page import page_constants as tuned
from freshfield.geometry import Pinhole, converging_point, quaternion_to_matrix, world_up

Array = NDArray[np.float64]

VERTICAL_FOV_RAD = float(np.deg2rad(tuned.VERTICAL_FOV_DEG))


@dataclass(frozen=True)
class Viewpoint:
    """position, look_at, up: (3,) each, world meters. radius_m: median distance of the cameras from the point
    they look at, the unit of size in the scene."""

    position: Array
    look_at: Array
    up: Array
    radius_m: float


def initial_viewpoint(poses: ArrayLike, center: ArrayLike | None = None) -> Viewpoint:
    """A viewpoint behind and above the cameras, looking at the same point.

    poses: camera-to-world (N, 4, 4), N >= 1. center: the middle (3,) of the field's box, used if the optical
    axes do not meet. All values returned are finite.
    """
    poses = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    eyes, axes = poses[:, :3, 3], poses[:, :3, 2]
    up = world_up(poses)
    meeting = converging_point(eyes, axes)
    center = center if meeting is None else meeting
    if center is None:
        spread = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).mean())
        ahead = axes.mean(axis=0) if np.linalg.norm(axes.mean(axis=0)) > tuned.SCATTERED else axes[0]
        center = eyes.mean(axis=0) + ahead / np.linalg.norm(ahead) * max(
            tuned.AHEAD_OF_SPREAD * spread, tuned.LEAST_AHEAD_M
        )
    center = np.asarray(center, dtype=np.float64)
    radius = float(np.median(np.linalg.norm(eyes - center, axis=1)))
    radius = max(radius, 1e-2)
    direction = _outward(eyes - center, up, radius)
    return Viewpoint(center + direction * tuned.DISTANCE * radius, center, up, radius)


def _outward(offsets: Array, up: Array, radius: float) -> Array:
    """Unit vector from the center to the visitor, above the mean camera. offsets: (N, 3) meters."""
    flat = offsets - (offsets @ up)[:, None] * up
    behind = flat.mean(axis=0)
    if np.linalg.norm(behind) < tuned.SCATTERED * radius:  # a ring of cameras: behind the first
        behind = flat[0]
    if np.linalg.norm(behind) < 1e-6 * radius:  # it looks straight down: any side
        least = np.zeros(3)
        least[np.argmin(np.abs(up))] = 1.0
        behind = np.cross(up, least)
    behind = behind / np.linalg.norm(behind)
    heights = offsets @ up / np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
    elevation = np.rad2deg(np.arcsin(np.clip(np.mean(heights), -1, 1))) + tuned.ABOVE_CAMERAS_DEG
    elevation = np.deg2rad(np.clip(elevation, *tuned.ELEVATION_DEG))
    return behind * np.cos(elevation) + up * np.sin(elevation)


def visitor_camera(
    position: ArrayLike, wxyz: ArrayLike, fov_rad: float, width: int, height: int, rows: int
) -> tuple[Array, Pinhole]:
    """Camera-to-world (4, 4) and intrinsics of a browser's view with ``rows`` image rows.

    position: (3,) meters. wxyz: rotation quaternion. fov_rad: vertical. width, height: canvas pixels. The
    image has exactly the canvas's field of view although its width is rounded.
    """
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(wxyz)
    pose[:3, 3] = np.asarray(position, dtype=np.float64)
    rows = max(1, min(rows, height))
    columns = max(1, round(rows * width / max(1, height)))
    f = 0.5 * rows / np.tan(0.5 * fov_rad)
    # fx differs from fy by the rounding: the browser stretches pixels over the canvas.
    fx = f * columns / (rows * width / max(1, height))
    return pose, Pinhole(columns, rows, float(fx), float(f), columns / 2.0, rows / 2.0)


def row_band(camera: Pinhole, first_row: int, rows: int) -> Pinhole:
    """The camera of ``rows`` image rows of ``camera``, from ``first_row`` on."""
    return Pinhole(camera.width, rows, camera.fx, camera.fy, camera.cx, camera.cy - first_row)
