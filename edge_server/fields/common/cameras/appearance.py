"""Appearance embeddings: a few numbers learned for each camera, on which colors depend and density does not.

Nerfacto's appearance embedding (Tancik et al. 2023; from NeRF in the Wild, Martin-Brualla et al. 2021),
with two differences. The network outputs the derivative of color by the numbers (``add_appearance``) instead
of taking them as input, since one network gives density and color here. And the mean over cameras is kept at
0, so that rendering at the mean embedding costs nothing.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.cameras import camera_refinement_constants as tuned
from edge_server.fields.field_constants import BETA1, BETA2

Array = NDArray[np.float64]


class AppearanceEmbeddings:
    """Embeddings by camera, trained by Adam. size: numbers a camera."""

    def __init__(self, size: int, seed: int) -> None:
        self.size, self.seed = size, seed
        self.known: dict[str, Array] = {}  # camera -> (3, size): value, and Adam's two moments
        self.steps = 0

    def rows(self, cameras: Sequence[str]) -> NDArray[np.float32]:
        """Embeddings of cameras, float32 (V, size). First values depend on the seed and the name only."""
        fresh = [name for name in cameras if name not in self.known]
        for name in fresh:
            rng = np.random.default_rng(np.random.SeedSequence([self.seed, zlib.crc32(name.encode())]))
            value = rng.normal(0.0, tuned.APPEARANCE_FIRST, self.size)
            self.known[name] = np.stack([value, np.zeros(self.size), np.zeros(self.size)])
        if fresh:
            self._center_mean()
        return np.array([self.known[name][0] for name in cameras], dtype=np.float32)

    def learn(self, cameras: Sequence[str], gradient: NDArray[np.float32], rays: int) -> None:
        """One step of Adam. gradient: float32 (chunks, V, size), summed over ``rays`` rays."""
        self.steps += 1
        total = gradient.astype(np.float64).sum(axis=0) / max(rays, 1) * len(cameras)
        for name, g in zip(cameras, total):
            if not np.isfinite(g).all():
                continue
            value, m, v = self.known[name]
            m = BETA1 * m + (1.0 - BETA1) * g
            v = BETA2 * v + (1.0 - BETA2) * g * g
            root = np.sqrt(v / (1.0 - BETA2**self.steps)) + tuned.APPEARANCE_EPSILON
            value = value - tuned.APPEARANCE_RATE * m / (1.0 - BETA1**self.steps) / root
            self.known[name] = np.stack([np.clip(value, -tuned.APPEARANCE_MOST, tuned.APPEARANCE_MOST), m, v])
        self._center_mean()

    def _center_mean(self) -> None:
        mean = np.mean([known[0] for known in self.known.values()], axis=0)
        for known in self.known.values():
            known[0] -= mean

    def meta(self) -> dict[str, Any]:
        """What a state keeps: exact, ready for JSON."""
        known = {name: array.tolist() for name, array in self.known.items()}
        return {"appearances": known, "appearance_steps": self.steps}

    def load(self, meta: dict[str, Any]) -> None:
        """Restore what ``meta`` returned."""
        self.known = {name: np.array(array, dtype=np.float64) for name, array in meta.get("appearances", {}).items()}
        self.steps = int(meta.get("appearance_steps", 0))
