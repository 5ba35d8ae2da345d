"""Ways of an arm from posture to posture that touch nothing: straight in joint space where that is free, else
by way of others, the shortest there is (Dijkstra on a roadmap whose nodes are postures of use anyway).

It knows the arm (with a camera of usual size on its flange), one floor and no other obstacle.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from camera_node.robot.arm.capsules import Shape, links
from camera_node.robot.arm.kinematics import ArmModel

Array = NDArray[np.float64]

_LOOKS = 24  # postures that are looked at on the way between two
_TOOL_M, _TOOL_RADIUS_M = 0.08, 0.04  # as in TeleopConfig: the camera and what holds it
_MARGIN_M = 0.01  # between parts of the arm, whose capsules are rounded up
FARTHEST_RAD = 2.0  # that a joint turns in one go: beyond, the arm would be flung into another posture
_SAME_RAD = 1e-6


class Roadmap:
    """Postures (P, 6) of an arm, each with the number of the place that it takes the hand to. base:
    world-from-base (4, 4). floor_m: see ``clear``. What is free is remembered: asking again costs little."""

    def __init__(
        self, arm: ArmModel, base: Array, postures: Sequence[Array], places: Sequence[int], floor_m: float
    ) -> None:
        self._arm, self._base, self._floor_m = arm, base, floor_m
        every = np.reshape(np.array(postures), (-1, 6))
        free = clear(arm, base, every, every, floor_m)
        self._postures, self._places = every[free], np.array(places, dtype=np.int64)[free]
        self._low, self._high = np.array(arm.lower_rad), np.array(arm.upper_rad)
        self._free: dict[tuple[bytes, bytes], bool] = {}
        self._known: set[bytes] = set()

    def way(self, start: Array, wanted: Collection[int]) -> list[tuple[Array, int]] | None:
        """Postures (6,) to take in turn from ``start`` to the nearest of the places ``wanted``, with their
        places; None if there is no way. Its length is what the fastest joint turns: the time it takes."""
        order = itertools.count()  # of equally long ones the first
        ends: list[tuple[float, int, Array, int, tuple[bytes, ...]]] = [(0.0, next(order), start, -1, ())]
        found: dict[bytes, tuple[Array, int]] = {}
        while ends:
            length, _, at, place, way = heapq.heappop(ends)
            key = _key(at)
            # Whether the last step is free is asked now: of most that could be made nobody wants to know.
            if key in found or (way and not self._is_free(found[way[-1]][0], at)):
                continue
            found[key] = at, place
            self._known.add(key)
            if place in wanted:
                return [found[each] for each in (*way[1:], key)]
            near = self._near(at)
            steps = np.abs(near - at).max(axis=1, initial=0.0)
            inside = np.all((near >= self._low) & (near <= self._high), axis=1)
            for k in np.flatnonzero((steps <= FARTHEST_RAD) & inside):
                end = length + float(steps[k]), next(order), near[k], int(self._places[k]), (*way, key)
                heapq.heappush(ends, end)
        return None

    @property
    def reachable(self) -> int:
        """How many places have a posture that is free."""
        return len(set(self._places.tolist()))

    def knows(self, joints: Array) -> bool:
        """Whether a search has come to this posture."""
        return _key(joints) in self._known

    def _near(self, at: Array) -> Array:
        """The postures, by whole turns as near to ``at`` as can be: otherwise they are too far for one go."""
        turn = 2.0 * np.pi
        return self._postures + turn * np.round((at - self._postures) / turn)

    def _is_free(self, a: Array, b: Array) -> bool:
        ends = _key(a), _key(b)
        if ends not in self._free:
            free = bool(clear(self._arm, self._base, a, b, self._floor_m)[0])
            self._free[ends] = self._free[ends[::-1]] = free
        return self._free[ends]


def clear(arm: ArmModel, base: Array, a: Array, b: Array, floor_m: float) -> NDArray[np.bool_]:
    """Whether on the straight ways from ``a`` to ``b``, (6,) or (N, 6), no part of the arm comes near
    another, and the middle of no joint beyond the shoulder below ``floor_m`` in the world: (N,)."""
    a, b = np.broadcast_arrays(np.atleast_2d(a), np.atleast_2d(b))
    if not len(b):
        return np.zeros(0, np.bool_)
    share = np.linspace(0.0, 1.0, _LOOKS)[:, None, None]
    frames = links(arm.body, (a + share * (b - a)).reshape(-1, 6))
    lowest_m = (base @ frames)[:, 2:, 2, 3].min(axis=1)
    apart_m = Shape(arm, _TOOL_M, _TOOL_RADIUS_M).clearance(frames)[0].min(axis=1)
    free = (lowest_m >= floor_m) & (apart_m >= _MARGIN_M)
    return np.asarray(free.reshape(_LOOKS, -1).all(axis=0))


def _key(joints: Array) -> bytes:
    return np.round(joints / _SAME_RAD).astype(np.int64).tobytes()
