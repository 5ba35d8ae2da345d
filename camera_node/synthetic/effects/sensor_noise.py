"""Sensor noise: Gaussian read noise and shot noise, independent for every pixel, channel and frame."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters, frame_rng
from camera_node.synthetic.render import Image
from freshfield.settings import within


class SensorNoise(EffectParameters, frozen=True):
    """sigma^2 = read^2 + signal * 255 / full_well, in counts: the Gaussian limit of photon counting, good
    above about ten electrons. About .6 ms for 128 x 128."""

    read_noise_counts: Annotated[float, within(0.0, 1e4, "standard deviation in black, of 255 counts")] = 1.5
    full_well_electrons: Annotated[
        float, within(0.0, 1e12, "charge at 255 counts, where shot noise is 255 / sqrt(charge); 0: no shot noise")
    ] = 4000.0

    kind: ClassVar[str] = "image"

    def start(self, rng: np.random.Generator) -> NoisySensor:
        return NoisySensor(self, rng)


class NoisySensor:
    """One camera's noise; a frame's noise depends only on the camera's random stream and the frame's
    number."""

    def __init__(self, parameters: SensorNoise, rng: np.random.Generator) -> None:
        self._key = rng.integers(0, 2**64, size=2, dtype=np.uint64)
        signal = np.arange(256, dtype=np.float64)
        gain = 255.0 / parameters.full_well_electrons if parameters.full_well_electrons else 0.0
        self._sigma = np.sqrt(parameters.read_noise_counts**2 + signal * gain).astype(np.float32)

    def apply(self, image: Image, index: int, t_s: float = 0.0) -> Image:
        noise = frame_rng(self._key, index).standard_normal(image.shape, dtype=np.float32)
        noise *= self._sigma[image]
        noise[..., 3:] = 0.0  # transparency is measured by no sensor
        noise += image
        np.rint(noise, out=noise)
        return np.clip(noise, 0.0, 255.0, out=noise).astype(np.uint8)
