"""Vignetting: images darken towards their corners, by the cosine law of natural vignetting."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.effects import EffectParameters, Renderer
from camera_node.synthetic.render import Image
from freshfield.geometry import Pinhole
from freshfield.settings import within


class Vignetting(EffectParameters, frozen=True):
    """Multiplies every pixel by cos(angle)^exponent, with the angle at which the lens, distorted or not, sees
    it. Displayed values are scaled, as everywhere in this world. Rendered ahead; free while streaming."""

    exponent: Annotated[
        float, within(0.0, 64.0, "of the cosine of a ray's angle to the optical axis; 4: thin lens, 0: none")
    ] = 4.0

    kind: ClassVar[str] = "exposure"

    def expose(self, renderer: Renderer, t_s: float) -> Image:
        return np.rint(renderer.image(t_s) * gains(renderer.camera, self.exponent)).astype(np.uint8)


@lru_cache(maxsize=16)
def gains(camera: Pinhole, exponent: float) -> NDArray[np.float32]:
    """Share of each pixel's light that is left, (H, W, 1)."""
    return (camera.rays()[..., 2:] ** exponent).astype(np.float32)
