"""Vignetting follows the cosine to the fourth power of the angle under which the lens sees a pixel."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from camera_node.synthetic.effects.vignetting import Vignetting, gains
from freshfield.geometry import Pinhole
from tests.camera_node.synthetic.effects.timed_renderer import TimedRenderer

CAMERA = Pinhole.from_fov(129, 65, 90.0)  # odd: the middle pixel's center is on the axis
WHITE = np.full((65, 129, 3), 200, np.uint8)


def make(exponent: float = 4.0) -> Vignetting:
    return Vignetting(exponent=exponent)


def test_known_pixels():
    image = make().expose(TimedRenderer(lambda t: WHITE, CAMERA), 0.0)
    assert (image[32, 64] == 200).all()  # on the axis
    # At the middle of the right edge the angle is atan(64 / 64.5), nearly 45 degrees: a quarter is left.
    assert (image[32, 128] == round(200 * math.cos(math.atan(64 / 64.5)) ** 4)).all()
    # In the corner: cos^4 = 1 / (1 + x^2 + y^2)^2 at x = 64 / f, y = 32 / f.
    corner = 200 / (1 + (64 / 64.5) ** 2 + (32 / 64.5) ** 2) ** 2
    assert (image[0, 0] == round(corner)).all() and (image[64, 128] == round(corner)).all()


def test_the_exponent_is_a_parameter_and_none_changes_nothing():
    renderer = TimedRenderer(lambda t: WHITE, CAMERA)
    assert np.array_equal(make(0.0).expose(renderer, 0.0), WHITE)
    edge = round(200 * math.cos(math.atan(64 / 64.5)) ** 2)
    assert (make(2.0).expose(renderer, 0.0)[32, 128] == edge).all()


def test_it_follows_the_lens_off_its_center_and_distorted():
    lens = dataclasses.replace(CAMERA, cx=30.5, cy=20.5, distortion=(-0.1, 0.01, 0.0, 0.0))
    gain = gains(lens, 4.0)[..., 0]
    assert np.unravel_index(gain.argmax(), gain.shape) == (20, 30)
    rays = lens.rays()
    assert np.allclose(gain, rays[..., 2] ** 4, atol=1e-6)
    assert not np.allclose(gain, gains(dataclasses.replace(lens, distortion=(0.0,) * 4), 4.0)[..., 0], atol=1e-3)


@pytest.mark.filterwarnings("error")
def test_a_steep_law_blackens_the_corners_and_nothing_overflows():
    image = make(64.0).expose(TimedRenderer(lambda t: np.full_like(WHITE, 255), CAMERA), 0.0)
    assert image[32, 64, 0] == 255 and image[0, 0, 0] == 0
