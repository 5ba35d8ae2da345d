"""Occluder: an arm that sweeps back and forth between the cameras and the scene, close to the cameras.

It is a body of the world, so every training camera sees the same arm at the same instant, in front of
what lies behind it. The held-out camera does not see it (``in_truth: false``): fidelity then asks how
well the field shows the scene in spite of it. With ``in_truth: true`` it belongs to the scene.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from camera_node.synthetic.motion import TICK_S, bone_frames, phase_of
from camera_node.synthetic.placement import Mover, Part
from camera_node.synthetic.shapes import Array, capsule
from camera_node.synthetic.textures import Stripes

if TYPE_CHECKING:
    from camera_node.synthetic.scene import Scene

_JOINTS = 9  # of the arch, from the horizon to the zenith


@dataclass(frozen=True)
class OccluderParameters:
    """period_s: one sweep there and back, rounded to a multiple of the scene's own period. sweep_deg: how
    far to either side. distance_share: how far from the target towards the cameras (1 = at the cameras);
    where cameras look outward, as far beyond them. thickness_share: diameter, as a share of the cameras'
    distance."""

    period_s: float = 6.0
    sweep_deg: float = 100.0
    distance_share: float = 0.7
    thickness_share: float = 0.06
    in_truth: bool = False

    def __post_init__(self) -> None:
        if not 0.6 <= self.period_s <= 600.0:
            raise ValueError(f"period_s must be within 0.6 to 600, got {self.period_s}")
        if not 0.05 <= self.distance_share <= 0.95:
            raise ValueError(f"distance_share must be within 0.05 to 0.95, got {self.distance_share}")
        if not 0.005 <= self.thickness_share <= 0.3:
            raise ValueError(f"thickness_share must be within 0.005 to 0.3, got {self.thickness_share}")
        if not 0.0 <= self.sweep_deg <= 180.0:
            raise ValueError(f"sweep_deg must be within 0 to 180, got {self.sweep_deg}")


class Occluder:
    """An arch over the target from the horizon to the zenith, so that it passes cameras at any height.
    Rendered ahead (some 1 to 3 ms a frame); nothing while streaming."""

    kind: ClassVar[str] = "world"
    Parameters = OccluderParameters

    def __init__(self, parameters: OccluderParameters, rng: np.random.Generator) -> None:
        # One body is the same for every camera, so nothing about it is drawn from a camera's stream.
        self._p = parameters

    def extend(self, scene: Scene) -> Scene:
        p = self._p
        target = np.asarray(scene.target, dtype=np.float64)
        poses = np.stack([pose for _, pose in scene.cameras.values()])
        away = poses[:, :3, 3] - target
        reach = float(np.linalg.norm(away, axis=1).mean())
        outward = float((away * poses[:, :3, 2]).sum()) > 0.0
        share = 2.0 - p.distance_share if outward else p.distance_share
        base = scene.period_s if scene.moving else TICK_S
        period = max(1, round(p.period_s / base)) * base
        elevation = np.linspace(0.0, 0.5 * math.pi, _JOINTS)
        joints = share * reach * np.stack(
            [np.zeros(_JOINTS), -np.cos(elevation), np.sin(elevation)], axis=1
        )  # fmt: skip
        radius = 0.5 * p.thickness_share * reach
        length = float(np.linalg.norm(joints[1] - joints[0]))
        arm = Part(capsule(radius, length), Stripes((0.95, 0.72, 0.10), (0.14, 0.14, 0.15), length, axis=1))

        def matrices(t_s: float) -> Array:
            a = math.radians(p.sweep_deg) * math.sin(2 * math.pi * phase_of(t_s, period))
            turn = np.array([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0], [0, 0, 1]])
            at = target + joints @ turn
            side = np.broadcast_to(turn[0], (_JOINTS - 1, 3))
            return bone_frames(at[:-1], at[1:], side)

        mover = Mover((arm,) * (_JOINTS - 1), matrices)
        world = dataclasses.replace(scene.world, movers=(*scene.world.movers, mover))
        return scene.with_world(world, period, moving=True)
