"""Collision-free paths between postures of an arm: the straight line in joint space if it is free, else the
shortest path through other postures (Dijkstra on a roadmap whose nodes are the tour's own postures).

Obstacles are the arm itself, a camera of usual size on its flange, and one floor.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from camera_node.robot.arm.capsules import CapsuleModel, link_frames
from camera_node.robot.arm.kinematics import ArmModel

Array = NDArray[np.float64]

FARTHEST_RAD = 2.0
"""Largest turn of a joint in one move."""
_CHECKED_POSTURES = 24  # tested along a path
_TOOL_M, _TOOL_RADIUS_M = 0.08, 0.04  # as in TeleopConfig: the camera and its mount
_MARGIN_M = 0.01  # between parts of the arm, whose capsules are rounded up
_EQUAL_RAD = 1e-6


class Roadmap:
    """Graph of an arm's postures. It caches the results of ``is_free``.

    base: world-from-base (4, 4).
    postures: joint angles (6,) each.
    places: for each posture, the number of the place to which it brings the hand.
    floor_m: see ``is_free``.
    """

    def __init__(
        self, arm: ArmModel, base: Array, postures: Sequence[Array], places: Sequence[int], floor_m: float
    ) -> None:
        self._arm, self._base, self._floor_m = arm, base, floor_m
        every = np.reshape(np.array(postures), (-1, 6))
        free = is_free(arm, base, every, every, floor_m)
        self._postures, self._places = every[free], np.array(places, dtype=np.int64)[free]
        self._low, self._high = np.array(arm.lower_rad), np.array(arm.upper_rad)
        self._free: dict[tuple[bytes, bytes], bool] = {}
        self._known: set[bytes] = set()

    def shortest_path(self, start: Array, wanted: Collection[int]) -> list[tuple[Array, int]] | None:
        """Shortest path from the posture ``start`` (6,) to any of the places ``wanted``; None if there is
        none.

        Returns its postures (6,), without ``start``, and their places. The length of a step is the largest
        turn of a joint, which is proportional to the time that the step takes.
        """
        order = itertools.count()  # breaks ties: the first of equally long paths
        ends: list[tuple[float, int, Array, int, tuple[bytes, ...]]] = [(0.0, next(order), start, -1, ())]
        found: dict[bytes, tuple[Array, int]] = {}
        while ends:
            length, _, at, place, way = heapq.heappop(ends)
            key = _key(at)
            # Tested lazily: most steps are never needed.
            if key in found or (way and not self._is_free(found[way[-1]][0], at)):
                continue
            found[key] = at, place
            self._known.add(key)
            if place in wanted:
                return [found[each] for each in (*way[1:], key)]
            near = self._unwrap_near(at)
            steps = np.abs(near - at).max(axis=1, initial=0.0)
            inside = np.all((near >= self._low) & (near <= self._high), axis=1)
            for k in np.flatnonzero((steps <= FARTHEST_RAD) & inside):
                end = length + float(steps[k]), next(order), near[k], int(self._places[k]), (*way, key)
                heapq.heappush(ends, end)
        return None

    @property
    def reachable(self) -> int:
        """Number of places that have a free posture."""
        return len(set(self._places.tolist()))

    def has_visited(self, joints: Array) -> bool:
        """Whether a search has reached this posture."""
        return _key(joints) in self._known

    def _unwrap_near(self, at: Array) -> Array:
        """The postures (P, 6), shifted by full turns towards ``at``."""
        turn = 2.0 * np.pi
        return self._postures + turn * np.round((at - self._postures) / turn)

    def _is_free(self, a: Array, b: Array) -> bool:
        ends = _key(a), _key(b)
        if ends not in self._free:
            free = bool(is_free(self._arm, self._base, a, b, self._floor_m)[0])
            self._free[ends] = self._free[ends[::-1]] = free
        return self._free[ends]


def is_free(arm: ArmModel, base: Array, a: Array, b: Array, floor_m: float) -> NDArray[np.bool_]:
    """Whether straight paths in joint space are free (N,): the arm's parts keep their distance, and every
    joint center beyond the shoulder stays above the floor.

    base: world-from-base (4, 4).
    a, b: joint angles of both ends, (6,) or (N, 6).
    floor_m: height of the floor in the world.
    """
    a, b = np.broadcast_arrays(np.atleast_2d(a), np.atleast_2d(b))
    if not len(b):
        return np.zeros(0, np.bool_)
    share = np.linspace(0.0, 1.0, _CHECKED_POSTURES)[:, None, None]
    frames = link_frames(arm.nominal_model, (a + share * (b - a)).reshape(-1, 6))
    lowest_m = (base @ frames)[:, 2:, 2, 3].min(axis=1)
    apart_m = CapsuleModel(arm, _TOOL_M, _TOOL_RADIUS_M).clearance(frames)[0].min(axis=1)
    free = (lowest_m >= floor_m) & (apart_m >= _MARGIN_M)
    return np.asarray(free.reshape(_CHECKED_POSTURES, -1).all(axis=0))


def _key(joints: Array) -> bytes:
    return np.round(joints / _EQUAL_RAD).astype(np.int64).tobytes()
