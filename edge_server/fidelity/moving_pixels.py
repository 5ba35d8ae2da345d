"""Which pixels of a held-out camera move: only there is the age of information visible.

A pixel moves where the present truth differs from the truth 60, 120, 200 or 300 ms earlier by more than a
bound in some channel. In a mostly static scene the PSNR of the whole image hardly notices a late field; that
of these pixels does. On noise-free truth the bound is 0.03; for real video it is max(0.03, 4 sigma) of the
camera's own noise, which ``NoiseEstimate`` measures from successive frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity import fidelity_constants as tuned
from edge_server.fidelity.images import Image, to_unit

_BLOCK = 8
# Ratio of median to mean of a mean square of 192 normal values (8 x 8 pixels, 3 channels).
_CHI2_MEDIAN = (1.0 - 2.0 / (9.0 * 3 * _BLOCK**2)) ** 3


def moving_mask(truth: NDArray, earlier: Sequence[NDArray], bound: float = tuned.MOVING_BOUND) -> NDArray[np.bool_]:
    """Mask (H, W) of the pixels of ``truth`` that differ from any of ``earlier`` by more than ``bound``.

    Images are as ``images.to_unit`` takes them. Without earlier frames the mask is empty.
    """
    now = to_unit(truth, "truth")
    mask = np.zeros(now.shape[:2], dtype=bool)
    for image in earlier:
        then = to_unit(image, "earlier truth")
        if then.shape == now.shape:  # a camera may change its size between sessions
            mask |= np.abs(now - then).max(axis=2) > bound
    return mask


def frames_at_lags(
    times_ns: Sequence[int], present_ns: int, lags_ms: Sequence[float] = tuned.MOVING_LAGS_MS
) -> list[int]:
    """Indices into ``times_ns`` of the frames nearest to each of ``lags_ms`` before ``present_ns``, without
    repeats.

    Only frames before the present count, however far from their lag: even two frames a second show what
    moved.
    """
    past = [i for i, t in enumerate(times_ns) if t < present_ns]
    chosen: list[int] = []
    for lag in lags_ms:
        if not past:
            break
        wanted = present_ns - round(lag * 1e6)
        best = min(past, key=lambda i: abs(times_ns[i] - wanted))
        if best not in chosen:
            chosen.append(best)
    return chosen


def pair_noise(a: Image, b: Image) -> float | None:
    """Standard deviation in [0, 1] units of one frame's noise, from two successive frames (H, W, 3).

    Mean squares of the difference over 8 x 8 blocks, median over blocks: static blocks outvote moving ones,
    and the mean resolves noise far below one 8-bit step, where a median over pixels is 0. Blocks that are
    black or saturated anywhere show no noise and are left out. None where no block is left.
    """
    rows, columns = a.shape[0] // _BLOCK, a.shape[1] // _BLOCK
    if a.shape != b.shape or rows == 0 or columns == 0:
        return None
    crop = (slice(0, rows * _BLOCK), slice(0, columns * _BLOCK))

    def blocks(x: NDArray) -> NDArray:
        tiles = x[crop].reshape(rows, _BLOCK, columns, _BLOCK, 3).transpose(0, 2, 1, 3, 4)
        return tiles.reshape(-1, 3 * _BLOCK**2)

    low, high = np.minimum(a, b), np.maximum(a, b)
    votes = (blocks(low) > 0.0).all(1) & (blocks(high) < 1.0).all(1)
    if not votes.any():
        return None
    mean_square = (blocks(a - b)[votes] ** 2).mean(1)
    return float(np.sqrt(np.median(mean_square) / _CHI2_MEDIAN / 2.0))


@dataclass
class NoiseEstimate:
    """Running estimate of one camera's noise: the median over its latest pairs of frames."""

    pairs: list[float] = field(default_factory=list)

    def add(self, a: NDArray, b: NDArray) -> None:
        """Take two successive frames of the camera."""
        sigma = pair_noise(to_unit(a, "frame"), to_unit(b, "frame"))
        if sigma is not None:
            self.pairs = [*self.pairs, sigma][-tuned.NOISE_PAIRS :]

    @property
    def sigma(self) -> float:
        """Standard deviation in [0, 1] units; 0 before the first pair."""
        return min(float(np.median(self.pairs)), tuned.NOISE_LIMIT) if self.pairs else 0.0

    @property
    def bound(self) -> float:
        """A larger difference is motion rather than noise."""
        return max(tuned.MOVING_BOUND, tuned.MOVING_NOISE_SIGMAS * self.sigma)
