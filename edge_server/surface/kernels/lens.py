"""The lens of a camera, in double precision: fusion and PatchMatch project with it."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(inline="always")
def distort(a, b, k1, k2, p1, p2):
    """Distorted normalized coordinates of (a, b); NaN far outside, where the polynomial folds back into the
    image."""
    r2 = a * a + b * b
    # Radii grow up to where their derivative is 0 first: with k2 > 0 it is least at a radius of its own.
    least = -0.3 * k1 / k2 if k1 < 0.0 and 10.0 * k2 * r2 > -3.0 * k1 else r2
    if not (1.0 + least * (3.0 * k1 + least * 5.0 * k2) > 0.0 and r2 < 16.0):
        return np.nan, np.nan
    radial = 1.0 + r2 * (k1 + r2 * k2)
    return (
        a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a),
        b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b,
    )
