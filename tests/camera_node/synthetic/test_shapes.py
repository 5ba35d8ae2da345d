"""Shapes, images and depth against geometry that the renderer does not use. How scenes look is in golden."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from camera_node.synthetic.depth import DepthRenderer
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import MovingBody, Part, at, facing, place_static
from camera_node.synthetic.render import CameraRenderer, World, cast_rays
from camera_node.synthetic.shapes import Box, Cylinder, Quad, RoundCone, Sphere, capsule, nearest_hit
from camera_node.synthetic.textures import Checker, Plain
from freshfield.geometry import Array, Pinhole, look_at

# Their surfaces, edges, corners and axes lie on the grid of origins below.
SOLIDS = [
    Sphere(0.5),
    Box((0.5, 0.3, 0.7)),
    Cylinder(0.4, 0.6),
    RoundCone(0.4, 0.1, 0.9),
    RoundCone(0.2, 0.4, 0.3),
    capsule(0.3, 0.6),
]
TOLERANCE = 1e-9


def signed_distance(shape: object) -> Callable[[Array], Array]:
    """Distance (N,) of points (3, N) to a shape's surface, negative inside (textbook formulae)."""
    if isinstance(shape, Sphere):
        return lambda p: np.linalg.norm(p, axis=0) - shape.radius
    if isinstance(shape, Box):
        return lambda p: _box(np.abs(p) - np.array(shape.half)[:, None])
    if isinstance(shape, Cylinder):
        return lambda p: _box(np.stack([np.hypot(p[0], p[1]) - shape.radius, np.abs(p[2]) - shape.half_height]))
    assert isinstance(shape, RoundCone)
    return lambda p: _round_cone(shape, p)


def _box(q: Array) -> Array:
    return np.linalg.norm(np.maximum(q, 0.0), axis=0) + np.minimum(q.max(axis=0), 0.0)


def _round_cone(s: RoundCone, p: Array) -> Array:
    """Quilez' formula: a ball at either end, and between them the cone that touches both."""
    rho, slope = np.hypot(p[0], p[1]), (s.r0 - s.r1) / s.length
    rise = np.sqrt(1.0 - slope**2)
    along = rise * p[2] - slope * rho
    first, second = np.hypot(rho, p[2]) - s.r0, np.hypot(rho, p[2] - s.length) - s.r1
    return np.where(along < 0.0, first, np.where(along > rise * s.length, second, rise * rho + slope * p[2] - s.r0))


@pytest.mark.parametrize("shape", SOLIDS, ids=repr)
def test_hits_lie_on_the_surface_nothing_lies_before_them_and_normals_are_the_distances_gradient(shape):
    sdf = signed_distance(shape)
    origin = np.array([[1.7], [-1.1], [0.9]])
    # Aim near the shape so that both hits and misses are frequent.
    aim = np.random.default_rng(1).uniform(-0.9, 0.9, (3, 400)) - origin
    d = aim / np.linalg.norm(aim, axis=0)
    t = nearest_hit(shape, origin, d)
    hit = np.isfinite(t)
    assert 40 < hit.sum() < 360
    p = origin + t[hit] * d[:, hit]
    assert np.abs(sdf(p)).max() < TOLERANCE
    for share in np.linspace(0.0, 0.999, 12):
        assert sdf(origin + share * t[hit] * d[:, hit]).min() > -TOLERANCE
    for distance in np.linspace(0.0, 4.0, 60):
        assert sdf(origin + distance * d[:, ~hit]).min() > -TOLERANCE
    inside = np.array([[0.01], [0.02], [0.03]])
    p = inside + nearest_hit(shape, inside, d) * d
    normal, h = shape.surface(p)[0], 1e-4
    gradient = np.stack([sdf(p + h * e[:, None]) - sdf(p - h * e[:, None]) for e in np.eye(3)]) / (2 * h)
    # Near an edge of a box or cylinder the difference straddles two faces.
    assert np.quantile((normal * gradient).sum(axis=0) / np.linalg.norm(gradient, axis=0), 0.03) > 0.999
    assert np.allclose(np.linalg.norm(normal, axis=0), 1.0)


