"""Plain references for the analytic shapes: signed distances, and rays marched through them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.shapes import Box, Cylinder, RoundCone, Sphere

Array = NDArray[np.float64]


def signed_distance(shape: object) -> Callable[[Array], Array]:
    """Distance (N,) of points (3, N) to a shape's surface, negative inside (textbook formulae)."""
    if isinstance(shape, Sphere):
        return lambda p: np.linalg.norm(p, axis=0) - shape.radius
    if isinstance(shape, Box):
        return lambda p: _box(np.abs(p) - np.array(shape.half)[:, None])
    if isinstance(shape, Cylinder):
        return lambda p: _box(
            np.stack([np.hypot(p[0], p[1]) - shape.radius, np.abs(p[2]) - shape.half_height])
        )
    if isinstance(shape, RoundCone):
        return lambda p: _round_cone(shape, p)
    raise TypeError(shape)


def _box(q: Array) -> Array:
    return np.linalg.norm(np.maximum(q, 0.0), axis=0) + np.minimum(q.max(axis=0), 0.0)


def _round_cone(s: RoundCone, p: Array) -> Array:
    # The hull of two balls is the union of the balls of interpolated center and radius.
    share = np.linspace(0.0, 1.0, 1001)
    out = np.full(p.shape[1], np.inf)
    for k in share:
        center = np.array([[0.0], [0.0], [k * s.length]])
        out = np.minimum(out, np.linalg.norm(p - center, axis=0) - (s.r0 + k * (s.r1 - s.r0)))
    return out
