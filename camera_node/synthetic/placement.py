"""Parts of a world and their poses: world-from-local matrices (4, 4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from camera_node.synthetic.motion import Vector
from camera_node.synthetic.shapes import Shape
from camera_node.synthetic.textures import Texture
from freshfield.geometry import Array


def at(x: float, y: float, z: float, turn_deg: float = 0.0) -> Array:
    """Pose (4, 4) at a position in meters, turned about the vertical."""
    a = np.deg2rad(turn_deg)
    out = np.eye(4)
    out[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    out[:3, 3] = x, y, z
    return out


def facing(x_axis: Vector, y_axis: Vector, center: Vector) -> Array:
    """Pose (4, 4) with local x and y along these axes, which are orthogonal and of unit length."""
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 3] = x_axis, y_axis, center
    out[:3, 2] = np.cross(x_axis, y_axis)
    return out


@dataclass(frozen=True)
class Part:
    """A shape with its texture and, if it does not move, its world-from-local matrix (4, 4)."""

    shape: Shape
    texture: Texture
    matrix: Array = field(default_factory=lambda: np.eye(4))
    casts_shadow: bool = True
    takes_contact: bool = False  # darkened beneath moving parts (floors, rugs)
    glow: float = 0.0  # share of the albedo that is emitted (lamps)


@dataclass(frozen=True)
class MovingBody:
    """Parts that move together.

    matrices: returns their world-from-local matrices (M, 4, 4), which may scale, at an instant t_s.
    contact: (index, radius in meters) of the parts that darken the floor beneath them.
    """

    parts: tuple[Part, ...]
    matrices: Callable[[float], Array]
    contact: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True)
class PlacedParts:
    """Parts at one instant.

    matrices: (M, 4, 4), world-from-local. inverse: (M, 3, 3), inverses of their linear parts.
    centers, radii: (M, 3) and (M,), bounding spheres in world axes.
    """

    parts: Sequence[Part]
    matrices: Array
    inverse: Array
    centers: Array
    radii: Array

    def bounding_sphere(self) -> tuple[Array, float]:
        """Center (3,) and radius of a sphere around all parts."""
        center = self.centers.mean(axis=0)
        return center, float((np.linalg.norm(self.centers - center, axis=1) + self.radii).max())


def place_parts(parts: Sequence[Part], matrices: Array) -> PlacedParts:
    """Prepare parts with world-from-local ``matrices`` (M, 4, 4) for ray casting."""
    linear = matrices[:, :3, :3]
    spheres = [p.shape.bounding_sphere() for p in parts]
    centers = np.array([c for c, _ in spheres]).reshape(-1, 3, 1)
    # The columns of rotation times scale are orthogonal, so the length of the longest is the largest scale.
    stretch = np.sqrt((linear * linear).sum(axis=1).max(axis=1, initial=0.0))
    return PlacedParts(
        parts,
        matrices,
        np.asarray(np.linalg.inv(linear), dtype=np.float64),
        (linear @ centers)[:, :, 0] + matrices[:, :3, 3],
        np.array([r for _, r in spheres]) * stretch,
    )


def place_static(parts: Sequence[Part]) -> PlacedParts:
    """Prepare parts that do not move for ray casting."""
    return place_parts(parts, np.array([p.matrix for p in parts]).reshape(-1, 4, 4))
