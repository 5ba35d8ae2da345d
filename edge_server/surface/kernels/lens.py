"""The lens of a camera, in double precision: fusion and PatchMatch project with it."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(inline="always")
def distort(a, b, k1, k2, p1, p2):
    """Distorted normalized coordinates of (a, b); NaN far outside, where the polynomial folds back into the
    image."""
    r2 = a * a + b * b
    radial = 1.0 + r2 * (k1 + r2 * k2)
    if not (radial > 0.0 and r2 < 16.0):
        return np.nan, np.nan
    return (
        a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a),
        b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b,
    )
