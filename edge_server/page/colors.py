"""The color scale of ages, for frustums, tables and the legend; readable by color-blind people.

Bluish green, yellow and vermilion after Okabe and Ito's palette, on a logarithmic axis: network delays span
decades, and what matters is whether an age is tens, hundreds or thousands of milliseconds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edge_server.page.settings import FRESH_MS, STALE_MS

RGB = tuple[int, int, int]

FRESH: RGB = (0, 190, 140)
MIDDLE: RGB = (240, 228, 66)
STALE: RGB = (210, 50, 10)
UNKNOWN: RGB = (125, 131, 143)
"""A camera that never reported."""
HELD_OUT: RGB = (158, 128, 255)
"""Held-out cameras are outside the age scale because they are never trained on. Violet, because a tritanope
cannot tell sky blue from the fresh green."""
MEASURED: RGB = (0, 114, 178)
PRESENT: RGB = (213, 94, 0)
"""Measured lines and the present point of a chart: blue and vermilion, as in the figures."""
# Frustums change color in steps, so that an idle page sends almost nothing.
STEPS = 24


def age_fraction(age_ms: float) -> float:
    """Position of an age on the scale, 0 fresh to 1 stale, clamped; NaN counts as stale."""
    if math.isnan(age_ms):
        return 1.0
    fraction = math.log(max(age_ms, FRESH_MS) / FRESH_MS) / math.log(STALE_MS / FRESH_MS)
    return min(1.0, fraction)


def age_color(age_ms: float | None) -> RGB:
    """Color of an age in milliseconds; gray for None."""
    if age_ms is None:
        return UNKNOWN
    return scale_color(round(age_fraction(age_ms) * STEPS) / STEPS)


def scale_color(fraction: float) -> RGB:
    """Color at ``fraction`` of the scale: green, yellow at the middle, vermillion."""
    r, g, b = (np.interp(fraction, (0.0, 0.5, 1.0), stops) for stops in zip(FRESH, MIDDLE, STALE))
    return round(float(r)), round(float(g)), round(float(b))


def age_colors(ages_ms: NDArray[np.float64]) -> NDArray[np.float32]:
    """``age_color`` of many ages (N,), in [0, 1], (N, 3)."""
    scale = np.array([scale_color(step / STEPS) for step in range(STEPS + 1)], np.float32) / 255
    fractions = np.log(np.maximum(ages_ms, FRESH_MS) / FRESH_MS) / np.log(STALE_MS / FRESH_MS)
    return scale[np.round(np.minimum(fractions, 1.0) * STEPS).astype(int)]


def css(color: RGB) -> str:
    """The color as HTML writes it."""
    return "#{:02x}{:02x}{:02x}".format(*color)
