"""Exact depth is z of the camera at pixel centers, of static and moving parts, whatever the image's rays are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from camera_node.synthetic.depth import DepthRenderer
from camera_node.synthetic.placement import MovingBody, Part, at, facing
from camera_node.synthetic.render import World
from camera_node.synthetic.shapes import Quad, Sphere
from camera_node.synthetic.textures import Plain
from freshfield.geometry import Pinhole, look_at
from tests.camera_node.synthetic.test_render import FLAT

GRAY = Plain((0.5, 0.5, 0.5))
LENS = Pinhole.from_fov(64, 48, 60.0)
POSE = look_at([0.0, -3.0, 1.0], [0.0, 0.0, 1.0])  # looks along +y
WALL = Part(Quad((50.0, 50.0)), GRAY, facing((1, 0, 0), (0, 0, 1), (0, 1, 0)))


@pytest.mark.parametrize("distortion", [(0.0,) * 4, (-0.25, 0.06, 0.004, -0.003)])
def test_a_wall_across_the_optical_axis_is_equally_deep_everywhere_and_nothing_is_0(distortion):
    lens = dataclasses.replace(LENS, distortion=distortion)
    depth = DepthRenderer(World((WALL,), (), FLAT), lens, POSE).depth(0.0)
    assert depth.dtype == np.float32 and depth.shape == (48, 64)
    assert np.allclose(depth, 4.0, atol=1e-5)
    assert not DepthRenderer(World((), (), FLAT), lens, POSE).depth(0.0).any()


def test_moving_parts_hide_and_are_hidden_at_their_instant():
    ball = Part(Sphere(0.3), GRAY)
    moving = MovingBody((ball,), lambda t_s: at(t_s, 0.0, 1.0)[None])
    behind = MovingBody((ball,), lambda t_s: at(t_s, 3.0, 1.0)[None])  # never seen: behind the wall
    renderer = DepthRenderer(World((WALL,), (behind, moving), FLAT), LENS, POSE)
    for t_s in (0.0, 0.8, -0.8, 0.0):
        depth = renderer.depth(t_s)
        column = int(LENS.cx + LENS.fx * t_s / 3.0)
        assert depth[24, column] == pytest.approx(2.7, abs=0.03)
        # A ball of .3 m at 3 m: pi (.3 f / 3)^2 pixels.
        assert (depth < 3.9).sum() == pytest.approx(np.pi * (0.1 * LENS.fx) ** 2, rel=0.15)
        assert np.allclose(depth[depth > 3.1], 4.0, atol=1e-5)
