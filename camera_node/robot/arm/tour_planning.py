"""Plans a tour of viewpoints around a target for a camera on an arm.

A viewpoint is left out if the arm cannot reach it, reaches it only near a singularity, or has no free path to
it. A path is a straight line in joint space on which the arm keeps clear of itself, of a camera of usual size
on its flange, and of one floor. The floor check looks at joint centers only, so ``floor_m`` must include the
thickness of links, camera and cable. Other obstacles are unknown: on a real bench, watch the first round with a
hand on the stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.robot.arm import ArmError
from camera_node.robot.arm import arm_constants as tuned
from camera_node.robot.arm.capsules import CapsuleModel
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.arm.settings import PathConfig
from freshfield.geometry import Array, on_sphere, se3, se3_inverse, so3_exp


def viewpoints(path: PathConfig) -> list[Array]:
    """Camera-to-world (4, 4) of every viewpoint: down from the highest ring, up again at the next azimuth,
    and so on."""
    first, last = path.azimuths_deg
    count = max(2, round(abs(last - first) / path.step_deg) + 1)
    down = sorted(path.elevations_deg, reverse=True)
    return [
        on_sphere(path.target_m, path.radius_m, azimuth, elevation)
        for k, azimuth in enumerate(np.linspace(first, last, count))
        for elevation in (down if k % 2 == 0 else down[::-1])
    ]


@dataclass(frozen=True)
class Tour:
    """A tour of an arm.

    stops: joint angles (6,) in the order of the drive, with the ways back through earlier ones.
    places: numbers of the viewpoints visited, in order.
    """

    stops: list[Array]
    places: list[int]

    @property
    def reached(self) -> int:
        """Number of viewpoints visited."""
        return len(self.places)


def plan_tour(arm: ArmModel, base: Array, mount: Array, path: PathConfig, start: ArrayLike | None = None) -> Tour:
    """Plan a tour that goes on to the nearest viewpoint left; where no straight path leads on, it goes back.

    base: world-from-base (4, 4).
    mount: flange-from-camera (4, 4).
    start: current joint angles (6,); the tour begins near them, with a viewpoint to which the path is free.
    Raises ArmError if the arm can visit fewer than ``LEAST_VIEWPOINTS``.
    """
    poses = viewpoints(path)
    joints, places = _free_postures(arm, base, mount, path, poses)
    order, begin = np.arange(len(joints)), None if start is None else np.asarray(start, dtype=np.float64)
    if begin is not None:
        joints, far_rad = _turned_towards(arm, joints, begin)
        order = np.argsort(far_rad, kind="stable")
    best, visited = Tour([], []), np.zeros(len(joints), np.bool_)
    for k in order:
        # Every posture that an earlier tour came through leads to the same viewpoints.
        if best.reached == len(set(places.tolist())) or visited[k]:
            continue
        if begin is None or is_free(arm, base, begin, joints[k], path.floor_m).all():
            tour, used = _extend_tour(arm, base, path.floor_m, joints, places, int(k))
            visited |= used
            best = max(best, tour, key=lambda each: each.reached)
    if best.reached < tuned.LEAST_VIEWPOINTS:
        raise ArmError(
            f"the arm reaches {best.reached} of {len(poses)} viewpoints: change radius_m, elevations_deg, "
            "azimuths_deg, where the base stands, or the arm's posture before"
        )
    return best


def reachable(arm: ArmModel, base: Array, mount: Array, path: PathConfig, poses: Sequence[Array]) -> NDArray[np.bool_]:
    """Whether the arm can hold the camera at each pose, (N,): in a posture that is not singular and touches
    neither itself nor the floor. Paths to the poses are not checked.

    poses: camera-to-world (N, 4, 4).
    Other arguments as in ``plan_tour``; of ``path`` only rolls_deg and floor_m are used.
    """
    out = np.zeros(len(poses), np.bool_)
    out[_free_postures(arm, base, mount, path, poses)[1]] = True
    return out


def is_free(arm: ArmModel, base: Array, a: Array, b: Array, floor_m: float) -> NDArray[np.bool_]:
    """Whether straight paths in joint space are free (N,): the arm's parts keep their distance, and every
    joint center beyond the shoulder stays above the floor.

    base: world-from-base (4, 4).
    a, b: joint angles of both ends, (6,) or (N, 6).
    floor_m: height of the floor in the world.
    """
    a, b = np.broadcast_arrays(np.atleast_2d(a), np.atleast_2d(b))
    share = np.linspace(0.0, 1.0, tuned.CHECKED_POSTURES)[:, None, None]
    frames = arm.nominal_model.link_frames((a + share * (b - a)).reshape(-1, 6))
    lowest_m = (base @ frames)[:, 2:, 2, 3].min(axis=1)
    apart_m = CapsuleModel(arm, tuned.TOOL_M, tuned.TOOL_RADIUS_M).clearance(frames)[0].min(axis=1)
    free = (lowest_m >= floor_m) & (apart_m >= tuned.MARGIN_M)
    return np.asarray(free.reshape(tuned.CHECKED_POSTURES, -1).all(axis=0))


def _free_postures(
    arm: ArmModel, base: Array, mount: Array, path: PathConfig, poses: Sequence[Array]
) -> tuple[Array, NDArray[np.int64]]:
    """Joint angles (N, 6) that bring the camera to ``poses``, not singular and free, and each pose's number."""
    camera_to_flange, base_inverse = se3_inverse(mount), se3_inverse(base)
    found = [
        (joints, k)
        for k, pose in enumerate(poses)
        for roll in np.deg2rad(path.rolls_deg)
        for joints in arm.inverse(base_inverse @ pose @ se3(so3_exp([0, 0, roll]), [0, 0, 0]) @ camera_to_flange)
        if not arm.singular(joints)
    ]
    postures = np.reshape([joints for joints, _ in found], (-1, 6))
    places = np.array([k for _, k in found], dtype=np.int64)
    free = is_free(arm, base, postures, postures, path.floor_m) if found else np.zeros(0, np.bool_)
    return postures[free], places[free]


