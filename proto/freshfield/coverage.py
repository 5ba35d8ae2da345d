"""How much of a scene fixed cameras can see, estimated from their poses and lenses alone.

The geometry of the scene is unknown; only the point that the cameras look at is. Surfaces are assumed near that point,
at every position and orientation, and the shares below are means over them. A camera sees a surface if it lies within
the image and its normal is less than MOST_OBLIQUE_DEG off the viewing ray. Occlusion is ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Array, Pinhole, converging_point, look_at, seen_from

PLACES = 9  # grid points per side, within the ball
DIRECTIONS = 48  # of a surface's normal
REACH = 0.5  # radius of the ball, as a share of the cameras' distance to its center
UNKNOWN_DISTANCE_M = 3.0  # least distance assumed where the optical axes do not meet: the depth of a small room
MOST_OBLIQUE_DEG = 75.0  # a camera sees a surface at a larger angle too obliquely to resolve its texture
CANDIDATES = 48  # candidate positions of a further camera, around the scene
PLAN = 41  # cells per side of the plan

# PSNR of `room` in dB by number of cameras, over the whole image and over moving pixels: with depth sensors
# (docs/results/few-cameras.json), and without (docs/fields.md).
REACHED_WITH_DEPTH = {2: (22.4, 18.6), 3: (24.7, 21.0), 4: (26.2, 22.3)}
REACHED = {2: (14.8, 15.7), 3: (19.2, 19.2), 4: (22.6, 22.1), 6: (26.0, 22.9), 8: (27.5, 24.2), 12: (28.9, 25.4)}

Camera = tuple[Pinhole, Array]
"""Lens, and camera-to-world pose (4, 4), meters."""


@dataclass(frozen=True)
class Coverage:
    """The coverage of a set of cameras.

    seen_by: shares of the surfaces that exactly 0, 1, 2, ... cameras see.
    parallax_deg: widest angle between two cameras that see a surface, median over the surfaces that several see;
        None if no two cameras see the same surface.
    further_pose: camera-to-world (4, 4), best pose of one more camera. further_seen_by: ``seen_by`` with it.
    center_m: (3,), the point the cameras look at.
    plan: int (PLAN, PLAN), number of cameras whose image contains each cell of the horizontal plane through the
        center. plan_axes: (2, 3), unit vectors toward its right and upper edge. plan_m: its side.
    """

    seen_by: tuple[float, ...]
    parallax_deg: float | None
    further_pose: Array
    further_seen_by: tuple[float, ...]
    center_m: Array
    plan: NDArray[np.int64]
    plan_axes: Array
    plan_m: float

    @property
    def words(self) -> str:
        """Two sentences for people."""
        x, y, z = self.further_pose[:3, 3]
        angle = "" if self.parallax_deg is None else f", {self.parallax_deg:.0f} degrees apart"
        return (
            f"of all surfaces around the point that the cameras look at, {_shares_in_words(self.seen_by)}{angle}. One "
            f"more camera helps most at ({x:.2f}, {y:.2f}, {z:.2f}) m: then {_shares_in_words(self.further_seen_by)}"
        )


def reached(cameras: int, depth: bool) -> str:
    """The fidelity measured with this or the next smaller number of cameras, in words. depth: they measure it."""
    reached = REACHED_WITH_DEPTH if depth else REACHED
    known = [count for count in reached if count <= cameras]
    if not known:
        return "A single camera reproduces its own view and little else"
    whole_db, moving_db = reached[known[-1]]
    sensors = "with depth sensors" if depth else "without depth sensors"
    return (
        f"The shipped room with {known[-1]} cameras {sensors} reached {whole_db:g} dB, {moving_db:g} on moving "
        "pixels; an image above some 25 dB looks right, one of a single mean color reaches some 15"
    )


def reckon(cameras: Sequence[Camera]) -> Coverage:
    """Compute the coverage of ``cameras``. Raises ValueError if there are none."""
    if not cameras:
        raise ValueError("no camera has a pose")
    poses = np.stack([pose for _, pose in cameras])
    center, distance = _scene(poses)
    up = _unit(-poses[:, :3, 1].mean(axis=0), np.array([0.0, 0.0, 1.0]))
    places, normals = _surfaces(center, REACH * distance)
    seen = np.stack([_sees(camera, places, normals) for camera in cameras])
    right, forward = _ground_axes(poses, center, up)
    side = 2.4 * max(float(np.linalg.norm(poses[:, :3, 3] - center, axis=1).max()), distance)
    return Coverage(
        _shares(seen),
        _parallax_deg(poses, seen, places),
        *_further(cameras, seen, places, normals, (center, up, right, forward)),
        center,
        _plan(cameras, center, side, right, forward),
        np.stack([right, forward]),
        side,
    )


def _shares_in_words(seen_by: tuple[float, ...]) -> str:
    none, one = 100 * seen_by[0], 100 * seen_by[1]
    return f"{none:.0f} % are seen by none, {one:.0f} % by one, {100 - none - one:.0f} % by two or more"


def _scene(poses: Array) -> tuple[Array, float]:
    origins, axes = poses[:, :3, 3], poses[:, :3, 2]
    point = converging_point(origins, axes) if len(poses) > 1 else None
    if point is None:
        spread = float(np.linalg.norm(origins - origins.mean(axis=0), axis=1).max())
        point = origins.mean(axis=0)
        if np.linalg.norm(axes.mean(axis=0)) > 0.5:  # else they look at each other, or apart
            point = point + max(UNKNOWN_DISTANCE_M, 3.0 * spread) * _unit(axes.mean(axis=0), axes[0])
    return point, max(float(np.median(np.linalg.norm(origins - point, axis=1))), 1e-6)


def _unit(vector: Array, otherwise: Array) -> Array:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-6 else otherwise


def _ground_axes(poses: Array, center: Array, up: Array) -> tuple[Array, Array]:
    """Two horizontal unit vectors: right, and forward from the cameras to the scene."""
    ahead = center - poses[:, :3, 3].mean(axis=0)
    ahead = ahead if np.linalg.norm(np.cross(ahead, up)) > 1e-6 * np.linalg.norm(ahead) else poses[0, :3, 2]
    right = _unit(np.cross(ahead, up), poses[0, :3, 0])
    return right, np.cross(up, right)


def _surfaces(center: Array, radius_m: float) -> tuple[Array, Array]:
    """Places (P, 3) of a grid within a ball, and unit normals (D, 3), even over the sphere."""
    axis = np.linspace(-1.0, 1.0, PLACES)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    grid = grid[np.linalg.norm(grid, axis=1) <= 1.0]
    k = np.arange(DIRECTIONS)
    z, turn = 1.0 - (2.0 * k + 1.0) / DIRECTIONS, k * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z * z)
    return center + radius_m * grid, np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _sees(camera: Camera, places: Array, normals: Array) -> NDArray[np.bool_]:
    """bool (P, D), whether a camera sees each surface."""
    to_camera = camera[1][:3, 3] - places
    to_camera = to_camera / np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-9)
    facing = to_camera @ normals.T > np.cos(np.deg2rad(MOST_OBLIQUE_DEG))
    return facing & seen_from(*camera, places)[2][:, None]


def _shares(seen: NDArray[np.bool_]) -> tuple[float, ...]:
    counts = np.bincount(seen.sum(axis=0).ravel(), minlength=len(seen) + 1)
    return tuple(float(n) for n in counts / counts.sum())


def _parallax_deg(poses: Array, seen: NDArray[np.bool_], places: Array) -> float | None:
    rays = places[None] - poses[:, None, :3, 3]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-9)
    widest = np.zeros(seen.shape[1:])
    for i in range(len(poses)):
        for j in range(i):
            angle = np.arccos(np.clip((rays[i] * rays[j]).sum(axis=1), -1.0, 1.0))
            widest = np.where(seen[i] & seen[j], np.maximum(widest, angle[:, None]), widest)
    several = widest[seen.sum(axis=0) >= 2]
    return float(np.rad2deg(np.median(several))) if several.size else None


def _further(
    cameras: Sequence[Camera],
    seen: NDArray[np.bool_],
    places: Array,
    normals: Array,
    frame: tuple[Array, Array, Array, Array],
) -> tuple[Array, tuple[float, ...]]:
    """The best of CANDIDATES positions around the scene, at the cameras' distance and height, with the lens of the
    first. A surface that one camera sees counts 1, one that several see 1.5."""
    center, up, right, forward = frame
    offsets = np.stack([pose[:3, 3] for _, pose in cameras]) - center
    height = float(np.median(offsets @ up))
    flat = float(np.median(np.linalg.norm(offsets - np.outer(offsets @ up, up), axis=1)))
    best, most = None, -1.0
    for turn in np.linspace(0.0, 2.0 * np.pi, CANDIDATES, endpoint=False):
        eye = center + flat * (np.sin(turn) * right - np.cos(turn) * forward) + height * up
        if np.linalg.norm(np.cross(center - eye, up)) < 1e-9:
            continue  # straight above: the cameras themselves look down
        pose = look_at(eye, center, up)
        both = np.concatenate([seen, _sees((cameras[0][0], pose), places, normals)[None]])
        shares = _shares(both)
        gain = 1.5 * (1.0 - shares[0]) - 0.5 * shares[1]
        if gain > most + 1e-9:
            best, most = (pose, shares), gain
    return best or (cameras[0][1], _shares(np.concatenate([seen, seen[:1]])))


def _plan(cameras: Sequence[Camera], center: Array, side: float, right: Array, forward: Array) -> NDArray[np.int64]:
    axis = (np.arange(PLAN) + 0.5) / PLAN - 0.5
    x, y = np.meshgrid(axis, -axis)  # the first row is the farthest
    places = center + side * (x.reshape(-1, 1) * right + y.reshape(-1, 1) * forward)
    return np.sum([seen_from(*camera, places)[2] for camera in cameras], axis=0).reshape(PLAN, PLAN)


def plan_svg(cameras: dict[str, Camera], coverage: Coverage) -> str:
    """The plan as an SVG: cells by the number of cameras that see them, the cameras, and the further one.

    cameras: by name, as they were given to ``reckon``.
    """
    scale = 100.0 / coverage.plan_m
    right, forward = coverage.plan_axes

    def at(point: Array) -> tuple[float, float]:
        offset = point - coverage.center_m
        return 50.0 + scale * float(offset @ right), 50.0 - scale * float(offset @ forward)

    def triangle(pose: Array, color: str, title: str) -> str:
        x, y = at(pose[:3, 3])
        ahead = np.array([pose[:3, 2] @ right, -(pose[:3, 2] @ forward)])
        ahead = 5.0 * _unit(ahead, np.array([0.0, -1.0]))
        aside = 0.45 * np.array([-ahead[1], ahead[0]])
        corners = [(x, y), (x + ahead[0] + aside[0], y + ahead[1] + aside[1])]
        corners.append((x + ahead[0] - aside[0], y + ahead[1] - aside[1]))
        points = " ".join(f"{u:.1f},{v:.1f}" for u, v in corners)
        return f'<polygon points="{points}" fill="{color}"><title>{title}</title></polygon>'

    most, size = max(int(coverage.plan.max()), 1), 100.0 / PLAN
    cells = [
        f'<rect x="{column * size:.1f}" y="{row * size:.1f}" width="{size:.2f}" height="{size:.2f}" '
        f'fill-opacity="{0.75 * coverage.plan[row, column] / most:.2f}"/>'
        for row, column in np.argwhere(coverage.plan)
    ]
    drawn = [triangle(pose, "#e8a33d", _escaped(name)) for name, (_, pose) in cameras.items()]
    drawn.append(triangle(coverage.further_pose, "#d24d57", "one more camera helps most here"))
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 100"><rect width="100" height="100" fill="#888" '
        f'fill-opacity="0.15"/><g fill="#2a9d8f">{"".join(cells)}</g>{"".join(drawn)}</svg>\n'
    )


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")
