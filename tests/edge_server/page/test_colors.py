"""The age scale: right at its ends, monotone, and told apart by color-blind people."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from edge_server.page.colors import FRESH, HELD_OUT, MIDDLE, STALE, UNKNOWN, age_color, age_colors, scale_color
from edge_server.page.settings import FRESH_MS, STALE_MS

# Machado, Oliveira and Fernandes (2009), severity 1, acting on linear RGB.
DEFICIENCIES = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}


def test_ends_and_middle_of_the_scale():
    assert age_color(0.0) == age_color(FRESH_MS) == FRESH
    assert age_color(STALE_MS) == age_color(1e9) == STALE
    assert age_color(math.sqrt(FRESH_MS * STALE_MS)) == MIDDLE
    assert age_color(-30.0) == FRESH  # a clock a little ahead
    assert (age_color(None), age_color(float("nan")), age_color(float("inf"))) == (UNKNOWN, STALE, STALE)
    ages = np.array([0.0, 90.0, 400.0, 1e9])
    np.testing.assert_allclose(age_colors(ages), [np.array(age_color(age)) / 255 for age in ages], atol=1e-6)


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
def test_the_scale_survives_color_blindness(deficiency):
    matrix = DEFICIENCIES[deficiency]
    scale = [_lab(scale_color(f), matrix) for f in np.linspace(0, 1, 25)]
    fresh, middle, stale = scale[0], scale[12], scale[24]
    # CIE76, in which 2.3 is just noticeable: the scale's ends and middle must be unmistakable.
    assert min(np.linalg.norm(a - b) for a, b in ((fresh, middle), (middle, stale), (fresh, stale))) > 40
    assert min(np.linalg.norm(_lab(HELD_OUT, matrix) - color) for color in scale) > 25


def _lab(color: tuple[int, int, int], matrix: list[list[float]]) -> np.ndarray:
    rgb = np.array(color) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(matrix) @ linear, 0, 1)
    back = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    return cv2.cvtColor(back.astype(np.float32).reshape(1, 1, 3), cv2.COLOR_RGB2Lab).reshape(3)
