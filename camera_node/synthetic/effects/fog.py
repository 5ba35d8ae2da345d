"""Fog: low visibility, by Koschmieder's law.

A share exp(-beta d) of a surface's light arrives from a distance d, and airlight fills the rest (Koschmieder,
"Theorie der horizontalen Sichtweite", 1924). The visibility is the distance at which a black object
against the fog keeps ``contrast_threshold`` of its contrast: beta = -ln(threshold) / visibility.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.scene import Scene
from freshfield.geometry import Array
from freshfield.settings import within

Share = Annotated[float, within(0.0, 1.0, "color of the fog, RGB")]


class Fog(EffectParameters, frozen=True):
    """Rendered ahead; free while streaming. A scene's background is all fog."""

    visibility_m: Annotated[float, within(0.01, 1e6, "distance at which contrast falls to contrast_threshold")] = 20.0
    contrast_threshold: Annotated[float, within(1e-6, 0.5, ".02 is Koschmieder's, .05 the WMO's")] = 0.02
    airlight: tuple[Share, Share, Share] = (0.76, 0.78, 0.80)

    kind: ClassVar[str] = "world"

    @property
    def extinction_per_m(self) -> float:
        """Koschmieder's extinction coefficient beta."""
        return -math.log(self.contrast_threshold) / self.visibility_m

    def extend(self, scene: Scene) -> Scene:
        return scene.with_world(dataclasses.replace(scene.world, medium=self))

    def transmittance(self, distance_m: Array) -> NDArray[np.float32]:
        """See ``lighting.Medium``."""
        return np.exp(-self.extinction_per_m * distance_m).astype(np.float32)
