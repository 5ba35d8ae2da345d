"""Analytic shapes: where a ray enters and leaves them, their normals and surface coordinates.

Every shape is defined in local axes and placed by a (4, 4) world-from-local matrix, which may scale. Arrays
are component-first, (3, N), so that each component is contiguous. Distances along a ray are in units of its
direction's length, so a linear map preserves them; directions need not be unit vectors.

``interval`` returns (entry, exit), each (N,); a ray that misses has entry = +inf and exit = -inf. All shapes
are convex, so two numbers are enough, and a camera inside a shape sees its far side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from freshfield.geometry import Array

# Least distance (meters) of a hit, so that a ray does not hit the surface on which it starts.
T_MIN = 1e-6
# Replaces zero in a denominator; its reciprocal is finite, so 0 * inf cannot make a NaN.
_TINY = 1e-30


class Shape(Protocol):
    """A convex body in local axes."""

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Entry and exit distances (N,) of rays from origin (3, 1) or (3, N) along direction (3, N)."""
        ...

    def surface(self, points: Array) -> tuple[Array, Array]:
        """Outward unit normals (3, N) and surface coordinates (2, N) of local points on the surface."""
        ...

    def bounding_sphere(self) -> tuple[Array, float]:
        """Center (3,) and radius of a sphere around the shape, local axes."""
        ...


def nearest_hit(shape: Shape, origin: Array, direction: Array) -> Array:
    """Distance (N,) to the first surface in front of the origin; inf if there is none."""
    entry, leave = shape.interval(origin, direction)
    t = np.where(entry > T_MIN, entry, leave)
    return np.where((t > T_MIN) & (entry <= leave), t, np.inf)


def nonzero(x: Array) -> Array:
    """``x`` with zeros replaced by a tiny number of the same sign, to divide by."""
    return np.where(np.abs(x) < _TINY, np.copysign(_TINY, x), x)


def normalize(v: Array) -> Array:
    """Unit vectors (3, N); a zero vector stays zero."""
    return v / np.sqrt(np.maximum(v[0] * v[0] + v[1] * v[1] + v[2] * v[2], _TINY))


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _quadratic(a: Array, half_b: Array, c: Array) -> tuple[Array, Array]:
    """Interval of t with a t^2 + 2 half_b t + c <= 0, for a >= 0; for a = 0, all t or none."""
    disc = half_b * half_b - a * c
    flat = a < _TINY
    root = np.sqrt(np.maximum(disc, 0.0))
    safe = np.where(flat, 1.0, a)
    near, far = (-half_b - root) / safe, (-half_b + root) / safe
    miss = (disc < 0.0) | (flat & (c > 0.0))
    near = np.where(miss, np.inf, np.where(flat, -np.inf, near))
    far = np.where(miss, -np.inf, np.where(flat, np.inf, far))
    return near, far


def _slab(origin: Array, direction: Array, half: float) -> tuple[Array, Array]:
    """Interval between the planes at -half and +half of one axis."""
    inverse = 1.0 / nonzero(direction)
    a, b = (-half - origin) * inverse, (half - origin) * inverse
    return np.minimum(a, b), np.maximum(a, b)


def _intersect(*intervals: tuple[Array, Array]) -> tuple[Array, Array]:
    """Intersection of convex intervals; empty ones become (+inf, -inf)."""
    entry = np.maximum.reduce([i[0] for i in intervals])
    leave = np.minimum.reduce([i[1] for i in intervals])
    empty = entry > leave
    return np.where(empty, np.inf, entry), np.where(empty, -np.inf, leave)


@dataclass(frozen=True)
class Sphere:
    """A ball around the local origin. Surface coordinates: turns about z, and height z / radius."""

    radius: float

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        c = _dot(origin, origin) - self.radius**2
        return _quadratic(_dot(direction, direction), _dot(origin, direction), c)

    def surface(self, points: Array) -> tuple[Array, Array]:
        normal = normalize(points)
        turns = np.arctan2(normal[1], normal[0]) / (2 * np.pi)
        return normal, np.stack([turns, normal[2]])

    def bounding_sphere(self) -> tuple[Array, float]:
        return np.zeros(3), self.radius


@dataclass(frozen=True)
class Box:
    """A box around the local origin. Surface coordinates: the two axes of the face, in meters."""

    half: tuple[float, float, float]

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        return _intersect(*(_slab(origin[k], direction[k], self.half[k]) for k in range(3)))

    def surface(self, points: Array) -> tuple[Array, Array]:
        ratio = np.abs(points) / np.array(self.half)[:, None]
        axis = np.argmax(ratio, axis=0)
        n = points.shape[1]
        normal = np.zeros_like(points)
        normal[axis, np.arange(n)] = np.sign(points[axis, np.arange(n)])
        # The vertical axis, if the face contains it, is the second coordinate.
        u = np.where(axis == 0, points[1], points[0])
        v = np.where(axis == 2, points[1], points[2])
        return normal, np.stack([u, v])

    def bounding_sphere(self) -> tuple[Array, float]:
        return np.zeros(3), float(np.linalg.norm(self.half))


