"""A tour for a camera on an arm: viewpoints around a target, and postures that take the camera to them.

Viewpoints that the arm does not reach, reaches only next to a singularity, or cannot get to from the one
before without coming near itself, or with the middle of a joint below the floor, are left out. For the floor,
links, camera and cable have a thickness that ``floor_m`` must allow for. This knows the arm (with a camera of
usual size on its flange), one floor and no other obstacle: on a real bench, watch the first round with a hand
on the stop.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.config import PathConfig
from camera_node.pose.kinematics import ArmModel
from camera_node.teleop.capsules import Shape, links
from freshfield.geometry import look_at, se3_inverse

Array = NDArray[np.float64]

_LOOKS = 12  # postures that are looked at between two viewpoints
_TOOL_M, _TOOL_RADIUS_M = 0.08, 0.04  # as in TeleopConfig: the camera and what holds it
_MARGIN_M = 0.01  # between parts of the arm, whose capsules are rounded up
FARTHEST_RAD = 2.0  # that a joint turns between two: beyond, the arm would be flung into another posture


class PathError(ValueError):
    """A tour that the arm cannot make; the message says what to change."""


def viewpoints(path: PathConfig) -> list[Array]:
    """Camera-to-world (4, 4) of every viewpoint: from the highest ring down, beside that up again, and so on.
    An arm comes farther so than ring by ring: it need not pass behind the target at a stretch."""
    target = np.array(path.target_m)
    poses = []
    for elevation_deg, a in _places(path):
        e = math.radians(elevation_deg)
        away = np.array([math.cos(e) * math.sin(a), -math.cos(e) * math.cos(a), math.sin(e)])
        poses.append(look_at(target + path.radius_m * away, target))
    return poses


def _places(path: PathConfig) -> list[tuple[float, float]]:
    """Elevation (degrees) and azimuth (radians) of every viewpoint."""
    first, last = path.azimuths_deg
    count = max(2, round(abs(last - first) / path.step_deg) + 1)
    down = sorted(path.elevations_deg, reverse=True)
    azimuths = np.deg2rad(np.linspace(first, last, count))
    return [(e, float(a)) for k, a in enumerate(azimuths) for e in (down if k % 2 == 0 else down[::-1])]


def tour(
    arm: ArmModel, base: Array, hand_eye: Array, path: PathConfig, start: ArrayLike | None = None
) -> list[Array]:
    """Joint angles (6,) of the viewpoints that the arm can visit, in the order of ``viewpoints``.

    base: world-from-base, hand_eye: flange-from-camera, both (4, 4). start: where the arm stands; the tour
    begins with the posture nearest to it. Raises PathError if it can visit fewer than three.
    """
    camera_to_flange, base_inverse = se3_inverse(hand_eye), se3_inverse(base)
    goals = [base_inverse @ pose @ camera_to_flange for pose in viewpoints(path)]
    begin = None if start is None else np.asarray(start, dtype=np.float64)
    # The posture that a tour begins with decides how much of it can be had without a jump.
    first = (p.joints for goal in goals for p in arm.inverse(goal, begin) if not p.singular)
    tours = [_follow(arm, base, goals, begin, q, path.floor_m) for q in itertools.islice(first, 8)]
    best = max(tours, key=len, default=[])
    if len(best) < 3:
        raise PathError(
            f"the arm reaches {len(best)} of {len(goals)} viewpoints: change radius_m, elevations_deg, "
            "azimuths_deg, where the base stands, or the arm's posture before"
        )
    return best


def reached_by_ring(
    stops: Sequence[Array], arm: ArmModel, base: Array, hand_eye: Array, path: PathConfig
) -> list[int]:
    """How many of each ring's viewpoints the postures ``stops`` (N, 6) of a tour take the camera to, in the
    order of ``path.elevations_deg``."""
    elevations_deg = [elevation_deg for elevation_deg, _ in _places(path)]
    places = np.array([pose[:3, 3] for pose in viewpoints(path)])
    out = [0] * len(path.elevations_deg)
    for joints in stops:
        at = (base @ arm.forward(joints) @ hand_eye)[:3, 3]
        nearest = int(np.argmin(np.linalg.norm(places - at, axis=1)))
        out[path.elevations_deg.index(elevations_deg[nearest])] += 1
    return out


def _follow(
    arm: ArmModel, base: Array, goals: Sequence[Array], begin: Array | None, first: Array, floor_m: float
) -> list[Array]:
    """The tour whose first posture is the one nearest to ``first``."""
    at = first
    visited: list[Array] = []
    for goal in goals:
        for posture in arm.inverse(goal, at):
            come_from = at if visited else posture.joints if begin is None else begin
            far = bool(visited) and np.abs(posture.joints - come_from).max() > FARTHEST_RAD
            if not posture.singular and not far and _clear(arm, base, come_from, posture.joints, floor_m):
                at = posture.joints
                visited.append(at)
                break
    return visited


def _clear(arm: ArmModel, base: Array, a: Array, b: Array, floor_m: float) -> bool:
    """Whether on the way from ``a`` to ``b`` no part of the arm comes near another, and the middle of no
    joint beyond the shoulder below the floor."""
    frames = links(arm.body, a + np.linspace(0.0, 1.0, _LOOKS)[:, None] * (b - a))
    if (base @ frames)[:, 2:, 2, 3].min() < floor_m:
        return False
    apart, _ = Shape(arm, _TOOL_M, _TOOL_RADIUS_M).clearance(frames)
    return bool(apart.min() >= _MARGIN_M)
