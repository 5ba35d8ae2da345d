"""Ray casting of a world of analytic shapes, at any instant, through any pinhole camera with lens distortion.

Static parts are cast, textured, lit and shadowed once per camera and kept. A frame then costs only the rays
within the moving parts' bounding spheres. Shading is Lambertian under a soft light and a sky-to-ground
ambient term: it depends only on the surface point, not on the viewer.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.lighting import Light, contact_shadow, shade_diffuse
from camera_node.synthetic.placement import MovingBody, Part, PlacedParts, place_parts, place_static
from camera_node.synthetic.shapes import nearest_hit
from camera_node.synthetic.synthetic_constants import SHADOW_BIAS
from camera_node.synthetic.textures import Color
from freshfield.geometry import Array, Pinhole, world_rays

Image = NDArray[np.uint8]
Colors = NDArray[np.float32]  # (N, 3), of rays


@dataclass(frozen=True)
class World:
    """Everything that can be seen, without cameras. background: color in [0, 1] of rays that hit nothing."""

    static_parts: tuple[Part, ...]
    moving_bodies: tuple[MovingBody, ...]
    light: Light
    background: Color = (0.0, 0.0, 0.0)


def cast_rays(origin: Array, directions: Array, placed: PlacedParts, limit: Array) -> tuple[Array, NDArray[np.int16]]:
    """Nearest hits of unit rays from one origin (3,) along directions (3, N) within distances ``limit`` (N,).

    Returns distances (N,) and part indices (N,); a ray without a hit has its ``limit`` and -1. Each part is
    tested only with the rays in the cone around its bounding sphere, which works for any lens and needs no
    projection.
    """
    t = limit.copy()
    which = np.full(directions.shape[1], -1, dtype=np.int16)
    for k, part in enumerate(placed.parts):
        chosen = rays_near_sphere(origin, directions, placed.centers[k], placed.radii[k])
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


def rays_near_sphere(origin: Array, directions: Array, center: Array, radius: float) -> NDArray[np.intp]:
    """Indices of the unit rays (3, N) that can hit the sphere; all, if the origin (3,) is inside it."""
    to = center - origin
    tangent2 = float(to @ to) - radius * radius
    if tangent2 <= 0.0:
        return np.arange(directions.shape[1])
    return np.flatnonzero(to @ directions >= np.sqrt(tangent2))


def surface_properties(
    placed: PlacedParts, which: NDArray[np.int16], points: Array, rays: Array
) -> tuple[Array, Array]:
    """Albedo (3, N) and unit normals (3, N) of surface points.

    which: (N,), index of the part that each point is on.
    points, rays: (3, N), in world axes; normals are turned to face against the rays.
    """
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
    """(S, N): 0 if a static part hides the light point from the surface point (3, N), else 1. Rays start at the light:
    they share an origin, and each part is tested with few of them."""
    casters = place_static([p for p in world.static_parts if p.casts_shadow])
    out = np.ones((len(world.light.points), points.shape[1]))
    for k, source in enumerate(world.light.points):
        rays = points - source[:, None]
        distance = np.maximum(np.sqrt((rays * rays).sum(axis=0)), 1e-12)
        out[k] = cast_rays(source, rays / distance, casters, distance * (1.0 - SHADOW_BIAS))[1] < 0
    return out


class CameraRenderer:
    """Renders one camera of a world, and keeps what does not change between frames.

    camera_to_world: (4, 4).
    supersample: every pixel is the mean of supersample x supersample rays.
    """

    def __init__(self, world: World, camera: Pinhole, camera_to_world: Array, supersample: int = 1) -> None:
        self.world, self.supersample = world, supersample
        self._width = camera.width
        fine = camera.scaled(supersample) if supersample > 1 else camera
        self._shape = (fine.height, fine.width)
        self._origin, directions = world_rays(fine, camera_to_world)
        self._directions = np.ascontiguousarray(directions.reshape(-1, 3).T)
        self._render_static()
        self._static_image = self._to_image(self._static_colors)

    def for_world(self, world: World) -> CameraRenderer:
        """A renderer of ``world``, which may differ from this one's world only in its moving bodies. Static
        parts are not rendered again."""
        other = copy.copy(self)
        other.world = world
        return other

    def image(self, t_s: float) -> Image:
        """The image at an instant: uint8 RGB (height, width, 3). Equal instants give equal bytes."""
        if not self.world.moving_bodies:
            return self._static_image.copy()
        colors, limit = self._static_colors.copy(), self._distance
        moving = [place_parts(body.parts, body.matrices(t_s)) for body in self.world.moving_bodies]
        for body, placed in zip(self.world.moving_bodies, moving):  # before one of them hides the floor
            near, left = contact_shadow(body, placed, self._floor_points)
            colors[self._floor[near]] *= left[:, None]
        for placed in moving:
            limit = self._draw(placed, colors, limit)
        return self._to_image(colors)

    def distance(self) -> Array:
        """Distance along each ray to the nearest static part, inf without one, at the supersampled
        resolution: (height * supersample, width * supersample)."""
        return self._distance.reshape(self._shape)

    def _render_static(self) -> None:
        world, rays = self.world, self._directions
        n = rays.shape[1]
        placed = place_static(world.static_parts)
        self._distance, which = cast_rays(self._origin, rays, placed, np.full(n, np.inf))
        self._static_colors = np.empty((n, 3), dtype=np.float32)
        self._static_colors[:] = world.background
        hit = np.flatnonzero(which >= 0)
        points = self._origin[:, None] + self._distance[hit] * rays[:, hit]
        albedo, normals = surface_properties(placed, which[hit], points, rays[:, hit])
        colors = shade_diffuse(world.light, albedo, points, normals, light_visibility(world, points))
        colors += albedo * np.array([p.glow for p in world.static_parts] or [0.0])[which[hit]]
        self._static_colors[hit] = colors.T
        takes = np.array([p.takes_contact for p in world.static_parts] or [False])
        on_floor = takes[which[hit]] & (normals[2] > 0.5)
        self._floor = hit[on_floor]
        self._floor_points = np.ascontiguousarray(points[:, on_floor])

    def _draw(self, placed: PlacedParts, colors: Colors, limit: Array) -> Array:
        """Draw one moving body over ``colors`` (N, 3) of all rays. Returns the distance (N,) to the nearest surface
        so far along each ray."""
        chosen = rays_near_sphere(self._origin, self._directions, *placed.bounding_sphere())
        if not chosen.size:
            return limit
        rays = self._directions[:, chosen]
        t, which = cast_rays(self._origin, rays, placed, limit[chosen])
        hit = np.flatnonzero(which >= 0)
        rays = rays[:, hit]
        points = self._origin[:, None] + t[hit] * rays
        albedo, normals = surface_properties(placed, which[hit], points, rays)
        at = chosen[hit]
        # No shadows fall on moving parts: for them the light is one point at its center.
        colors[at] = shade_diffuse(self.world.light, albedo, points, normals).T
        if len(self.world.moving_bodies) > 1:  # the next body may pass in front or behind
            limit = limit.copy()
            limit[at] = t[hit]
        return limit

    def _to_image(self, colors: Colors) -> Image:
        image: NDArray = colors.reshape(-1, self._shape[1], 3)
        if self.supersample > 1:
            size = (self._width, len(image) // self.supersample)
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.convertScaleAbs(np.clip(image, 0.0, 1.0), alpha=255.0), dtype=np.uint8)
