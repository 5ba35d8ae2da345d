"""Exposure drift: the automatic exposure of each camera drifts independently."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from camera_node.bounds import bounded
from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.motion import phase_of
from camera_node.synthetic.render import Image


@dataclass(frozen=True)
class ExposureDrift(EffectParameters):
    """Values become value * 2^stops, clipped at white, with stops = offset + amplitude * sin(2 pi (t / period
    + phase)). Displayed values are scaled, as everywhere in this world.

    amplitude_stops: amplitude of the exposure's sine; one stop doubles the exposure. period_s: of the
    sine; each camera has a random phase. offset_spread_stops: standard deviation of each camera's constant
    offset."""

    amplitude_stops: float = bounded(0.3, 0.0, 8.0)
    period_s: float = bounded(20.0, 0.01, 1e6)
    offset_spread_stops: float = bounded(0.1, 0.0, 8.0)

    kind = "image"

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
