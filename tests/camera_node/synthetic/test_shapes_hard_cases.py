"""Hard cases of ray casting: parallel, grazing, from the surface, from within, tiny, huge and far."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import Part
from camera_node.synthetic.render import CameraRenderer, World
from camera_node.synthetic.shapes import Box, Cylinder, Quad, RoundCone, Sphere, capsule, nearest_hit
from camera_node.synthetic.textures import Checker
from freshfield.geometry import Pinhole, look_at

pytestmark = pytest.mark.stability

SHAPES = [
    Sphere(0.5),
    Box((0.5, 0.3, 0.7)),
    Cylinder(0.4, 0.6),
    RoundCone(0.4, 0.1, 0.9),
    RoundCone(0.2, 0.4, 0.3),
    capsule(0.3, 0.6),
    Quad((0.5, 0.5)),
]
AXES = np.concatenate([np.eye(3), -np.eye(3)]).T


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
@pytest.mark.filterwarnings("error")
def test_rays_along_the_axes_from_everywhere_are_finite_or_miss(shape):
    """Origins on a grid that holds the surfaces, edges, corners, axes and center of every shape."""
    steps = np.array([-2.0, -0.7, -0.5, -0.3, 0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.9, 2.0])
    for origin in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3):
        t = nearest_hit(shape, origin[:, None], AXES)
        assert not np.isnan(t).any() and (t > 0).all()
        hit = np.isfinite(t)
        if hit.any():
            normal, uv = shape.surface(origin[:, None] + t[hit] * AXES[:, hit])
            assert np.isfinite(normal).all() and np.isfinite(uv).all()


def test_a_ray_does_not_meet_the_surface_it_starts_on():
    for shape, at in ((Sphere(0.5), [0.5, 0, 0]), (Box((0.5, 0.3, 0.7)), [0.5, 0, 0])):
        origin = np.array(at, dtype=float)[:, None]
        assert np.isinf(nearest_hit(shape, origin, np.array([[1.0], [0.0], [0.0]])))[0]
        across = nearest_hit(shape, origin, np.array([[-1.0], [0.0], [0.0]]))
        assert across[0] == pytest.approx(1.0)


@pytest.mark.parametrize("shape", SHAPES[:-1], ids=repr)
@pytest.mark.filterwarnings("error")
def test_a_camera_inside_a_shape_sees_its_inside(shape):
    light = Light(np.array([[0.0, 0.0, 5.0]]), 0.5, 3.0, (0.4,) * 3, (0.6,) * 3)
    world = World((Part(shape, Checker((0.2,) * 3, (0.9,) * 3, 0.1)),), (), light)
    pose = look_at([0.01, 0.02, 0.05], [0.3, 0.2, 0.1])
    renderer = CameraRenderer(world, Pinhole.from_fov(32, 32, 90.0), pose)
    assert np.isfinite(renderer.distance()).all()
    assert renderer.image(0.0).min() > 0


@pytest.mark.filterwarnings("error")
def test_a_light_inside_or_on_a_surface_does_no_harm():
    for z in (0.0, 0.5, 0.499):
        light = Light(np.array([[0.0, 0.0, z]]), 0.8, 3.0, (0.1,) * 3, (0.2,) * 3)
        world = World((Part(Sphere(0.5), Checker((0.2,) * 3, (0.9,) * 3, 0.1)),), (), light)
        pose = look_at([0.0, -2.0, 1.0], [0.0, 0.0, 0.0])
        image = CameraRenderer(world, Pinhole.from_fov(32, 32, 40.0), pose).image(0.0)
        assert image.max() > 0
