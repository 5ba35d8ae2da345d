"""Plans a tour of viewpoints around a target for a camera on an arm.

A viewpoint is left out if the arm cannot reach it, reaches it only near a singularity, or has no free path to
it (see ``roadmap``). The floor check looks at joint centers only, so ``floor_m`` must include the thickness
of links, camera and cable. Other obstacles are unknown: on a real bench, watch the first round with a hand on
the stop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.config import PathConfig
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.roadmap import Roadmap, is_free
from freshfield.geometry import look_at, se3_inverse

Array = NDArray[np.float64]


class PathError(ValueError):
    """The arm cannot make the tour. The message says what to change."""


def viewpoints(path: PathConfig) -> list[Array]:
    """Camera-to-world (4, 4) of every viewpoint: down from the highest ring, up again at the next azimuth,
    and so on."""
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
    """Rotation (4, 4) about the camera's optical axis."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return turn


@dataclass(frozen=True)
class Tour:
    """A tour of an arm.

    stops: joint angles (6,) in the order of the drive. A viewpoint may be visited more than once.
    places: for each stop, the number of its viewpoint in ``viewpoints``.
    """

    stops: list[Array]
    places: list[int]

    @property
    def reached(self) -> int:
        """Number of viewpoints visited."""
        return len(set(self.places))

    def reached_by_ring(self, path: PathConfig) -> list[int]:
        """Number of viewpoints visited in each ring, in the order of ``path.elevations_deg``."""
        elevations_deg = [elevation_deg for elevation_deg, _ in _places(path)]
        visited_deg = [elevations_deg[place] for place in set(self.places)]
        return [visited_deg.count(elevation_deg) for elevation_deg in path.elevations_deg]


def plan_tour(arm: ArmModel, base: Array, hand_eye: Array, path: PathConfig, start: ArrayLike | None = None) -> Tour:
    """Plan a tour that always goes on to the nearest viewpoint left, if necessary through earlier ones.

    base: world-from-base (4, 4).
    hand_eye: flange-from-camera (4, 4).
    start: current joint angles (6,); the tour begins near them, with a viewpoint to which the path is free.
    Raises PathError if the arm can visit fewer than three viewpoints.
    """
    poses = viewpoints(path)
    begin = None if start is None else np.asarray(start, dtype=np.float64)
    postures = _postures(arm, base, hand_eye, path, poses, begin)
    if begin is not None:
        postures.sort(key=lambda each: float(np.abs(each[0] - begin).max()))
    roadmap = Roadmap(arm, base, [joints for joints, _ in postures], [k for _, k in postures], path.floor_m)
    best = Tour([], [])
    for joints, k in postures:
        # The first posture decides which viewpoints a tour can reach. Every posture that an earlier search
        # visited reaches the same ones.
        if best.reached == roadmap.reachable:
            break
        if roadmap.has_visited(joints):
            continue
        if is_free(arm, base, joints if begin is None else begin, joints, path.floor_m).all():
            best = max(best, _extend_tour(roadmap, len(poses), joints, k), key=lambda each: each.reached)
    if best.reached < 3:
        raise PathError(
            f"the arm reaches {best.reached} of {len(poses)} viewpoints: change radius_m, elevations_deg, "
            "azimuths_deg, where the base stands, or the arm's posture before"
        )
    return best


def reachable(
    arm: ArmModel, base: Array, hand_eye: Array, path: PathConfig, poses: Sequence[Array]
) -> NDArray[np.bool_]:
    """Whether the arm can hold the camera at each pose, (N,): in a posture that is not singular and touches
    neither itself nor the floor. Paths to the poses are not checked.

    poses: camera-to-world (N, 4, 4).
    Other arguments as in ``plan_tour``; of ``path`` only rolls_deg and floor_m are used.
    """
    found = _postures(arm, base, hand_eye, path, poses, None)
    joints, places = np.reshape([q for q, _ in found], (-1, 6)), np.array([k for _, k in found], np.int64)
    out = np.zeros(len(poses), np.bool_)
    out[places[is_free(arm, base, joints, joints, path.floor_m)]] = True
    return out


def _postures(
    arm: ArmModel, base: Array, hand_eye: Array, path: PathConfig, poses: Sequence[Array], near: Array | None
) -> list[tuple[Array, int]]:
    """Joint angles (6,) that bring the camera to each of ``poses``, with the pose's number."""
    camera_to_flange, base_inverse = se3_inverse(hand_eye), se3_inverse(base)
    return [
        (p.joints, k)
        for k, pose in enumerate(poses)
        for turn in path.rolls_deg
        for p in arm.inverse(base_inverse @ pose @ _roll(turn) @ camera_to_flange, near)
        if not p.singular
    ]


def _extend_tour(roadmap: Roadmap, count: int, first: Array, place: int) -> Tour:
    """Tour of ``count`` viewpoints that begins with the posture ``first`` (6,) at viewpoint ``place``."""
    stops, places = [first], [place]
    left = set(range(count)) - {place}
    while left and (steps := roadmap.shortest_path(stops[-1], left)) is not None:
        for joints, visited in steps:
            stops.append(joints)
            places.append(visited)
            left.discard(visited)
    return Tour(stops, places)
