"""Where a visitor starts, which way is up, and the pinhole camera of a browser window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from freshfield.geometry import Pinhole, look_at, quaternion_to_matrix

Array = NDArray[np.float64]

VERTICAL_FOV_RAD = float(np.deg2rad(60.0))
# The visitor stands this much higher above the horizon than the rig, within bounds.
ABOVE_RIG_DEG = 10.0
ELEVATION_DEG = (18.0, 55.0)
# As far away as it takes to see so many of the cameras in a square window, in radii of the rig; no farther,
# because a field knows little of the space behind the cameras, and hides the scene behind what it imagines.
SEEN_SHARE = 0.75
MARGIN = 0.95
DISTANCES = np.linspace(1.3, 2.2, 37)
# Below this the mean of unit vectors says nothing: the rig surrounds the scene, or its cameras roll freely.
_SCATTERED = 0.25
# Smallest eigenvalue of the mean of I - d d^T at which axes are called parallel (about 3 degrees apart).
_PARALLEL = 1e-3
# The same for the x axes of cameras that face nearly one way (about 10 degrees either side).
_FAN = 0.03


@dataclass(frozen=True)
class Viewpoint:
    """Where to stand, where to look and what is up: (3,) each, world metres. radius_m: typical distance
    of the cameras from what they look at, the unit in which the scene is drawn."""

    position: Array
    look_at: Array
    up: Array
    radius_m: float


def world_up(poses: Array) -> Array:
    """Unit vector (3,). poses: camera-to-world (N, 4, 4), N >= 1.

    Cameras are held level: up is what their x axes are all at right angles to. Where those are one line (a
    single camera, a row of them), it is the mean of their -y axes, which leans with a rig that looks down.
    """
    ups, sides = -poses[:, :3, 1], poses[:, :3, 0]
    mean = ups.mean(axis=0)
    if np.linalg.norm(mean) < _SCATTERED:
        mean = ups[0]
    spread, directions = np.linalg.eigh(sides.T @ sides / len(sides))
    level = directions[:, 0] * (1.0 if directions[:, 0] @ mean >= 0 else -1.0)
    # Level cameras that face different ways: sides fill a plane and nearly nothing is across it.
    if spread[1] > _FAN and spread[0] < 0.1 * spread[1] and level @ mean > _SCATTERED:
        return level
    return mean / np.linalg.norm(mean)


def convergence(poses: Array) -> Array | None:
    """Point (3,) nearest to all optical axes in the least-squares sense, None if they do not meet in
    front of most cameras (parallel, diverging, or a single one)."""
    eyes, axes = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    mean = across.mean(axis=0)
    if len(poses) < 2 or np.linalg.eigvalsh(mean)[0] < _PARALLEL:
        return None
    point = np.linalg.solve(mean, np.einsum("nij,nj->i", across, eyes) / len(poses))
    ahead = np.einsum("ni,ni->n", point - eyes, axes)
    return point if np.median(ahead) > 0 else None


def initial_viewpoint(poses: ArrayLike, bounds: ArrayLike | None = None) -> Viewpoint:
    """Behind and above the rig, looking at what its cameras look at.

    poses: camera-to-world (N, 4, 4), N >= 1. bounds: the field's box (2, 3), used where the optical axes
    do not meet. Everything returned is finite.
    """
    poses = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
    eyes, axes = poses[:, :3, 3], poses[:, :3, 2]
    up = world_up(poses)
    center = convergence(poses)
    box = None if bounds is None else np.asarray(bounds, dtype=np.float64)
    if center is None and box is not None and np.all(np.isfinite(box)):
        center = box.mean(axis=0)
    if center is None:
        spread = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).mean())
        ahead = axes.mean(axis=0) if np.linalg.norm(axes.mean(axis=0)) > _SCATTERED else axes[0]
        center = eyes.mean(axis=0) + ahead / np.linalg.norm(ahead) * max(3.0 * spread, 1.0)
    radius = float(np.median(np.linalg.norm(eyes - center, axis=1)))
    radius = max(radius, 1e-2)
    direction = _outward(eyes - center, up, radius)
    tangent = MARGIN * np.tan(0.5 * VERTICAL_FOV_RAD)
    for distance in DISTANCES * radius:
        position = center + direction * distance
        if _share_seen(eyes, position, center, up, tangent) >= SEEN_SHARE:
            break
    return Viewpoint(position, center, up, radius)


def _outward(offsets: Array, up: Array, radius: float) -> Array:
    """Unit vector from the center to the visitor: above the middle of the rig. offsets: (N, 3) metres."""
    flat = offsets - (offsets @ up)[:, None] * up
    behind = flat.mean(axis=0)
    if np.linalg.norm(behind) < _SCATTERED * radius:  # a ring of cameras: stand behind the first
        behind = flat[0]
    if np.linalg.norm(behind) < 1e-6 * radius:  # it looks straight down: any side will do
        least = np.zeros(3)
        least[np.argmin(np.abs(up))] = 1.0
        behind = np.cross(up, least)
    behind = behind / np.linalg.norm(behind)
    heights = offsets @ up / np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)
    elevation = np.rad2deg(np.arcsin(np.clip(np.mean(heights), -1, 1))) + ABOVE_RIG_DEG
    elevation = np.deg2rad(np.clip(elevation, *ELEVATION_DEG))
    return behind * np.cos(elevation) + up * np.sin(elevation)


def _share_seen(eyes: Array, position: Array, center: Array, up: Array, tangent: float) -> float:
    """Share of ``eyes`` within a square view whose half angle has this tangent."""
    local = (eyes - position) @ look_at(position, center, up)[:3, :3]
    inside = (local[:, 2] > 0) & (np.abs(local[:, :2]) < tangent * local[:, 2:]).all(axis=1)
    return float(inside.mean())


def visitor_camera(
    position: ArrayLike, wxyz: ArrayLike, fov_rad: float, width: int, height: int, rows: int
) -> tuple[Array, Pinhole]:
    """Camera-to-world (4, 4) and intrinsics of a browser's view at ``rows`` image rows.

    width, height: canvas pixels; fov_rad: vertical. The image keeps the canvas's aspect, whatever rounding
    does to its width.
    """
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(wxyz)
    pose[:3, 3] = np.asarray(position, dtype=np.float64)
    rows = max(1, min(rows, height))
    columns = max(1, round(rows * width / max(1, height)))
    f = 0.5 * rows / np.tan(0.5 * fov_rad)
    # fx differs from fy by that rounding: pixels are stretched over the canvas by the browser.
    fx = f * columns / (rows * width / max(1, height))
    return pose, Pinhole(columns, rows, float(fx), float(f), columns / 2.0, rows / 2.0)


def band(camera: Pinhole, first_row: int, rows: int) -> Pinhole:
    """The part of ``camera`` with image rows first_row .. first_row + rows - 1."""
    return Pinhole(camera.width, rows, camera.fx, camera.fy, camera.cx, camera.cy - first_row)
