"""Ages as colors: one scale for frustums, tables and the legend, readable by color-blind people.

Bluish green, yellow, vermillion after Okabe and Ito's palette, on a logarithmic axis: a network's delays
spread over decades, and what matters is whether an age is tens, hundreds or thousands of milliseconds.
"""

from __future__ import annotations

import math

import numpy as np

RGB = tuple[int, int, int]

FRESH_MS = 50.0
STALE_MS = 2000.0
FRESH: RGB = (0, 190, 140)
MIDDLE: RGB = (240, 228, 66)
STALE: RGB = (210, 50, 10)
UNKNOWN: RGB = (125, 131, 143)
"""A camera without an age: it never reported."""
HELD_OUT: RGB = (158, 128, 255)
"""The truth is not part of the age scale: it is never trained on. Violet, because sky blue is the same as the
fresh green to a tritanope."""
FOR: RGB = (0, 114, 178)
AGAINST: RGB = (213, 94, 0)
"""What spoke for a decision and what against it: blue and vermillion, as in the figures."""
# Frustums change color in steps, so that a page at rest sends next to nothing.
STEPS = 24


def age_fraction(age_ms: float) -> float:
    """Place of an age on the scale, 0 fresh to 1 stale; ages outside are clamped, NaN counts as stale."""
    if math.isnan(age_ms):
        return 1.0
    place = math.log(max(age_ms, FRESH_MS) / FRESH_MS) / math.log(STALE_MS / FRESH_MS)
    return min(1.0, place)


def age_color(age_ms: float | None) -> RGB:
    """Color of an age in milliseconds; grey for None."""
    if age_ms is None:
        return UNKNOWN
    return scale_color(round(age_fraction(age_ms) * STEPS) / STEPS)


def scale_color(fraction: float) -> RGB:
    """Color at ``fraction`` of the scale: green, yellow at the middle, vermillion."""
    r, g, b = (np.interp(fraction, (0.0, 0.5, 1.0), stops) for stops in zip(FRESH, MIDDLE, STALE))
    return round(float(r)), round(float(g)), round(float(b))


def css(color: RGB) -> str:
    """The color as HTML writes it."""
    return "#{:02x}{:02x}{:02x}".format(*color)
