"""Ray casting of a world of analytic shapes, at any instant, through any pinhole with any lens.

What does not move is cast, textured, lit and shadowed once per camera and kept; a frame then costs only
the rays within the moving parts' bounds. Shading is Lambert under a soft light and a sky-to-ground
ambient term: it depends on the surface point alone, never on the viewer.

An effect may hang a gloss, a shadower or a veil on the world (camera_node.synthetic.effects); where none
hangs, none of it is computed.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.lighting import Gloss, Light, Lit, Shadower, Veil, gleam, shade
from camera_node.synthetic.placement import Mover, Part, Placed, place, place_still
from camera_node.synthetic.shapes import Array, nearest_hit
from camera_node.synthetic.textures import Colour
from freshfield.geometry import Pinhole, world_rays

Image = NDArray[np.uint8]
Rows = tuple[int, int]  # of an image: the first, and the one after the last

# Shadow rays stop this share short of the surface they light, so that it does not shadow itself.
SHADOW_BIAS = 2e-3


@dataclass(frozen=True)
class World:
    """Everything that can be seen, without cameras."""

    statics: tuple[Part, ...]
    movers: tuple[Mover, ...]
    light: Light
    background: Colour = (0.0, 0.0, 0.0)
    gloss: Gloss | None = None
    shadower: Shadower | None = None
    veil: Veil | None = None


def cast(origin: Array, directions: Array, placed: Placed, limit: Array) -> tuple[Array, NDArray[np.int16]]:
    """Nearest hits of unit rays from one origin (3,) along directions (3, N) within ``limit`` (N,).

    Returns distances (N,), equal to ``limit`` where nothing nearer was met, and part numbers (N,), -1
    there. Each part is tried only on the rays within the cone around its bounding sphere, which holds
    for any lens and needs no projection.
    """
    t = limit.copy()
    which = np.full(directions.shape[1], -1, dtype=np.int16)
    for k, part in enumerate(placed.parts):
        chosen = rays_within(origin, directions, placed.centres[k], placed.radii[k])
        if not chosen.size:
            continue
        inverse = placed.inverse[k]
        local_origin = (inverse @ (origin - placed.matrices[k, :3, 3]))[:, None]
        found = nearest_hit(part.shape, local_origin, inverse @ directions[:, chosen])
        nearer = found < t[chosen]
        at = chosen[nearer]
        t[at] = found[nearer]
        which[at] = k
    return t, which


def rays_within(origin: Array, directions: Array, centre: Array, radius: float) -> NDArray[np.intp]:
    """Numbers of the rays that can meet the sphere: all, where the origin is inside it."""
    to = centre - origin
    tangent2 = float(to @ to) - radius * radius
    if tangent2 <= 0.0:
        return np.arange(directions.shape[1])
    return np.flatnonzero(to @ directions >= np.sqrt(tangent2))


def surfaces(placed: Placed, which: NDArray[np.int16], points: Array, rays: Array) -> tuple[Array, Array]:
    """Albedo (3, N) and unit normals (3, N), turned against the rays (3, N), of world points (3, N) on the
    parts numbered ``which`` (N,)."""
    albedo, normals = np.empty_like(points), np.empty_like(points)
    for k in np.unique(which):
        of = np.flatnonzero(which == k)
        inverse = placed.inverse[k]
        local = inverse @ (points[:, of] - placed.matrices[k, :3, 3:])
        normal, uv = placed.parts[k].shape.surface(local)
        normals[:, of] = inverse.T @ normal
        albedo[:, of] = placed.parts[k].texture(uv)
    along = (normals * rays).sum(axis=0)
    # Seen from inside (a camera within a shape), the surface faces the other way.
    normals *= np.where(along > 0.0, -1.0, 1.0) / np.sqrt((normals * normals).sum(axis=0))
    return albedo, normals


def light_visibility(world: World, points: Array) -> Array:
    """(S, N): 1 where a static surface point sees a light point, else 0. Rays start at the light, so
    that they share an origin and each part is tried on few of them."""
    casters = place_still([p for p in world.statics if p.casts_shadow])
    out = np.ones((len(world.light.points), points.shape[1]))
    for k, source in enumerate(world.light.points):
        ray = points - source[:, None]
        distance = np.sqrt((ray * ray).sum(axis=0))
        limit = distance * (1.0 - SHADOW_BIAS)
        _, hit = cast(source, ray / np.maximum(distance, 1e-12), casters, limit)
        out[k] = hit < 0
    return out


class CameraRenderer:
    """Renders one camera of a world; holds what does not change between frames.

    supersample: every pixel is the mean of supersample x supersample rays.
    """

    def __init__(self, world: World, camera: Pinhole, camera_to_world: Array, supersample: int = 1) -> None:
        self.world, self.supersample = world, supersample
        self.camera = camera
        self.width, self.height = camera.width, camera.height
        fine = camera.scaled(supersample) if supersample > 1 else camera
        self._shape = (fine.height, fine.width)
        self._origin, directions = world_rays(fine, camera_to_world)
        self._directions = np.ascontiguousarray(directions.reshape(-1, 3).T)
        self._bake()
        self._still = self._to_image(self._veiled(self._colour, self._clear))

    def of(self, world: World) -> CameraRenderer:
        """A renderer of ``world``, which differs from this one's in how its parts move and in nothing else:
        what stands still is not rendered again."""
        other = copy.copy(self)
        other.world = world
        return other

    def image(self, t_s: float, rows: Rows | None = None) -> Image:
        """The view at an instant, or only some of its rows: uint8 RGB (height or rows, width, 3). Equal
        instants give equal bytes."""
        first, stop = (0, self.height) if rows is None else rows
        if not self.world.movers:
            return self._still[first:stop].copy()
        per_row = self.supersample * self._shape[1]
        low, high = first * per_row, stop * per_row
        colour = self._colour[low:high].copy()
        limit = self._t[low:high]
        clear = None if self._clear is None else self._clear[low:high].copy()
        there = [place(mover.parts, mover.matrices(t_s)) for mover in self.world.movers]
        if self.world.shadower is not None:
            self._shadow(self.world.shadower, there, colour, low)
        for mover, placed in zip(self.world.movers, there):  # before any of them hides the floor
            self._contact(mover, placed, colour, low)
        for placed in there:
            limit = self._draw(placed, colour, limit, clear, low, there)
        return self._to_image(self._veiled(colour, clear))

    def distance(self) -> Array:
        """Distance (height', width') along each ray to the static scene, inf where there is none, at the
        supersampled resolution."""
        return self._t.reshape(self._shape)

    def _bake(self) -> None:
        world, rays = self.world, self._directions
        n = rays.shape[1]
        placed = place_still(world.statics)
        self._t, which = cast(self._origin, rays, placed, np.full(n, np.inf))
        self._colour = np.empty((n, 3), dtype=np.float32)
        self._colour[:] = world.background
        hit = np.flatnonzero(which >= 0)
        points = self._origin[:, None] + self._t[hit] * rays[:, hit]
        albedo, normals = surfaces(placed, which[hit], points, rays[:, hit])
        visible = light_visibility(world, points)
        colour = shade(world.light, albedo, points, normals, visible)
        colour += albedo * np.array([p.glow for p in world.statics] or [0.0])[which[hit]]
        if world.gloss is not None or world.shadower is not None:
            lit = Lit(points, albedo, normals, rays[:, hit], visible)
            if world.gloss is not None:
                colour += gleam(world.light, world.gloss, lit)
            if world.shadower is not None and world.movers:
                self._hit, self._lit = hit, lit
        self._colour[hit] = colour.T
        self._clear = None if world.veil is None else world.veil.clear(self._t)
        takes = np.array([p.takes_contact for p in world.statics] or [False])
        on_floor = takes[which[hit]] & (normals[2] > 0.5)
        self._floor = hit[on_floor]
        self._floor_points = np.ascontiguousarray(points[:, on_floor])

    def _contact(self, mover: Mover, placed: Placed, colour: NDArray[np.float32], low: int) -> None:
        """Darken the floor by the share of its sky that each ball covers, r^2 cos / d^2."""
        if not mover.contact:
            return
        part = slice(*np.searchsorted(self._floor, (low, low + len(colour))))
        floor, points = self._floor[part], self._floor_points[:, part]
        if not floor.size:
            return
        balls = np.array([[*placed.matrices[k, :3, 3], r] for k, r in mover.contact])
        middle, reach = balls[:, :2].mean(axis=0), 0.8
        dx, dy = points[0] - middle[0], points[1] - middle[1]
        away2 = (dx * dx + dy * dy) / reach**2
        near = np.flatnonzero(away2 < 1.0)
        if not near.size:
            return
        p = points[:, near]
        covered = np.zeros(near.size)
        for x, y, z, r in balls:
            # A ball half sunk in the floor would cover more than all of it: lift it to rest on it.
            h = np.maximum(z - p[2], r)
            d2 = (p[0] - x) ** 2 + (p[1] - y) ** 2 + h * h
            covered += r * r * h / (d2 * np.sqrt(d2))
        # The window makes the truncation at ``reach`` invisible.
        shadow = np.minimum(covered, 0.75) * (1.0 - away2[near])
        colour[floor[near] - low] *= (1.0 - shadow).astype(np.float32)[:, None]

    def _shadow(
        self, shadower: Shadower, there: Sequence[Placed], colour: NDArray[np.float32], low: int
    ) -> None:
        """Take from what stands still the light that moving parts keep from it."""
        part = slice(*np.searchsorted(self._hit, (low, low + len(colour))))
        lost = shadower.darken(self._lit.part(part), self.world.light, there, self.world.gloss)
        at = self._hit[part] - low
        colour[at] = np.maximum(colour[at] - lost.T, 0.0)

    def _draw(
        self,
        placed: Placed,
        colour: NDArray[np.float32],
        limit: Array,
        clear: NDArray[np.float32] | None,
        low: int,
        there: Sequence[Placed],
    ) -> Array:
        """Draw one mover over ``colour`` (N, 3), the rays from number ``low`` on; returns how far each ray
        is free now (N,)."""
        directions = self._directions[:, low : low + len(colour)]
        centre = placed.centres.mean(axis=0)
        radius = float((np.linalg.norm(placed.centres - centre, axis=1) + placed.radii).max())
        chosen = rays_within(self._origin, directions, centre, radius)
        if not chosen.size:
            return limit
        rays = directions[:, chosen]
        t, which = cast(self._origin, rays, placed, limit[chosen])
        hit = np.flatnonzero(which >= 0)
        rays = rays[:, hit]
        points = self._origin[:, None] + t[hit] * rays
        albedo, normals = surfaces(placed, which[hit], points, rays)
        at = chosen[hit]
        colour[at] = self._shaded_mover(albedo, points, normals, rays, there).T
        if clear is not None and self.world.veil is not None:
            clear[at] = self.world.veil.clear(t[hit])
        if len(self.world.movers) > 1:  # the next mover may pass in front or behind
            limit = limit.copy()
            limit[at] = t[hit]
        return limit

    def _shaded_mover(
        self, albedo: Array, points: Array, normals: Array, rays: Array, there: Sequence[Placed]
    ) -> Array:
        world, light = self.world, self.world.light
        if world.shadower is None:  # one unshadowed point at the light's centre
            colour = shade(light, albedo, points, normals)
            if world.gloss is not None:
                seen = np.ones((len(light.points), points.shape[1]))
                colour += gleam(light, world.gloss, Lit(points, albedo, normals, rays, seen))
            return colour
        lit = Lit(points, albedo, normals, rays, light_visibility(world, points))
        colour = shade(light, albedo, points, normals, lit.visible)
        if world.gloss is not None:
            colour += gleam(light, world.gloss, lit)
        return np.maximum(colour - world.shadower.darken(lit, light, there, world.gloss), 0.0)

    def _veiled(self, colour: NDArray[np.float32], clear: NDArray[np.float32] | None) -> NDArray[np.float32]:
        """Colours (N, 3) through the veil: what arrives of them, and airlight for the rest."""
        if clear is None or self.world.veil is None:
            return colour
        air = np.array(self.world.veil.airlight, dtype=np.float32)
        return np.asarray(air + (colour - air) * clear[:, None], dtype=np.float32)

    def _to_image(self, colour: NDArray[np.float32]) -> Image:
        image: NDArray = colour.reshape(-1, self._shape[1], 3)
        if self.supersample > 1:
            size = (self.width, len(image) // self.supersample)
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.convertScaleAbs(np.clip(image, 0.0, 1.0), alpha=255.0), dtype=np.uint8)
