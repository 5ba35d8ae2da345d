"""Motion blur: a frame is the mean of sub-exposures over the exposure time."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters, Renderer
from camera_node.synthetic.render import Image
from freshfield.settings import within


class MotionBlur(EffectParameters, frozen=True):
    """The time stamp is the middle of the exposure, so that blur adds no age. Displayed values are averaged,
    as everywhere in this world. Costs ``samples`` renderings a frame, ahead; free while streaming."""

    exposure_ms: Annotated[float, within(1e-6, 1000.0, "time for which the shutter is open")] = 20.0
    samples: Annotated[int, within(1, 64, "instants averaged within it")] = 5

    kind: ClassVar[str] = "exposure"

    def expose(self, renderer: Renderer, t_s: float) -> Image:
        n = self.samples
        share = (np.arange(n) + 0.5) / n - 0.5
        total: np.ndarray | None = None
        for offset in share * self.exposure_ms * 1e-3:
            image = renderer.image(t_s + float(offset)).astype(np.uint16)  # 64 times 255 fits
            total = image if total is None else total + image
        assert total is not None
        return ((total + n // 2) // n).astype(np.uint8)
