"""Pose delay: frames report where the camera was a moment before, as with a tracker whose clock or pipeline is late."""

from __future__ import annotations

from typing import Annotated, ClassVar

from camera_node.synthetic.effects import EffectParameters
from freshfield.settings import within


class PoseDelay(EffectParameters, frozen=True):
    """Of cameras in a synthetic world that are carried about; one that stands still reports the same pose. Free."""

    delay_ms: Annotated[float, within(-1e4, 1e4, "age of the pose at the exposure; below 0: it is early")] = 30.0

    kind: ClassVar[str] = "delay"

    def instant_s(self, t_s: float) -> float:
        """Instant, s, whose pose the frame of ``t_s`` reports."""
        return t_s - self.delay_ms * 1e-3