@dataclass(frozen=True)
class Quad:
    """A rectangle in the local plane z = 0, visible from +z only: six make a room whose near walls do not
    hide its inside. Surface coordinates: x and y in meters."""

    half: tuple[float, float]

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        t = -origin[2] / nonzero(direction[2])
        x, y = origin[0] + t * direction[0], origin[1] + t * direction[1]
        seen = (direction[2] < 0.0) & (np.abs(x) <= self.half[0]) & (np.abs(y) <= self.half[1])
        return np.where(seen, t, np.inf), np.where(seen, t, -np.inf)

    def surface(self, points: Array) -> tuple[Array, Array]:
        normal = np.zeros_like(points)
        normal[2] = 1.0
        return normal, points[:2]

    def bounding_sphere(self) -> tuple[Array, float]:
        return np.zeros(3), float(np.hypot(*self.half))


@dataclass(frozen=True)
class Cylinder:
    """A capped cylinder about z. Surface coordinates: turns about z and meters along it; on the caps,
    turns and radius."""

    radius: float
    half_height: float

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        ox, oy, dx, dy = origin[0], origin[1], direction[0], direction[1]
        side = _quadratic(dx * dx + dy * dy, ox * dx + oy * dy, ox * ox + oy * oy - self.radius**2)
        return _intersect(side, _slab(origin[2], direction[2], self.half_height))

    def surface(self, points: Array) -> tuple[Array, Array]:
        x, y, z = points
        rho = np.hypot(x, y)
        cap = np.abs(z) / self.half_height > rho / self.radius
        inverse = np.where(cap, 0.0, 1.0 / np.maximum(rho, _TINY))
        normal = np.stack([x * inverse, y * inverse, np.where(cap, np.sign(z), 0.0)])
        return normal, np.stack([np.arctan2(y, x) / (2 * np.pi), np.where(cap, rho, z)])

    def bounding_sphere(self) -> tuple[Array, float]:
        return np.zeros(3), float(np.hypot(self.radius, self.half_height))


@dataclass(frozen=True)
class RoundCone:
    """The convex hull of a ball of radius r0 at the origin and one of radius r1 at (0, 0, length); a capsule
    if the radii are equal. Surface coordinates: turns about z and meters along it. Raises ValueError unless
    length > |r0 - r1|, because otherwise one ball contains the other.

    The cone between the two tangent circles is quadratic in t; ``_d2`` and ``_along`` place a point
    between those circles (0 < along < d2) or on one of the balls.
    """

    r0: float
    r1: float
    length: float

    def __post_init__(self) -> None:
        if not self.length > abs(self.r0 - self.r1):
            raise ValueError(f"round cone: length {self.length} must exceed |r0 - r1|")

    @property
    def _d2(self) -> float:
        return self.length**2 - (self.r0 - self.r1) ** 2

    def _along(self, z: Array) -> Array:
        return self.length * z - self.r0 * (self.r0 - self.r1)

    def interval(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        length, r0, rr, d2 = self.length, self.r0, self.r0 - self.r1, self._d2
        dd = _dot(direction, direction)
        od, oo = _dot(origin, direction), _dot(origin, origin)
        oz, dz = origin[2], direction[2]
        # The cone through both tangent circles: k2 t^2 + 2 k1 t + k0 = 0.
        k2 = nonzero(d2 * dd - (length * dz) ** 2)
        k1 = d2 * od - length * length * oz * dz + length * dz * rr * r0
        k0 = d2 * oo - (length * oz) ** 2 + 2 * length * oz * rr * r0 - (length * r0) ** 2
        disc = k1 * k1 - k0 * k2
        root = np.sqrt(np.maximum(disc, 0.0))
        entry, leave = np.full_like(k1, np.inf), np.full_like(k1, -np.inf)
        for t in ((-k1 - root) / k2, (-k1 + root) / k2):
            y = self._along(oz + t * dz)
            on = (disc >= 0.0) & (y > 0.0) & (y < d2)
            np.minimum(entry, t, out=entry, where=on)
            np.maximum(leave, t, out=leave, where=on)
        # Each ball counts only on its own side of its tangent circle.
        for ball_d, ball_c, first in (
            (od, oo - r0 * r0, True),
            (od - length * dz, oo - 2 * length * oz + length**2 - self.r1**2, False),
        ):
            disc = ball_d * ball_d - dd * ball_c
            root = np.sqrt(np.maximum(disc, 0.0))
            for t in ((-ball_d - root) / dd, (-ball_d + root) / dd):
                y = self._along(oz + t * dz)
                on = (disc >= 0.0) & ((y <= 0.0) if first else (y >= d2))
                np.minimum(entry, t, out=entry, where=on)
                np.maximum(leave, t, out=leave, where=on)
        return entry, leave

    def surface(self, points: Array) -> tuple[Array, Array]:
        x, y, z = points
        along, d2 = self._along(z), self._d2
        body = (along > 0.0) & (along < d2)
        center = np.where(along >= d2, self.length, 0.0)
        normal = np.stack([x, y, np.where(body, z - self.length * along / d2, z - center)])
        return normalize(normal), np.stack([np.arctan2(y, x) / (2 * np.pi), z])

    def bounding_sphere(self) -> tuple[Array, float]:
        low, high = -self.r0, self.length + self.r1
        low, high = min(low, self.length - self.r1), max(high, self.r0)
        radius = max(0.5 * (high - low), self.r0, self.r1)
        return np.array([0.0, 0.0, 0.5 * (low + high)]), radius
