"""Hot pixels: permanent and transient damage of a sensor by radiation.

Damaged pixels leak charge in every frame, and their number grows with the dose. Particles leave charge in a
pixel for one frame. With a color filter, one of a pixel's three values is hit.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.effects import EffectParameters, frame_rng
from camera_node.synthetic.render import Image
from freshfield.settings import within


class HotPixels(EffectParameters, frozen=True):
    """Added values are exponentially distributed and clipped at white; hits are a Poisson process."""

    hot_ppm: Annotated[float, within(0.0, 1e6, "damaged pixels in a million at the start")] = 300.0
    growth_ppm_per_h: Annotated[float, within(0.0, 1e6, "newly damaged pixels in an hour")] = 0.0
    hot_counts: Annotated[float, within(0.0, 1e6, "mean value that a damaged pixel adds, of 255 counts")] = 100.0
    hits_per_megapixel: Annotated[float, within(0.0, 1e6, "mean number of particles a frame")] = 50.0
    hit_counts: Annotated[float, within(0.0, 1e6, "mean value that a particle adds")] = 150.0

    kind: ClassVar[str] = "image"

    def start(self, rng: np.random.Generator) -> DamagedSensor:
        return DamagedSensor(self, rng)


class DamagedSensor:
    """One camera's sensor. Its random stream decides which pixels are damaged, and, with a frame's number,
    the frame's hits."""

    def __init__(self, parameters: HotPixels, rng: np.random.Generator) -> None:
        self._p = parameters
        self._key, self._frame_key = rng.integers(0, 2**64, size=(2, 2), dtype=np.uint64)
        self._damage: dict[tuple[int, ...], tuple[NDArray, NDArray, NDArray]] = {}

    def apply(self, image: Image, index: int, t_s: float) -> Image:
        hot_at, hot_counts = self._hot(image.shape, t_s)
        hit_at, hit_counts = self._hits(image.shape, index)
        at, which = np.unique(np.concatenate([hot_at, hit_at]), return_inverse=True)
        added = np.bincount(which, np.concatenate([hot_counts, hit_counts]), at.size)
        out = image.copy()
        values = out.reshape(-1)
        values[at] = np.minimum(np.rint(values[at] + added), 255.0).astype(np.uint8)
        return out

    def _hot(self, shape: tuple[int, ...], t_s: float) -> tuple[NDArray, NDArray]:
        """Flat indices and added counts of the pixels that are damaged by ``t_s``."""
        p = self._p
        if shape not in self._damage:
            rng = np.random.Generator(np.random.Philox(key=self._key))
            pixels = shape[0] * shape[1]
            dose = rng.random(pixels)  # a pixel is damaged once the share of damaged pixels exceeds its dose
            order = np.argsort(dose) if p.growth_ppm_per_h else np.flatnonzero(dose < p.hot_ppm * 1e-6)
            at = shape[2] * order + rng.integers(0, 3, pixels)[order]
            self._damage[shape] = dose[order], at, rng.exponential(p.hot_counts, pixels)[order]
        dose, at, counts = self._damage[shape]
        if not p.growth_ppm_per_h:
            return at, counts
        damaged = np.searchsorted(dose, 1e-6 * (p.hot_ppm + p.growth_ppm_per_h * max(t_s, 0.0) / 3600.0))
        return at[:damaged], counts[:damaged]

    def _hits(self, shape: tuple[int, ...], index: int) -> tuple[NDArray, NDArray]:
        rng = frame_rng(self._frame_key, index)
        pixels = shape[0] * shape[1]
        hits = int(rng.poisson(self._p.hits_per_megapixel * 1e-6 * pixels))
        at = shape[2] * rng.integers(0, pixels, hits) + rng.integers(0, 3, hits)
        return at, rng.exponential(self._p.hit_counts, hits)
