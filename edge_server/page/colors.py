"""The color scale of ages, for frustums, tables and the legend; readable by color-blind people.

Bluish green, yellow and vermilion of Okabe and Ito's palette, on a logarithmic axis: network delays span decades, and
what matters is whether an age is tens, hundreds or thousands of milliseconds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.page.page_constants import COLOR_STEPS, FRESH_MS, STALE_MS

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


def age_color(age_ms: float | None) -> RGB:
    """Color of an age in milliseconds; NaN counts as stale, None is gray."""
    return UNKNOWN if age_ms is None else _SCALE[int(_steps(np.float64(age_ms)))]


def scale_color(fraction: float) -> RGB:
    """Color at ``fraction`` of the scale: green, yellow at the middle, vermillion."""
    r, g, b = (np.interp(fraction, (0.0, 0.5, 1.0), stops) for stops in zip(FRESH, MIDDLE, STALE))
    return round(float(r)), round(float(g)), round(float(b))


def age_colors(ages_ms: NDArray[np.float64]) -> NDArray[np.float32]:
    """``age_color`` of many ages (N,), in [0, 1], (N, 3)."""
    return (np.array(_SCALE, np.float32) / 255)[_steps(ages_ms)]


_SCALE = [scale_color(step / COLOR_STEPS) for step in range(COLOR_STEPS + 1)]


def _steps(ages_ms: Any) -> Any:
    """Positions of ages on the scale: 0 fresh to COLOR_STEPS stale, clamped."""
    ages_ms = np.clip(np.nan_to_num(ages_ms, nan=STALE_MS), FRESH_MS, STALE_MS)
    return np.round(np.log(ages_ms / FRESH_MS) / np.log(STALE_MS / FRESH_MS) * COLOR_STEPS).astype(int)


def css(color: RGB) -> str:
    """The color as HTML writes it."""
    return "#{:02x}{:02x}{:02x}".format(*color)
