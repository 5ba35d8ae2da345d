"""Light switch: the lamps on one side of the scene go out, and on again, for all cameras at once.

List it ``in_truth: true``: the field then has to show the scene as it is lit.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.motion import PERIOD_UNIT_S, phase_of
from camera_node.synthetic.scene import Scene
from freshfield.settings import within


class LightSwitch(EffectParameters, frozen=True):
    """Rendered ahead, static parts twice; free while streaming. The period is rounded to a multiple of the scene's; the
    lamps go out halfway, but for one."""

    period_s: Annotated[float, within(0.6, 600.0, "from one time the lamps go on to the next")] = 6.0
    share: Annotated[float, within(0.0, 1.0, "of the light's points, those farthest to one side")] = 0.5
    azimuth_deg: Annotated[float, within(-360.0, 360.0, "of that side, from the x axis")] = 0.0

    kind: ClassVar[str] = "world"

    def extend(self, scene: Scene) -> Scene:
        base = scene.period_s if scene.moving else PERIOD_UNIT_S
        period = max(1, round(self.period_s / base)) * base
        world = dataclasses.replace(scene.world, switch=_Lamps(self, period))
        return scene.with_world(world, period, moving=True)


@dataclass(frozen=True)
class _Lamps:
    """Implements lighting.Switch. period_s: as rounded for the scene."""

    effect: LightSwitch
    period_s: float

    def on(self, t_s: float) -> bool:
        """Whether all lamps are on at an instant."""
        return phase_of(t_s, self.period_s) < 0.5

    def without(self, light: Light) -> Light:
        """What is left of a light when the lamps are out."""
        azimuth = math.radians(self.effect.azimuth_deg)
        aside = light.points[:, :2] @ (math.cos(azimuth), math.sin(azimuth))
        count = len(light.points)
        left = np.sort(np.argsort(aside, kind="stable")[: max(1, count - round(self.effect.share * count))])
        return dataclasses.replace(light, points=light.points[left], strength=light.strength * len(left) / count)
