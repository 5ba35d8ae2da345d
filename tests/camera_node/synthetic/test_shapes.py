"""Ray intersection against signed distances, and the cases that divide by zero."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from camera_node.synthetic.shapes import Box, Cylinder, Quad, RoundCone, Sphere, capsule, nearest_hit
from freshfield.geometry import Array

SHAPES = [
    Sphere(0.7),
    Box((0.5, 0.2, 0.9)),
    Cylinder(0.4, 0.6),
    RoundCone(0.5, 0.2, 1.1),
    RoundCone(0.15, 0.45, 0.8),
    capsule(0.3, 0.9),
]
# Their surfaces, edges, corners and axes lie on the grid of origins below.
STRESSED = [
    Sphere(0.5),
    Box((0.5, 0.3, 0.7)),
    Cylinder(0.4, 0.6),
    RoundCone(0.4, 0.1, 0.9),
    RoundCone(0.2, 0.4, 0.3),
    capsule(0.3, 0.6),
    Quad((0.5, 0.5)),
]
AXES = np.concatenate([np.eye(3), -np.eye(3)]).T
TOLERANCE = 1e-9


def signed_distance(shape: object) -> Callable[[Array], Array]:
    """Distance (N,) of points (3, N) to a shape's surface, negative inside (textbook formulae)."""
    if isinstance(shape, Sphere):
        return lambda p: np.linalg.norm(p, axis=0) - shape.radius
    if isinstance(shape, Box):
        return lambda p: _box(np.abs(p) - np.array(shape.half)[:, None])
    if isinstance(shape, Cylinder):
        return lambda p: _box(np.stack([np.hypot(p[0], p[1]) - shape.radius, np.abs(p[2]) - shape.half_height]))
    if isinstance(shape, RoundCone):
        return lambda p: _round_cone(shape, p)
    raise TypeError(shape)


def _box(q: Array) -> Array:
    return np.linalg.norm(np.maximum(q, 0.0), axis=0) + np.minimum(q.max(axis=0), 0.0)


def _round_cone(s: RoundCone, p: Array) -> Array:
    """Quilez' formula: a ball at either end, and between them the cone that touches both."""
    rho, slope = np.hypot(p[0], p[1]), (s.r0 - s.r1) / s.length
    rise = np.sqrt(1.0 - slope**2)
    along = rise * p[2] - slope * rho
    first, second = np.hypot(rho, p[2]) - s.r0, np.hypot(rho, p[2] - s.length) - s.r1
    return np.where(along < 0.0, first, np.where(along > rise * s.length, second, rise * rho + slope * p[2] - s.r0))


def directions(rng: np.random.Generator, n: int) -> np.ndarray:
    d = rng.standard_normal((3, n))
    return d / np.linalg.norm(d, axis=0)


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_hits_lie_on_the_surface_and_nothing_lies_before_them(shape):
    rng = np.random.default_rng(1)
    sdf = signed_distance(shape)
    origin = np.array([[1.7], [-1.1], [0.9]])
    # Aim near the shape so that both hits and misses are frequent.
    aim = rng.uniform(-1.2, 1.2, (3, 400)) - origin
    d = aim / np.linalg.norm(aim, axis=0)
    t = nearest_hit(shape, origin, d)
    hit = np.isfinite(t)
    assert 40 < hit.sum() < 360
    assert np.abs(sdf(origin + t[hit] * d[:, hit])).max() < TOLERANCE
    for share in np.linspace(0.0, 0.999, 12):
        assert sdf(origin + share * t[hit] * d[:, hit]).min() > -TOLERANCE
    for distance in np.linspace(0.0, 4.0, 60):
        assert sdf(origin + distance * d[:, ~hit]).min() > -TOLERANCE


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_normals_are_the_gradient_of_the_distance(shape):
    rng = np.random.default_rng(3)
    origin = np.array([[0.01], [0.02], [0.03]])
    d = directions(rng, 200)
    p = origin + nearest_hit(shape, origin, d) * d
    normal, uv = shape.surface(p)
    assert np.isfinite(uv).all()
    sdf, h = signed_distance(shape), 1e-4
    gradient = np.stack([sdf(p + h * e[:, None]) - sdf(p - h * e[:, None]) for e in np.eye(3)]) / (2 * h)
    cosine = (normal * gradient).sum(axis=0) / np.linalg.norm(gradient, axis=0)
    assert np.allclose(np.linalg.norm(normal, axis=0), 1.0)
    # Near an edge of a box or cylinder the difference straddles two faces.
    assert np.quantile(cosine, 0.03) > 0.999


def test_quad_is_seen_from_its_front_only():
    quad = Quad((1.0, 1.0))
    down, up = np.array([[0.0], [0.0], [-1.0]]), np.array([[0.0], [0.0], [1.0]])
    assert nearest_hit(quad, np.array([[0.0], [0.0], [2.0]]), down)[0] == pytest.approx(2.0)
    assert np.isinf(nearest_hit(quad, np.array([[0.0], [0.0], [-2.0]]), up)[0])
    assert np.isinf(nearest_hit(quad, np.array([[1.5], [0.0], [2.0]]), down)[0])


def test_a_round_cone_that_is_only_a_ball_is_refused():
    with pytest.raises(ValueError, match="must exceed"):
        RoundCone(0.5, 0.1, 0.3)


@pytest.mark.stability
@pytest.mark.parametrize("shape", STRESSED, ids=repr)
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


@pytest.mark.stability
def test_a_ray_does_not_meet_the_surface_it_starts_on():
    for shape, at in ((Sphere(0.5), [0.5, 0, 0]), (Box((0.5, 0.3, 0.7)), [0.5, 0, 0])):
        origin = np.array(at, dtype=float)[:, None]
        assert np.isinf(nearest_hit(shape, origin, np.array([[1.0], [0.0], [0.0]])))[0]
        across = nearest_hit(shape, origin, np.array([[-1.0], [0.0], [0.0]]))
        assert across[0] == pytest.approx(1.0)
