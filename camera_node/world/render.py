"""Ray casting of a world of analytic shapes, at any instant, through any pinhole with any lens.

What does not move is cast, textured, lit and shadowed once per camera and kept; a frame then costs only
the rays within the moving parts' bounds. Shading is Lambert under a soft light and a sky-to-ground
ambient term: it depends on the surface point alone, never on the viewer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.world.shapes import Array, Shape, nearest_hit
from camera_node.world.textures import Colour, Texture
from freshfield.geometry import Pinhole, world_rays

Image = NDArray[np.uint8]

# Shadow rays stop this share short of the surface they light, so that it does not shadow itself.
_SHADOW_BIAS = 2e-3


@dataclass(frozen=True)
class Part:
    """A shape with its texture and, for a part that does not move, its world-from-local matrix (4, 4)."""

    shape: Shape
    texture: Texture
    matrix: Array = field(default_factory=lambda: np.eye(4))
    casts_shadow: bool = True
    takes_contact: bool = False  # darkened beneath moving parts (floors, rugs)
    glow: float = 0.0  # share of the albedo that shines of itself (lamps)


@dataclass(frozen=True)
class Mover:
    """Parts that move together: ``matrices(t_s)`` gives their world-from-local matrices (M, 4, 4), which
    may scale. ``contact`` lists the parts (index, radius in metres) that darken the floor beneath."""

    parts: tuple[Part, ...]
    matrices: Callable[[float], Array]
    contact: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True)
class Light:
    """A soft overhead light (points (S, 3), each visible or not) and an ambient term from below to above."""

    points: Array
    strength: float
    reach_m: float
    low: Colour
    high: Colour
    tint: Colour = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class World:
    """Everything that can be seen, without cameras."""

    statics: tuple[Part, ...]
    movers: tuple[Mover, ...]
    light: Light
    background: Colour = (0.0, 0.0, 0.0)


def cast(
    origin: Array, directions: Array, parts: Sequence[Part], matrices: Array, limit: Array
) -> tuple[Array, NDArray[np.int16]]:
    """Nearest hits of unit rays from one origin (3,) along directions (3, N) within ``limit`` (N,).

    Returns distances (N,), equal to ``limit`` where nothing nearer was met, and part numbers (N,), -1
    there. Each part is tried only on the rays within the cone around its bounding sphere, which holds
    for any lens and needs no projection.
    """
    t = limit.copy()
    which = np.full(directions.shape[1], -1, dtype=np.int16)
    inverse = np.linalg.inv(matrices[:, :3, :3])
    for k, part in enumerate(parts):
        centre, radius = _world_sphere(part.shape, matrices[k])
        chosen = rays_within(origin, directions, centre, radius)
        if chosen is not None and chosen.size == 0:
            continue
        d = directions if chosen is None else directions[:, chosen]
        local_origin = (inverse[k] @ (origin - matrices[k, :3, 3]))[:, None]
        found = nearest_hit(part.shape, local_origin, inverse[k] @ d)
        nearer = found < (t if chosen is None else t[chosen])
        at = np.flatnonzero(nearer) if chosen is None else chosen[nearer]
        t[at] = found[nearer]
        which[at] = k
    return t, which


def rays_within(origin: Array, directions: Array, centre: Array, radius: float) -> NDArray[np.intp] | None:
    """Numbers of the rays that can meet the sphere; None for all, where the origin is inside it."""
    to = centre - origin
    distance2, radius2 = float(to @ to), radius * radius
    if distance2 <= radius2:
        return None
    return np.flatnonzero(to @ directions >= np.sqrt(distance2 - radius2))


def _world_sphere(shape: Shape, matrix: Array) -> tuple[Array, float]:
    centre, radius = shape.bounding_sphere()
    # The columns of rotation times scale are orthogonal, so the longest is the largest stretch.
    stretch = float(np.sqrt((matrix[:3, :3] ** 2).sum(axis=0).max()))
    return matrix[:3, :3] @ centre + matrix[:3, 3], radius * stretch


def surface_at(part: Part, matrix: Array, points: Array, towards: Array) -> tuple[Array, Array]:
    """Albedo (3, N) and unit normals (3, N), turned against ``towards`` (3, N), of world points (3, N)."""
    inverse = np.linalg.inv(matrix[:3, :3])
    normal, uv = part.shape.surface(inverse @ (points - matrix[:3, 3:]))
    normal = inverse.T @ normal
    normal *= 1.0 / np.sqrt((normal * normal).sum(axis=0))
    # Seen from inside (a camera within a shape), the surface faces the other way.
    normal *= np.where((normal * towards).sum(axis=0) > 0.0, -1.0, 1.0)
    return part.texture(uv), normal


def shade(light: Light, albedo: Array, points: Array, normals: Array, visible: Array | None = None) -> Array:
    """Colours (3, N). ``visible`` (S, N) says which light points each surface point sees; without it the
    light is one unshadowed point at its centre."""
    low, high = np.array(light.low)[:, None], np.array(light.high)[:, None]
    energy = low + (high - low) * (0.5 + 0.5 * normals[2])
    sources = light.points if visible is not None else light.points.mean(axis=0, keepdims=True)
    direct = np.zeros(points.shape[1])
    for k, source in enumerate(sources):
        term = _lambert(source, light.reach_m, points, normals)
        direct += term if visible is None else term * visible[k]
    return albedo * (energy + np.array(light.tint)[:, None] * (light.strength / len(sources)) * direct)


def _lambert(source: Array, reach_m: float, points: Array, normals: Array) -> Array:
    to = source[:, None] - points
    distance2 = (to * to).sum(axis=0)
    cosine = np.maximum((to * normals).sum(axis=0), 0.0) / np.sqrt(np.maximum(distance2, 1e-12))
    # Gentler than the inverse square: a room lit by its walls as well has no black corners.
    return cosine / (1.0 + distance2 / (reach_m * reach_m))


def light_visibility(world: World, points: Array) -> Array:
    """(S, N): 1 where a static surface point sees a light point, else 0. Rays start at the light, so
    that they share an origin and each part is tried on few of them."""
    casters = [p for p in world.statics if p.casts_shadow]
    matrices = np.stack([p.matrix for p in casters]) if casters else np.zeros((0, 4, 4))
    out = np.ones((len(world.light.points), points.shape[1]))
    for k, source in enumerate(world.light.points):
        ray = points - source[:, None]
        distance = np.sqrt((ray * ray).sum(axis=0))
        limit = distance * (1.0 - _SHADOW_BIAS)
        _, hit = cast(source, ray / np.maximum(distance, 1e-12), casters, matrices, limit)
        out[k] = hit < 0
    return out


class CameraRenderer:
    """Renders one camera of a world; holds what does not change between frames.

    supersample: every pixel is the mean of supersample x supersample rays.
    """

    def __init__(self, world: World, camera: Pinhole, camera_to_world: Array, supersample: int = 1) -> None:
        self.world, self.supersample = world, supersample
        self.width, self.height = camera.width, camera.height
        fine = camera.scaled(supersample) if supersample > 1 else camera
        self._shape = (fine.height, fine.width)
        self._origin, directions = world_rays(fine, camera_to_world)
        self._directions = np.ascontiguousarray(directions.reshape(-1, 3).T)
        self._bake()
        self._still = self._to_image(self._colour)

    def image(self, t_s: float) -> Image:
        """The view at an instant: uint8 RGB (height, width, 3). Equal instants give equal bytes."""
        if not self.world.movers:
            return self._still.copy()
        colour = self._colour.copy()
        depth: Array | None = None
        for mover in self.world.movers:
            matrices = mover.matrices(t_s)
            self._contact(mover, matrices, colour)
            depth = self._draw(mover, matrices, colour, depth)
        return self._to_image(colour)

    def distance(self) -> Array:
        """Distance (height', width') along each ray to the static scene, inf where there is none, at the
        supersampled resolution."""
        return self._t.reshape(self._shape)

    def _bake(self) -> None:
        world, rays = self.world, self._directions
        n = rays.shape[1]
        matrices = np.stack([p.matrix for p in world.statics]) if world.statics else np.zeros((0, 4, 4))
        self._t, which = cast(self._origin, rays, world.statics, matrices, np.full(n, np.inf))
        self._colour = np.empty((n, 3), dtype=np.float32)
        self._colour[:] = world.background
        hit = np.flatnonzero(which >= 0)
        points = self._origin[:, None] + self._t[hit] * rays[:, hit]
        albedo, normals = np.empty_like(points), np.empty_like(points)
        for k, part in enumerate(world.statics):
            of = np.flatnonzero(which[hit] == k)
            if of.size:
                albedo[:, of], normals[:, of] = surface_at(part, part.matrix, points[:, of], rays[:, hit[of]])
        visible = light_visibility(world, points)
        colour = shade(world.light, albedo, points, normals, visible)
        colour += albedo * np.array([p.glow for p in world.statics] or [0.0])[which[hit]]
        self._colour[hit] = colour.T
        takes = np.array([p.takes_contact for p in world.statics] or [False])
        on_floor = takes[which[hit]] & (normals[2] > 0.5)
        self._floor = hit[on_floor]
        self._floor_points = np.ascontiguousarray(points[:, on_floor])

    def _contact(self, mover: Mover, matrices: Array, colour: NDArray[np.float32]) -> None:
        """Darken the floor by the share of its sky that each ball covers, r^2 cos / d^2."""
        if not mover.contact or not self._floor.size:
            return
        balls = np.array([[*matrices[k, :3, 3], r] for k, r in mover.contact])
        middle, reach = balls[:, :2].mean(axis=0), 0.8
        dx, dy = self._floor_points[0] - middle[0], self._floor_points[1] - middle[1]
        away2 = (dx * dx + dy * dy) / reach**2
        near = np.flatnonzero(away2 < 1.0)
        if not near.size:
            return
        p = self._floor_points[:, near]
        covered = np.zeros(near.size)
        for x, y, z, r in balls:
            # A ball half sunk in the floor would cover more than all of it: lift it to rest on it.
            h = np.maximum(z - p[2], r)
            d2 = (p[0] - x) ** 2 + (p[1] - y) ** 2 + h * h
            covered += r * r * h / (d2 * np.sqrt(d2))
        # The window makes the truncation at ``reach`` invisible.
        shadow = np.minimum(covered, 0.75) * (1.0 - away2[near])
        colour[self._floor[near]] *= (1.0 - shadow).astype(np.float32)[:, None]

    def _draw(
        self, mover: Mover, matrices: Array, colour: NDArray[np.float32], depth: Array | None
    ) -> Array | None:
        spheres = [_world_sphere(p.shape, m) for p, m in zip(mover.parts, matrices)]
        centre = np.mean([c for c, _ in spheres], axis=0)
        radius = max(float(np.linalg.norm(c - centre)) + r for c, r in spheres)
        chosen = rays_within(self._origin, self._directions, centre, radius)
        if chosen is None:
            chosen = np.arange(self._directions.shape[1])
        if not chosen.size:
            return depth
        rays = self._directions[:, chosen]
        limit = (self._t if depth is None else depth)[chosen]
        t, which = cast(self._origin, rays, mover.parts, matrices, limit)
        hit = np.flatnonzero(which >= 0)
        if not hit.size:
            return depth
        rays, number = rays[:, hit], which[hit]
        points = self._origin[:, None] + t[hit] * rays
        albedo, normals = np.empty_like(points), np.empty_like(points)
        for k in np.unique(number):
            of = np.flatnonzero(number == k)
            albedo[:, of], normals[:, of] = surface_at(
                mover.parts[k], matrices[k], points[:, of], rays[:, of]
            )
        at = chosen[hit]
        colour[at] = shade(self.world.light, albedo, points, normals).T
        if len(self.world.movers) > 1:  # the next mover may pass in front or behind
            depth = self._t.copy() if depth is None else depth
            depth[at] = t[hit]
        return depth

    def _to_image(self, colour: NDArray[np.float32]) -> Image:
        image = colour.reshape(*self._shape, 3)
        if self.supersample > 1:
            image = cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_AREA)
        return cv2.convertScaleAbs(np.clip(image, 0.0, 1.0), alpha=255.0)
