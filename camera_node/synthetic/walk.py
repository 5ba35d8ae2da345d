"""A camera in somebody's hand: a walk around the middle of a room, looking across it, with steps and a tremor.

Like all motion of the world it is a function of time that repeats and nothing is integrated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from camera_node.synthetic.motion import phase_of
from camera_node.synthetic.scene import Scene
from freshfield.geometry import Array, Pose, look_at, so3_exp
from freshfield.settings import ScenarioError

# 32 units of .6 s: at 10 captures a second a lap has 192, a multiple of 8, of which each 8th can be held out.
_LAP_S = 19.2
_ROOMS = ("room", "drawn_room")
_RADIUS = 0.2  # of the room's width: between furniture and walls of all rooms that were looked at
_EYE_HEIGHT_M = 1.45
_AIM_HEIGHT_M = 0.85  # of the point across the room that is looked at: what stands there, not the wall above
# Step frequency 1.7 Hz (32 a lap); amplitudes of head and hand while walking.
_STEPS, _BOB_M, _SWAY_M = 32, 0.015, 0.02
# (cycles a lap, amplitude in degrees) of the rotation about the camera's x, y and z: looking about, then tremor.
_TURNS = (((3, 5.0), (23, 0.5)), ((5, 9.0), (29, 0.6)), ((4, 3.0), (26, 0.5)))


@dataclass(frozen=True)
class Walk:
    """One walk. center: (x, y, z) of the floor below its middle. start: share of a lap at time 0."""

    center: tuple[float, float, float]
    radius_m: float
    start: float = 0.0
    lap_s: float = _LAP_S

    def pose(self, t_s: float) -> Array:
        """Camera-to-world (4, 4) at an instant."""
        a = 2.0 * math.pi * (phase_of(t_s, self.lap_s) + self.start)
        radius = self.radius_m * (1.0 + 0.15 * math.sin(3.0 * a))
        out = np.array([math.sin(a), -math.cos(a), 0.0])
        side = _SWAY_M * math.sin(0.5 * _STEPS * a) * np.array([-out[1], out[0], 0.0])
        up = np.array([0.0, 0.0, _EYE_HEIGHT_M + _BOB_M * math.sin(_STEPS * a)])
        floor = np.asarray(self.center)
        aim = floor - self.radius_m * out + np.array([0.0, 0.0, _AIM_HEIGHT_M])
        found = look_at(floor + radius * out + side + up, aim)
        turn = [sum(amplitude * math.sin(k * a + axis) for k, amplitude in _TURNS[axis]) for axis in range(3)]
        found[:3, :3] = found[:3, :3] @ so3_exp(np.deg2rad(turn))
        return found

    def measured(self, t_s: float) -> tuple[Pose, int]:
        """The true pose at an instant, to which it is 0 ns."""
        return Pose.from_matrix(self.pose(t_s)), 0


def walks_through(scene: Scene, cameras: Sequence[str]) -> dict[str, Walk]:
    """The walk of each camera, which start evenly spread over a lap. Raises ScenarioError for a scene without a
    floor to walk on."""
    if scene.name not in _ROOMS:
        raise ScenarioError(f"scene {scene.name} is no room to walk in: expected {' or '.join(_ROOMS)}")
    low, high = scene.bounds
    center = (float(scene.target[0]), float(scene.target[1]), float(low[2]))
    radius_m = _RADIUS * float(min(high[:2] - low[:2]))
    return {camera: Walk(center, radius_m, k / len(cameras)) for k, camera in enumerate(cameras)}
