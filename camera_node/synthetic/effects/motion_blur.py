"""Motion blur: a frame is the mean of sub-exposures over the exposure time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from camera_node.bounds import bounded
from camera_node.synthetic.effects import EffectParameters, Renderer
from camera_node.synthetic.render import Image, Rows


@dataclass(frozen=True)
class MotionBlur(EffectParameters):
    """The time stamp is the middle of the exposure, so that blur adds no age. Displayed values are averaged,
    as everywhere in this world. Costs ``samples`` renderings a frame, ahead; free while streaming.

    exposure_ms: time for which the shutter is open. samples: instants averaged within it."""

    exposure_ms: float = bounded(20.0, 1e-6, 1000.0)
    samples: int = bounded(5, 1, 64)

    kind = "exposure"

    def expose(self, renderer: Renderer, t_s: float, rows: Rows | None = None) -> Image:
        n = self.samples
        share = (np.arange(n) + 0.5) / n - 0.5
        total: np.ndarray | None = None
        for offset in share * self.exposure_ms * 1e-3:
            image = renderer.image(t_s + float(offset), rows).astype(np.uint16)  # 64 times 255 fits
            total = image if total is None else total + image
        assert total is not None
        return ((total + n // 2) // n).astype(np.uint8)
