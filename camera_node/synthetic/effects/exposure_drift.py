"""Exposure drift: the automatic exposure of each camera drifts independently."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import cv2
import numpy as np

from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.motion import phase_of
from camera_node.synthetic.render import Image
from freshfield.settings import within


class ExposureDrift(EffectParameters, frozen=True):
    """Values become value * 2^stops, clipped at white, with stops = offset + amplitude * sin(2 pi (t / period
    + phase)); each camera has a random phase. Displayed values are scaled, as everywhere in this world."""

    amplitude_stops: Annotated[
        float, within(0.0, 8.0, "amplitude of the exposure's sine; one stop doubles the exposure")
    ] = 0.3
    period_s: Annotated[float, within(0.01, 1e6, "of the sine")] = 20.0
    offset_spread_stops: Annotated[float, within(0.0, 8.0, "standard deviation of each camera's constant offset")] = 0.1

    kind: ClassVar[str] = "image"

    def start(self, rng: np.random.Generator) -> DriftingExposure:
        return DriftingExposure(self, rng)


class DriftingExposure:
    """One camera's exposure. phase: of the sine, in periods. offset_stops: constant offset."""

    def __init__(self, parameters: ExposureDrift, rng: np.random.Generator) -> None:
        self._p = parameters
        self.phase = float(rng.random())
        self.offset_stops = parameters.offset_spread_stops * float(rng.standard_normal())

    def stops(self, t_s: float) -> float:
        """Exposure error at an instant, in stops."""
        phase = phase_of(t_s, self._p.period_s) + self.phase
        return self.offset_stops + self._p.amplitude_stops * math.sin(2 * math.pi * phase)

    def apply(self, image: Image, index: int, t_s: float) -> Image:
        table = np.clip(np.rint(np.arange(256) * 2.0 ** self.stops(t_s)), 0.0, 255.0).astype(np.uint8)
        changed = np.asarray(cv2.LUT(image, table), dtype=np.uint8)
        changed[..., 3:] = image[..., 3:]  # exposure does not change transparency
        return changed
