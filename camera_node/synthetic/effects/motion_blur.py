"""Motion blur: a frame is the mean of sub-exposures over the exposure time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from camera_node.bounds import bounded
from camera_node.synthetic.effects import EffectParameters, Renderer
from camera_node.synthetic.render import Image, Rows


@dataclass(frozen=True)
class MotionBlurParameters(EffectParameters):
    """exposure_ms: time for which the shutter is open. samples: instants averaged within it."""

    exposure_ms: float = bounded(20.0, 1e-6, 1000.0)
    samples: int = bounded(5, 1, 64)


class MotionBlur:
    """The time stamp is the middle of the exposure, so that blur adds no age. Displayed values are averaged,
    as everywhere in this world. Costs ``samples`` renderings a frame, ahead; free while streaming."""

    kind = "exposure"
    Parameters = MotionBlurParameters

    def __init__(self, parameters: MotionBlurParameters, rng: np.random.Generator) -> None:
        share = (np.arange(parameters.samples) + 0.5) / parameters.samples - 0.5
        self._offsets_s = share * parameters.exposure_ms * 1e-3

    def expose(self, renderer: Renderer, t_s: float, rows: Rows | None = None) -> Image:
        total: np.ndarray | None = None
        for offset in self._offsets_s:
            image = renderer.image(t_s + float(offset), rows).astype(np.uint16)  # 64 times 255 fits
            total = image if total is None else total + image
        assert total is not None
        n = len(self._offsets_s)
        return ((total + n // 2) // n).astype(np.uint8)
