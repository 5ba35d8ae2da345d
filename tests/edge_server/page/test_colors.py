"""The age scale: right at its ends and its middle."""

from __future__ import annotations

import math

import numpy as np

from edge_server.page.colors import FRESH, MIDDLE, STALE, UNKNOWN, age_color, age_colors
from edge_server.page.settings import FRESH_MS, STALE_MS


def test_ends_and_middle_of_the_scale():
    assert age_color(0.0) == age_color(FRESH_MS) == FRESH
    assert age_color(STALE_MS) == age_color(1e9) == STALE
    assert age_color(math.sqrt(FRESH_MS * STALE_MS)) == MIDDLE
    assert age_color(-30.0) == FRESH  # a clock a little ahead
    assert (age_color(None), age_color(float("nan")), age_color(float("inf"))) == (UNKNOWN, STALE, STALE)
    ages = np.array([0.0, 90.0, 400.0, 1e9])
    np.testing.assert_allclose(age_colors(ages), [np.array(age_color(age)) / 255 for age in ages], atol=1e-6)
