"""Lens distortion: OpenCV's radial and tangential distortion.

Images are rendered through the distorted lens, ray by ray. Frames of calibrated cameras report that lens,
others a lens without distortion.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from camera_node.bounds import bounded
from camera_node.synthetic.effects import EffectError, EffectParameters
from freshfield.geometry import Pinhole, invertible


@dataclass(frozen=True)
class LensDistortion(EffectParameters):
    """Rendered ahead at no extra cost; free while streaming. Raises EffectError if the distortion cannot be
    inverted over the whole image, or if the scene's lenses have a distortion already.

    k1, k2: radial, p1, p2: tangential, without unit, as in OpenCV's model. calibrated: whether frames
    report the coefficients."""

    k1: float = bounded(-0.15, -10.0, 10.0)
    k2: float = bounded(0.03, -10.0, 10.0)
    p1: float = bounded(0.001, -1.0, 1.0)
    p2: float = bounded(-0.0005, -1.0, 1.0)
    calibrated: bool = True

    kind = "lens"

    def rendered(self, camera: Pinhole) -> Pinhole:
        if camera.distorted:
            raise EffectError("effect lens_distortion: the scene's params have a distortion already: drop one")
        lens = dataclasses.replace(camera, distortion=(self.k1, self.k2, self.p1, self.p2))
        if not invertible(lens):
            raise EffectError(
                f"effect lens_distortion: k1 {self.k1:g}, k2 {self.k2:g}, p1 {self.p1:g}, p2 {self.p2:g} "
                f"cannot be undone over the whole image at this field of view: take smaller ones or a "
                f"longer lens"
            )
        return lens

    def reported(self, camera: Pinhole) -> Pinhole:
        return camera if self.calibrated else dataclasses.replace(camera, distortion=(0.0,) * 4)
