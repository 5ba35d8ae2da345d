"""Vignetting: images darken towards their corners, by the cosine law of natural vignetting."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.bounds import bounded
from camera_node.synthetic.effects import EffectParameters, Renderer
from camera_node.synthetic.render import Image, Rows
from freshfield.geometry import Pinhole


@dataclass(frozen=True)
class VignettingParameters(EffectParameters):
    """exponent: of the cosine of a ray's angle to the optical axis; 4: thin lens, 0: no vignetting."""

    exponent: float = bounded(4.0, 0.0, 64.0)


class Vignetting:
    """Multiplies every pixel by cos(angle)^exponent, with the angle at which the lens, distorted or not, sees
    it. Displayed values are scaled, as everywhere in this world. Rendered ahead; free while streaming."""

    kind = "exposure"
    Parameters = VignettingParameters

    def __init__(self, parameters: VignettingParameters, rng: np.random.Generator) -> None:
        self._exponent = parameters.exponent
        self._gains: tuple[Pinhole, NDArray[np.float32]] | None = None

    def gain(self, camera: Pinhole) -> NDArray[np.float32]:
        """(H, W, 1): share of each pixel's light that is left; kept for the last camera."""
        if self._gains is None or self._gains[0] != camera:
            cosine = camera.rays()[..., 2:]
            self._gains = camera, (cosine**self._exponent).astype(np.float32)
        return self._gains[1]

    def expose(self, renderer: Renderer, t_s: float, rows: Rows | None = None) -> Image:
        first, stop = (0, renderer.camera.height) if rows is None else rows
        return np.rint(renderer.image(t_s, rows) * self.gain(renderer.camera)[first:stop]).astype(np.uint8)
