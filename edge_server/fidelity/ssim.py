"""Structural similarity, thesis (3.33), as Wang et al. (2004) published it.

Window: 11-tap Gaussian, sigma 1.5; K = (0.01, 0.03) on a range of 1 (the thesis writes k L^2 where the
paper squares K too; the paper's is what every tool computes). Variances are the window's weighted ones,
without Bessel's correction. **Valid region only**: the map is averaged where the window lies wholly
inside the image, so that no border rule matters; the three channels are scored separately and averaged. With a mask
it is averaged where the window lies wholly within the mask, too: a pixel outside it has no effect.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.images import Image, ImageError, same_size, to_unit

TAPS = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def gaussian_window() -> NDArray[np.float64]:
    """The (11,) window, sum 1."""
    x = np.arange(TAPS) - TAPS // 2
    w = np.exp(-(x**2) / (2.0 * SIGMA**2))
    return w / w.sum()


def ssim(rendering: NDArray, truth: NDArray, mask: NDArray[np.bool_] | None = None) -> float | None:
    """Mean SSIM in [-1, 1]; 1 for equal images of any content.

    Images are as ``images.to_unit`` takes them; both sides at least 11 pixels, else ImageError.
    mask: (H, W), the pixels to score; None: all. Where no window fits in, the result is None.
    """
    a, b = to_unit(rendering, "rendering"), to_unit(truth, "truth")
    same_size(a, b)
    if min(a.shape[:2]) < TAPS:
        raise ImageError(f"SSIM needs at least {TAPS} x {TAPS} pixels, got {a.shape[1]} x {a.shape[0]}")
    mu_a, mu_b = _windowed(a), _windowed(b)
    # A flat window's variance is a difference of equal numbers, which rounding may make negative.
    var_a = np.maximum(_windowed(a * a) - mu_a * mu_a, 0.0)
    var_b = np.maximum(_windowed(b * b) - mu_b * mu_b, 0.0)
    cov = _windowed(a * b) - mu_a * mu_b
    luminance = (2.0 * mu_a * mu_b + C1) / (mu_a * mu_a + mu_b * mu_b + C1)
    structure = (2.0 * cov + C2) / (var_a + var_b + C2)
    values = luminance * structure
    if mask is not None:
        values = values[_windows_within(mask)]
    return float(np.clip(values.mean(), -1.0, 1.0)) if values.size else None


def _windows_within(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Windows of the valid region, (H - 10, W - 10), all of whose pixels are in the mask (H, W)."""
    half, window = TAPS // 2, np.ones((TAPS, TAPS), np.uint8)
    return np.asarray(cv2.erode(mask.astype(np.uint8), window)[half:-half, half:-half] > 0)


def _windowed(image: Image) -> Image:
    half, w = TAPS // 2, gaussian_window()
    full = cv2.sepFilter2D(image, cv2.CV_64F, w, w)
    return np.asarray(full[half:-half, half:-half])
