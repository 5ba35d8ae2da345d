"""Lens distortion: OpenCV's radial and tangential distortion.

Images are rendered through the distorted lens, ray by ray. Frames of calibrated cameras report that lens,
others a lens without distortion.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from camera_node.bounds import bounded
from camera_node.synthetic.effects import EffectError, EffectParameters
from freshfield.geometry import Pinhole, invertible


@dataclass(frozen=True)
class LensDistortionParameters(EffectParameters):
    """k1, k2: radial, p1, p2: tangential, without unit, as in OpenCV's model. calibrated: whether frames
    report the coefficients."""

    k1: float = bounded(-0.15, -10.0, 10.0)
    k2: float = bounded(0.03, -10.0, 10.0)
    p1: float = bounded(0.001, -1.0, 1.0)
    p2: float = bounded(-0.0005, -1.0, 1.0)
    calibrated: bool = True


class LensDistortion:
    """Rendered ahead at no extra cost; free while streaming. Raises EffectError if the distortion cannot be
    inverted over the whole image, or if the scene's lenses have a distortion already."""

    kind = "lens"
    Parameters = LensDistortionParameters

    def __init__(self, parameters: LensDistortionParameters, rng: np.random.Generator) -> None:
        self._p = parameters

    def rendered(self, camera: Pinhole) -> Pinhole:
        p = self._p
        if camera.distorted:
            raise EffectError(
                "effect lens_distortion: the scene's params have a distortion already: drop one"
            )
        lens = dataclasses.replace(camera, distortion=(p.k1, p.k2, p.p1, p.p2))
        if not invertible(lens):
            raise EffectError(
                f"effect lens_distortion: k1 {p.k1:g}, k2 {p.k2:g}, p1 {p.p1:g}, p2 {p.p2:g} cannot be "
                f"undone over the whole image at this field of view: take smaller ones or a longer lens"
            )
        return lens

    def reported(self, camera: Pinhole) -> Pinhole:
        return camera if self._p.calibrated else dataclasses.replace(camera, distortion=(0.0,) * 4)