def _turned_towards(arm: ArmModel, joints: Array, at: Array) -> tuple[Array, Array]:
    """``joints`` (N, 6), each shifted by full turns towards ``at`` (6,) as far as its limits allow, and the largest
    turn of a joint from there (N,)."""
    turn = 2.0 * np.pi
    near = joints + turn * np.round((at - joints) / turn)
    near = np.where((near < arm.lower_rad) | (near > arm.upper_rad), joints, near)
    return near, np.abs(near - at).max(axis=1)


def _extend_tour(
    arm: ArmModel, base: Array, floor_m: float, joints: Array, places: NDArray[np.int64], first: int
) -> tuple[Tour, NDArray[np.bool_]]:
    """The tour that begins with posture ``first`` of ``joints`` (N, 6), and which postures led on (N,).

    Depth first: from each stop to the nearest posture of a viewpoint left; back where there is none.
    """
    stops, visited = [joints[first]], [int(places[first])]
    used = np.zeros(len(joints), np.bool_)
    used[first] = True
    trail = [joints[first]]
    back: list[Array] = []
    while trail:
        at = trail[-1]
        near, far_rad = _turned_towards(arm, joints, at)
        left = ~np.isin(places, visited) & (far_rad <= tuned.FARTHEST_RAD)
        order = np.flatnonzero(left)[np.argsort(far_rad[left], kind="stable")]
        step = next((k for k in order if is_free(arm, base, at, near[k], floor_m)[0]), None)
        if step is None:
            trail.pop()
            back += trail[-1:]
            continue
        # Ways back that lead nowhere are not driven: they are added only before a further viewpoint.
        stops += [*back, near[step]]
        visited.append(int(places[step]))
        used[step] = True
        trail.append(near[step])
        back = []
    return Tour(stops, visited), used
