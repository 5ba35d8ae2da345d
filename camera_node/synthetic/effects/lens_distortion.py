"""Lens distortion: OpenCV's radial and tangential distortion.

Images are rendered through the distorted lens, ray by ray. Frames of calibrated cameras report that lens,
others a lens without distortion.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated, ClassVar

from camera_node.synthetic.effects import EffectError, EffectParameters
from freshfield.geometry import Pinhole, invertible
from freshfield.settings import about, within


class LensDistortion(EffectParameters, frozen=True):
    """OpenCV's model, without units. Rendered ahead at no extra cost; free while streaming.

    Raises EffectError if the distortion cannot be inverted over the whole image.
    """

    k1: Annotated[float, within(-10.0, 10.0, "radial")] = -0.15
    k2: Annotated[float, within(-10.0, 10.0, "radial")] = 0.03
    p1: Annotated[float, within(-1.0, 1.0, "tangential")] = 0.001
    p2: Annotated[float, within(-1.0, 1.0, "tangential")] = -0.0005
    calibrated: Annotated[bool, about("whether frames report the coefficients")] = True

    kind: ClassVar[str] = "lens"

    def rendered(self, camera: Pinhole) -> Pinhole:
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
