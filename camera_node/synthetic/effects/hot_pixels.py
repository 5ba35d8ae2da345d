"""Hot pixels: permanent and transient damage of a sensor by radiation.

Damaged pixels leak charge in every frame. Particles leave charge in a pixel for one frame. With a color filter,
one of a pixel's three values is hit.
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

    hot_ppm: Annotated[float, within(0.0, 1e6, "damaged pixels in a million")] = 300.0
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
        self._damage: dict[tuple[int, ...], tuple[NDArray, NDArray]] = {}

    def apply(self, image: Image, index: int, t_s: float) -> Image:
        hot_at, hot_counts = self._hot(image.shape)
        hit_at, hit_counts = self._hits(image.shape, index)
        at, which = np.unique(np.concatenate([hot_at, hit_at]), return_inverse=True)
        added = np.bincount(which, np.concatenate([hot_counts, hit_counts]), at.size)
        out = image.copy()
        values = out.reshape(-1)
        values[at] = np.minimum(np.rint(values[at] + added), 255.0).astype(np.uint8)
        return out

    def _hot(self, shape: tuple[int, ...]) -> tuple[NDArray, NDArray]:
        """Flat indices and added counts of the damaged pixels."""
        if shape not in self._damage:
            rng = np.random.Generator(np.random.Philox(key=self._key))
            pixels = shape[0] * shape[1]
            damaged = np.flatnonzero(rng.random(pixels) < self._p.hot_ppm * 1e-6)
            at = shape[2] * damaged + rng.integers(0, 3, pixels)[damaged]
            self._damage[shape] = at, rng.exponential(self._p.hot_counts, pixels)[damaged]
        return self._damage[shape]

    def _hits(self, shape: tuple[int, ...], index: int) -> tuple[NDArray, NDArray]:
        rng = frame_rng(self._frame_key, index)
        pixels = shape[0] * shape[1]
        hits = int(rng.poisson(self._p.hits_per_megapixel * 1e-6 * pixels))
        at = shape[2] * rng.integers(0, pixels, hits) + rng.integers(0, 3, hits)
        return at, rng.exponential(self._p.hit_counts, hits)