@pytest.mark.stability
@pytest.mark.parametrize("shape", [*SOLIDS, Quad((0.5, 0.5))], ids=repr)
@pytest.mark.filterwarnings("error")
def test_rays_along_the_axes_from_everywhere_are_finite_or_miss(shape):
    """Origins on a grid that holds the surfaces, edges, corners, axes and center of every shape."""
    axes = np.concatenate([np.eye(3), -np.eye(3)]).T
    steps = np.array([-2.0, -0.7, -0.5, -0.3, 0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.9, 2.0])
    for origin in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3):
        t = nearest_hit(shape, origin[:, None], axes)
        assert not np.isnan(t).any() and (t > 0).all()
        hit = np.isfinite(t)
        if hit.any():
            normal, uv = shape.surface(origin[:, None] + t[hit] * axes[:, hit])
            assert np.isfinite(normal).all() and np.isfinite(uv).all()


# Ambient only: every surface shows its albedo.
FLAT = Light(np.array([[0.0, 0.0, 50.0]]), 0.0, 1.0, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
WHITE = Plain((1.0, 1.0, 1.0))


def test_culling_leaves_out_no_ray_that_hits():
    """The culled cast equals every ray tried on every part."""
    rng = np.random.default_rng(0)
    parts = [Part(Sphere(0.3), WHITE, at(*rng.uniform(-1, 1, 3))) for _ in range(6)]
    parts += [Part(Box(tuple(rng.uniform(0.1, 0.5, 3))), WHITE, at(*rng.uniform(-1, 1, 3))) for _ in range(6)]
    d = rng.standard_normal((3, 4000))
    d /= np.linalg.norm(d, axis=0)
    for origin in (np.array([2.0, 1.0, 0.5]), np.array([0.1, 0.0, 0.0]), parts[0].matrix[:3, 3]):
        t, which = cast_rays(origin, d, place_static(parts), np.full(4000, np.inf))
        every = np.stack([nearest_hit(p.shape, (origin - p.matrix[:3, 3])[:, None], d) for p in parts])
        assert np.allclose(t, every.min(axis=0))
        hit = np.isfinite(t)
        assert np.array_equal(which[hit], every.argmin(axis=0)[hit]) and (which[~hit] == -1).all()


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


def test_depth_is_z_at_pixel_centers_of_parts_that_stand_and_move_and_0_where_nothing_is():
    lens = dataclasses.replace(Pinhole.from_fov(64, 48, 60.0), distortion=(-0.25, 0.06, 0.004, -0.003))
    pose = look_at([0.0, -3.0, 1.0], [0.0, 0.0, 1.0])  # looks along +y
    wall = Part(Quad((50.0, 50.0)), WHITE, facing((1, 0, 0), (0, 0, 1), (0, 1, 0)))
    ball = Part(Sphere(0.3), WHITE)
    moving = MovingBody((ball,), lambda t_s: at(t_s, 0.0, 1.0)[None])
    behind = MovingBody((ball,), lambda t_s: at(t_s, 3.0, 1.0)[None])  # never seen: behind the wall
    renderer = DepthRenderer(World((wall,), (behind, moving), FLAT), lens, pose)
    for t_s in (0.0, 0.8, -0.8, 0.0):
        depth = renderer.depth(t_s)
        u, v = lens.project(np.array([t_s, 0.0, 3.0])).astype(int)
        assert depth.dtype == np.float32 and depth[v, u] == pytest.approx(2.7, abs=0.03)
        # A ball of .3 m at 3 m: pi (.3 f / 3)^2 pixels.
        assert (depth < 3.9).sum() == pytest.approx(np.pi * (0.1 * lens.fx) ** 2, rel=0.15)
        assert np.allclose(depth[depth > 3.1], 4.0, atol=1e-5)
    assert not DepthRenderer(World((), (), FLAT), lens, pose).depth(0.0).any()
