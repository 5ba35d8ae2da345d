"""Bump: somebody knocks a fixed camera, which turns; its frames report the pose that it had before."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters
from freshfield.geometry import Array, so3_exp
from freshfield.settings import within


class Bump(EffectParameters, frozen=True):
    """From ``at_s`` on, a fixed camera of a synthetic world is turned: seconds of virtual time, while live it is turned
    from the start. Its frames do not repeat, and each is rendered when it is due."""

    at_s: Annotated[float, within(0.0, 1e9, "seconds after the epoch, where virtual time begins")] = 0.0
    yaw_deg: Annotated[float, within(-180.0, 180.0, "about its own y axis, to the right")] = 2.0
    pitch_deg: Annotated[float, within(-180.0, 180.0, "about its own x axis, up")] = 0.0

    kind: ClassVar[str] = "mount"

    def placed(self, camera_to_world: Array, t_s: float) -> Array:
        if t_s < self.at_s:
            return camera_to_world
        turned = camera_to_world.copy()
        turned[:3, :3] @= so3_exp(np.deg2rad([self.pitch_deg, self.yaw_deg, 0.0]))
        return turned
