"""A tour for a camera on an arm: viewpoints around a target, and postures that take the camera to them.

Viewpoints that the arm does not reach, reaches only next to a singularity, or cannot get to from any other
without coming near itself, or with the middle of a joint below the floor, are left out. For the floor, links,
camera and cable have a thickness that ``floor_m`` must allow for. This knows the arm (with a camera of usual
size on its flange), one floor and no other obstacle: on a real bench, watch the first round with a hand on
the stop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.config import PathConfig
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.roadmap import Roadmap, is_free
from freshfield.geometry import look_at, se3_inverse

Array = NDArray[np.float64]


class PathError(ValueError):
    """A tour that the arm cannot make; the message says what to change."""


def viewpoints(path: PathConfig) -> list[Array]:
    """Camera-to-world (4, 4) of every viewpoint: from the highest ring down, beside that up again, and so
    on."""
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


def _roll(angle_deg: float) -> Array:
    """(4, 4): a turn about the camera's own line of sight."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return turn


@dataclass(frozen=True)
class Tour:
    """stops: joint angles (6,) in the order in which the arm takes them; from every one the camera looks at
    the target, from some twice. places: for each, the number of its viewpoint in ``viewpoints``."""

    stops: list[Array]
    places: list[int]

    @property
    def reached(self) -> int:
        """How many viewpoints the camera comes to."""
        return len(set(self.places))

    def reached_by_ring(self, path: PathConfig) -> list[int]:
        """The same of each ring, in the order of ``path.elevations_deg``."""
        of = [elevation_deg for elevation_deg, _ in _places(path)]
        rings = [of[place] for place in set(self.places)]
        return [rings.count(elevation_deg) for elevation_deg in path.elevations_deg]


def plan_tour(
    arm: ArmModel, base: Array, hand_eye: Array, path: PathConfig, start: ArrayLike | None = None
) -> Tour:
    """Through the viewpoints that the arm can visit: of those that are left always to the nearest, if need be
    by way of others, where it has been before.

    base: world-from-base, hand_eye: flange-from-camera, both (4, 4). start: where the arm stands; the tour
    begins near there, with a viewpoint to which the way is free. Raises PathError if it can visit fewer than
    three.
    """
    camera_to_flange, base_inverse = se3_inverse(hand_eye), se3_inverse(base)
    goals = [
        [base_inverse @ pose @ _roll(turn) @ camera_to_flange for turn in path.rolls_deg]
        for pose in viewpoints(path)
    ]
    begin = None if start is None else np.asarray(start, dtype=np.float64)
    sound = [
        (p.joints, k)
        for k, turned in enumerate(goals)
        for goal in turned
        for p in arm.inverse(goal, begin)
        if not p.singular
    ]
    if begin is not None:
        sound.sort(key=lambda each: float(np.abs(each[0] - begin).max()))
    roadmap = Roadmap(arm, base, [joints for joints, _ in sound], [k for _, k in sound], path.floor_m)
    best = Tour([], [])
    for joints, k in sound:
        # The posture that a tour begins with decides how much of it can be had: as much as from any other
        # that an earlier search has come to from there.
        if best.reached == roadmap.reachable:
            break
        if roadmap.has_visited(joints):
            continue
        if is_free(arm, base, joints if begin is None else begin, joints, path.floor_m).all():
            best = max(best, _extend_tour(roadmap, len(goals), joints, k), key=lambda each: each.reached)
    if best.reached < 3:
        raise PathError(
            f"the arm reaches {best.reached} of {len(goals)} viewpoints: change radius_m, elevations_deg, "
            "azimuths_deg, where the base stands, or the arm's posture before"
        )
    return best


def _extend_tour(roadmap: Roadmap, count: int, first: Array, place: int) -> Tour:
    """The tour of ``count`` viewpoints that begins with the posture ``first`` at ``place``."""
    stops, places = [first], [place]
    left = set(range(count)) - {place}
    while left and (way := roadmap.shortest_path(stops[-1], left)) is not None:
        for joints, where in way:
            stops.append(joints)
            places.append(where)
            left.discard(where)
    return Tour(stops, places)
