"""Peak signal-to-noise ratio, thesis (3.31) and (3.32)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.fidelity_constants import PSNR_CEILING_DB
from edge_server.fidelity.images import same_size, to_unit


def psnr_of_mse(mse: float) -> float:
    """PSNR in dB of a mean squared error on [0, 1] values, at most ``PSNR_CEILING_DB``. Raises ValueError for
    one that is negative or not finite."""
    if not np.isfinite(mse) or mse < 0.0:
        raise ValueError(f"mean squared error must be finite and not negative, got {mse}")
    floor = 10.0 ** (-PSNR_CEILING_DB / 10.0)
    return float(-10.0 * np.log10(max(float(mse), floor)))


def psnr(rendering: NDArray, truth: NDArray, mask: NDArray[np.bool_] | None = None) -> float | None:
    """PSNR in dB over all pixels and channels, or over the pixels of ``mask`` (H, W).

    Images are as ``images.to_unit`` takes them. None only where ``mask`` selects nothing. Raises ValueError
    for a mask of another size, ImageError (a ValueError) for images that cannot be compared.
    """
    a, b = to_unit(rendering, "rendering"), to_unit(truth, "truth")
    same_size(a, b)
    squared = (a - b) ** 2
    if mask is None:
        return psnr_of_mse(float(squared.mean()))
    if mask.shape != a.shape[:2]:
        raise ValueError(f"mask is {mask.shape} but the images are {a.shape[:2]}")
    if not mask.any():
        return None
    return psnr_of_mse(float(squared[mask].mean()))
