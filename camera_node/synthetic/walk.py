"""A camera in somebody's hand: a walk around the middle of a room, looking across it, with steps and a tremor.

Like all motion of the world it is a function of time that repeats and nothing is integrated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from camera_node.synthetic import synthetic_constants as tuned
from camera_node.synthetic.motion import phase_of
from camera_node.synthetic.scene import Scene
from freshfield.geometry import Array, Pose, look_at, so3_exp
from freshfield.settings import ScenarioError

_ROOMS = ("room", "drawn_room")


@dataclass(frozen=True)
class Walk:
    """One walk. center: (x, y, z) of the floor below its middle. start: share of a lap at time 0."""

    center: tuple[float, float, float]
    radius_m: float
    start: float = 0.0
    lap_s: float = tuned.WALK_LAP_S

    def pose(self, t_s: float) -> Array:
        """Camera-to-world (4, 4) at an instant."""
        a = 2.0 * math.pi * (phase_of(t_s, self.lap_s) + self.start)
        radius = self.radius_m * (1.0 + tuned.WALK_BEND * math.sin(tuned.WALK_BENDS * a))
        out = np.array([math.sin(a), -math.cos(a), 0.0])
        side = tuned.SWAY_M * math.sin(0.5 * tuned.WALK_STEPS * a) * np.array([-out[1], out[0], 0.0])
        up = np.array([0.0, 0.0, tuned.EYE_HEIGHT_M + tuned.BOB_M * math.sin(tuned.WALK_STEPS * a)])
        floor = np.asarray(self.center)
        aim = floor - self.radius_m * out + np.array([0.0, 0.0, tuned.AIM_HEIGHT_M])
        found = look_at(floor + radius * out + side + up, aim)
        turn = [sum(amplitude * math.sin(k * a + axis) for k, amplitude in tuned.WALK_TURNS[axis]) for axis in range(3)]
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
    radius_m = tuned.WALK_RADIUS * float(min(high[:2] - low[:2]))
    return {camera: Walk(center, radius_m, k / len(cameras)) for k, camera in enumerate(cameras)}
