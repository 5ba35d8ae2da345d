"""The renderer against geometry it does not use: projections and brute force. How scenes look is in ``golden``."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import MovingBody, Part, at, place_static
from camera_node.synthetic.render import CameraRenderer, World, cast_rays
from camera_node.synthetic.shapes import Box, Sphere, nearest_hit
from camera_node.synthetic.textures import Checker, Plain
from freshfield.geometry import Pinhole, look_at, se3_inverse
from tests.camera_node.synthetic.test_shapes import SOLIDS

# Ambient only: every surface shows its albedo.
FLAT = Light(np.array([[0.0, 0.0, 50.0]]), 0.0, 1.0, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
POSE = look_at([1.5, -3.0, 1.2], [0.0, 0.0, 0.3])
WHITE, RED = Plain((1.0, 1.0, 1.0)), Plain((0.8, 0.1, 0.1))


@pytest.mark.parametrize("distortion", [(0.0, 0.0, 0.0, 0.0), (-0.25, 0.06, 0.004, -0.003)])
def test_a_small_ball_appears_where_the_camera_model_projects_it(distortion):
    camera = dataclasses.replace(Pinhole.from_fov(256, 192, 70.0), distortion=distortion)
    for point in ([0.0, 0.0, 0.3], [0.9, 0.4, -0.4], [-1.1, 0.2, 0.9]):
        world = World((Part(Sphere(0.05), WHITE, at(*point)),), (), FLAT)
        image = CameraRenderer(world, camera, POSE, supersample=3).image(0.0)[..., 0].astype(float)
        v, u = np.mgrid[0:192, 0:256] + 0.5
        centroid = np.array([(u * image).sum(), (v * image).sum()]) / image.sum()
        in_camera = se3_inverse(POSE) @ [*point, 1.0]
        assert np.allclose(centroid, camera.project(in_camera[:3]), atol=0.15)


def test_culling_leaves_out_no_ray_that_hits():
    """The culled cast equals every ray tried on every part."""
    rng = np.random.default_rng(0)
    parts = [Part(Sphere(0.3), WHITE, at(*rng.uniform(-1, 1, 3))) for _ in range(6)]
    parts += [Part(Box(tuple(rng.uniform(0.1, 0.5, 3))), RED, at(*rng.uniform(-1, 1, 3))) for _ in range(6)]
    d = rng.standard_normal((3, 4000))
    d /= np.linalg.norm(d, axis=0)
    for origin in (np.array([2.0, 1.0, 0.5]), np.array([0.1, 0.0, 0.0]), parts[0].matrix[:3, 3]):
        t, which = cast_rays(origin, d, place_static(parts), np.full(4000, np.inf))
        every = np.stack([nearest_hit(p.shape, (origin - p.matrix[:3, 3])[:, None], d) for p in parts])
        assert np.allclose(t, every.min(axis=0))
        hit = np.isfinite(t)
        assert np.array_equal(which[hit], every.argmin(axis=0)[hit]) and (which[~hit] == -1).all()


@pytest.mark.parametrize("supersample", [1, 2])
@pytest.mark.parametrize("order", [1, -1])
def test_bodies_at_rest_are_drawn_like_static_parts_and_hide_each_other_by_distance(supersample, order):
    post = Part(Box((0.1, 0.1, 0.6)), RED, at(0.25, -0.4, 0.6))
    near, far = Part(Sphere(0.2), RED, at(0.75, -1.5, 0.75)), Part(Sphere(0.5), WHITE, at(0.0, 0.0, 0.3))
    bodies = [MovingBody((part,), lambda t_s, part=part: part.matrix[None]) for part in (near, far)]
    camera = Pinhole.from_fov(96, 72, 60.0)
    still = CameraRenderer(World((post, near, far), (), FLAT), camera, POSE, supersample).image(0.0)
    moving = CameraRenderer(World((post,), tuple(bodies[::order]), FLAT), camera, POSE, supersample)
    first = moving.image(0.0)
    assert np.array_equal(first, still)
    first[:] = 7
    assert np.array_equal(moving.image(0.0), still), "images are the caller's own"


@pytest.mark.stability
@pytest.mark.parametrize("shape", SOLIDS, ids=repr)
@pytest.mark.filterwarnings("error")
def test_a_camera_inside_a_shape_sees_its_inside(shape):
    light = Light(np.array([[0.0, 0.0, 5.0]]), 0.5, 3.0, (0.4,) * 3, (0.6,) * 3)
    world = World((Part(shape, Checker((0.2,) * 3, (0.9,) * 3, 0.1)),), (), light)
    pose = look_at([0.01, 0.02, 0.05], [0.3, 0.2, 0.1])
    renderer = CameraRenderer(world, Pinhole.from_fov(32, 32, 90.0), pose)
    assert np.isfinite(renderer.distance()).all()
    assert renderer.image(0.0).min() > 0


@pytest.mark.stability
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("z", [0.0, 0.5, 0.499])
def test_a_light_inside_or_on_a_surface_does_no_harm(z):
    light = Light(np.array([[0.0, 0.0, z]]), 0.8, 3.0, (0.1,) * 3, (0.2,) * 3)
    world = World((Part(Sphere(0.5), Checker((0.2,) * 3, (0.9,) * 3, 0.1)),), (), light)
    pose = look_at([0.0, -2.0, 1.0], [0.0, 0.0, 0.0])
    assert CameraRenderer(world, Pinhole.from_fov(32, 32, 40.0), pose).image(0.0).max() > 0
