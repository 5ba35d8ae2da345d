"""Occluder: an arm that sweeps back and forth between the cameras and the scene, close to the cameras.

It is a body of the world: every training camera sees the same arm at the same instant, in front of whatever
it hides. The held-out camera does not see it (``in_truth: false``): fidelity then measures how well the field
shows the scene in spite of it. With ``in_truth: true`` it belongs to the scene.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.motion import PERIOD_UNIT_S, bone_frames, phase_of
from camera_node.synthetic.placement import MovingBody, Part
from camera_node.synthetic.scene import Scene
from camera_node.synthetic.shapes import capsule
from camera_node.synthetic.textures import Stripes
from freshfield.geometry import Array
from freshfield.settings import within

_JOINTS = 9  # of the arch


class Occluder(EffectParameters, frozen=True):
    """An arch over the target from the horizon to the zenith, which passes cameras at any height. Rendered
    ahead (1 to 3 ms a frame); free while streaming."""

    period_s: Annotated[
        float, within(0.6, 600.0, "one sweep there and back, rounded to a multiple of the scene's period")
    ] = 6.0
    sweep_deg: Annotated[float, within(0.0, 180.0, "angle to either side")] = 100.0
    distance_share: Annotated[
        float, within(0.05, 0.95, "distance from the target, of the cameras'; as far beyond them if they look outward")
    ] = 0.7
    thickness_share: Annotated[float, within(0.005, 0.3, "diameter, of the cameras' distance")] = 0.06

    kind: ClassVar[str] = "world"

    def extend(self, scene: Scene) -> Scene:
        target = np.asarray(scene.target, dtype=np.float64)
        poses = np.stack([pose for _, pose in scene.cameras.values()])
        away = poses[:, :3, 3] - target
        reach = float(np.linalg.norm(away, axis=1).mean())
        outward = float((away * poses[:, :3, 2]).sum()) > 0.0
        share = 2.0 - self.distance_share if outward else self.distance_share
        base = scene.period_s if scene.moving else PERIOD_UNIT_S
        period = max(1, round(self.period_s / base)) * base
        elevation = np.linspace(0.0, 0.5 * math.pi, _JOINTS)
        joints = share * reach * np.stack([np.zeros(_JOINTS), -np.cos(elevation), np.sin(elevation)], axis=1)
        radius = 0.5 * self.thickness_share * reach
        length = float(np.linalg.norm(joints[1] - joints[0]))
        arm = Part(capsule(radius, length), Stripes((0.95, 0.72, 0.10), (0.14, 0.14, 0.15), length, axis=1))

        def matrices(t_s: float) -> Array:
            a = math.radians(self.sweep_deg) * math.sin(2 * math.pi * phase_of(t_s, period))
            rotation = np.array([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0], [0, 0, 1]])
            at = target + joints @ rotation
            side = np.broadcast_to(rotation[0], (_JOINTS - 1, 3))
            return bone_frames(at[:-1], at[1:], side)

        body = MovingBody((arm,) * (_JOINTS - 1), matrices)
        world = dataclasses.replace(scene.world, moving_bodies=(*scene.world.moving_bodies, body))
        return scene.with_world(world, period, moving=True)
