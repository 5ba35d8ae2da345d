"""Ray intersection against signed distances, and the cases that divide by zero."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from camera_node.synthetic.shapes import Box, Cylinder, Quad, RoundCone, Sphere, capsule, nearest_hit
from freshfield.geometry import Array

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
