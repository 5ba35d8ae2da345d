"""Ray casting of a world of analytic shapes, at any instant, through any pinhole camera with lens distortion.

Static parts are cast, textured, lit and shadowed once per camera and kept. A frame then costs only the rays
within the moving parts' bounding spheres. Shading is Lambertian under a soft light and a sky-to-ground
ambient term: it depends only on the surface point, not on the viewer.

Effects may add specular reflection, shadows of moving parts and a medium (camera_node.synthetic.effects),
which are computed only then.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.lighting import (
    Light,
    Medium,
    ShadowModel,
    SpecularReflection,
    SurfacePoints,
    Switch,
    contact_shadow,
    shade_diffuse,
    specular_light,
)
from camera_node.synthetic.placement import MovingBody, Part, PlacedParts, place_parts, place_static
from camera_node.synthetic.shapes import nearest_hit
from camera_node.synthetic.textures import Color
from freshfield.geometry import Array, Pinhole, world_rays

Image = NDArray[np.uint8]
Colors = NDArray[np.float32]  # (N, 3), of rays
Rows = tuple[int, int]  # rows of an image: the first, and the one after the last

# Shadow rays end this share of their length before the surface, so that it does not shadow itself.
_SHADOW_BIAS = 2e-3


@dataclass(frozen=True)
class World:
    """Everything that can be seen, without cameras. background: color in [0, 1] of rays that hit nothing.

    specular, shadows, medium, switch: set by effects; see ``lighting``.
    """

    static_parts: tuple[Part, ...]
    moving_bodies: tuple[MovingBody, ...]
    light: Light
    background: Color = (0.0, 0.0, 0.0)
    specular: SpecularReflection | None = None
    shadows: ShadowModel | None = None
    medium: Medium | None = None
    switch: Switch | None = None


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


def blocked(source: Array, rays: Array, distance: Array, casters: PlacedParts) -> NDArray[np.bool_]:
    """Whether the casters hide each point from a light point, (N,).

    source: (3,), the light point. rays: (3, N), from it to the points. distance: (N,), lengths of the rays.
    Because rays start at the light, they share an origin, and each part is tested with few of them.
    """
    far = np.maximum(distance, 1e-12)
    _, hit = cast_rays(source, rays / far, casters, far * (1.0 - _SHADOW_BIAS))
    return hit >= 0


def light_visibility(world: World, points: Array) -> Array:
    """(S, N): 0 if a static part hides the light point from the surface point (3, N), else 1."""
    casters = place_static([p for p in world.static_parts if p.casts_shadow])
    out = np.ones((len(world.light.points), points.shape[1]))
    for k, source in enumerate(world.light.points):
        rays = points - source[:, None]
        out[k] = ~blocked(source, rays, np.sqrt((rays * rays).sum(axis=0)), casters)
    return out


def _switched_off(world: World) -> World:
    """The world with its lamps out, without a switch."""
    light = world.light if world.switch is None else world.switch.without(world.light)
    return replace(world, light=light, switch=None)


class CameraRenderer:
    """Renders one camera of a world, and keeps what does not change between frames.

    camera_to_world: (4, 4).
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
        self._render_static()
        self._static_image = self._to_image(self._through_medium(self._static_colors, self._transmittance))
        self._dim: CameraRenderer | None = None  # renders while lamps are out
        if world.switch is not None:
            self._dim = CameraRenderer(_switched_off(world), camera, camera_to_world, supersample)

    def for_world(self, world: World) -> CameraRenderer:
        """A renderer of ``world``, which may differ from this one's world only in its moving bodies. Static
        parts are not rendered again."""
        other = copy.copy(self)
        other.world = world
        if self._dim is not None:
            other._dim = self._dim.for_world(_switched_off(world))
        return other

    def image(self, t_s: float, rows: Rows | None = None) -> Image:
        """The image at an instant, or only some of its rows: uint8 RGB (height or rows, width, 3). Equal
        instants give equal bytes."""
        if self._dim is not None and self.world.switch is not None and not self.world.switch.on(t_s):
            return self._dim.image(t_s, rows)
        first, stop = (0, self.height) if rows is None else rows
        if not self.world.moving_bodies:
            return self._static_image[first:stop].copy()
        per_row = self.supersample * self._shape[1]
        low, high = first * per_row, stop * per_row
        colors = self._static_colors[low:high].copy()
        limit = self._distance[low:high]
        transmittance = None if self._transmittance is None else self._transmittance[low:high].copy()
        moving = [place_parts(body.parts, body.matrices(t_s)) for body in self.world.moving_bodies]
        if self.world.shadows is not None:
            self._shadow_static(self.world.shadows, moving, colors, low)
        for body, placed in zip(self.world.moving_bodies, moving):  # before one of them hides the floor
            self._darken_floor(body, placed, colors, low)
        for placed in moving:
            limit = self._draw(placed, colors, limit, transmittance, low, moving)
        return self._to_image(self._through_medium(colors, transmittance))

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
        visible = light_visibility(world, points)
        colors = shade_diffuse(world.light, albedo, points, normals, visible)
        colors += albedo * np.array([p.glow for p in world.static_parts] or [0.0])[which[hit]]
        if world.specular is not None or world.shadows is not None:
            surface = SurfacePoints(points, albedo, normals, rays[:, hit], visible)
            if world.specular is not None:
                colors += specular_light(world.light, world.specular, surface)
            if world.shadows is not None and world.moving_bodies:
                self._hit, self._static_surface = hit, surface
        self._static_colors[hit] = colors.T
        self._transmittance = None if world.medium is None else world.medium.transmittance(self._distance)
        takes = np.array([p.takes_contact for p in world.static_parts] or [False])
        on_floor = takes[which[hit]] & (normals[2] > 0.5)
        self._floor = hit[on_floor]
        self._floor_points = np.ascontiguousarray(points[:, on_floor])

    def _darken_floor(self, body: MovingBody, placed: PlacedParts, colors: Colors, low: int) -> None:
        part = slice(*np.searchsorted(self._floor, (low, low + len(colors))))
        near, left = contact_shadow(body, placed, self._floor_points[:, part])
        colors[self._floor[part][near] - low] *= left[:, None]

    def _shadow_static(self, shadows: ShadowModel, moving: Sequence[PlacedParts], colors: Colors, low: int) -> None:
        part = slice(*np.searchsorted(self._hit, (low, low + len(colors))))
        surface = self._static_surface.select(part)
        lost = shadows.blocked_light(surface, self.world.light, moving, self.world.specular)
        at = self._hit[part] - low
        colors[at] = np.maximum(colors[at] - lost.T, 0.0)

    def _draw(
        self,
        placed: PlacedParts,
        colors: Colors,
        limit: Array,
        transmittance: NDArray[np.float32] | None,
        low: int,
        moving: Sequence[PlacedParts],
    ) -> Array:
        """Draw one moving body over ``colors`` (N, 3), those of the rays from index ``low`` on. Returns the
        distance (N,) to the nearest surface so far along each ray."""
        directions = self._directions[:, low : low + len(colors)]
        chosen = rays_near_sphere(self._origin, directions, *placed.bounding_sphere())
        if not chosen.size:
            return limit
        rays = directions[:, chosen]
        t, which = cast_rays(self._origin, rays, placed, limit[chosen])
        hit = np.flatnonzero(which >= 0)
        rays = rays[:, hit]
        points = self._origin[:, None] + t[hit] * rays
        albedo, normals = surface_properties(placed, which[hit], points, rays)
        at = chosen[hit]
        colors[at] = self._shade_moving(albedo, points, normals, rays, moving).T
        if transmittance is not None and self.world.medium is not None:
            transmittance[at] = self.world.medium.transmittance(t[hit])
        if len(self.world.moving_bodies) > 1:  # the next body may pass in front or behind
            limit = limit.copy()
            limit[at] = t[hit]
        return limit

    def _shade_moving(
        self, albedo: Array, points: Array, normals: Array, rays: Array, moving: Sequence[PlacedParts]
    ) -> Array:
        world, light = self.world, self.world.light
        # Without shadows the light is one unshadowed point at its center.
        visible = None if world.shadows is None else light_visibility(world, points)
        colors = shade_diffuse(light, albedo, points, normals, visible)
        if world.specular is None and world.shadows is None:
            return colors
        if visible is None:
            visible = np.ones((len(light.points), points.shape[1]))
        surface = SurfacePoints(points, albedo, normals, rays, visible)
        if world.specular is not None:
            colors += specular_light(light, world.specular, surface)
        if world.shadows is not None:
            colors = np.maximum(colors - world.shadows.blocked_light(surface, light, moving, world.specular), 0.0)
        return colors

    def _through_medium(self, colors: Colors, transmittance: NDArray[np.float32] | None) -> Colors:
        """Colors (N, 3) seen through the medium: attenuated, plus airlight."""
        if transmittance is None or self.world.medium is None:
            return colors
        air = np.array(self.world.medium.airlight, dtype=np.float32)
        return np.asarray(air + (colors - air) * transmittance[:, None], dtype=np.float32)

    def _to_image(self, colors: Colors) -> Image:
        image: NDArray = colors.reshape(-1, self._shape[1], 3)
        if self.supersample > 1:
            size = (self.width, len(image) // self.supersample)
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.convertScaleAbs(np.clip(image, 0.0, 1.0), alpha=255.0), dtype=np.uint8)
