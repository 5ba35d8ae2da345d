"""Light on surfaces: diffuse reflection and contact shadows always, and what effects add or take away.

Effects may give a world a specular reflection, a shadow model and a medium. This file knows only the
protocols that these follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.placement import MovingBody, PlacedParts
from camera_node.synthetic.textures import Color
from freshfield.geometry import Array

# Of contact shadows: distance (meters) from the body's middle at which they end, and their darkest.
_REACH_M, _MOST_DARKENING = 0.8, 0.75


@dataclass(frozen=True)
class Light:
    """A soft overhead light of points (S, 3), each visible or not, and an ambient term from below to above.
    falloff_m: distance at which a point's light has halved."""

    points: Array
    strength: float
    falloff_m: float
    ambient_below: Color
    ambient_above: Color
    tint: Color = (1.0, 1.0, 1.0)

    @property
    def point_color(self) -> Array:
        """Light (3, 1) of one of the points."""
        return np.array(self.tint)[:, None] * (self.strength / len(self.points))


@dataclass(frozen=True)
class SurfacePoints:
    """Points (3, N) of surfaces, their albedo, unit normals and the unit rays that met them (3, N each).
    visible (S, N): 1 where no static part stands between a light point and a surface point, else 0."""

    points: Array
    albedo: Array
    normals: Array
    rays: Array
    visible: Array

    def select(self, chosen: NDArray[np.intp] | slice) -> SurfacePoints:
        fields = (self.points, self.albedo, self.normals, self.rays, self.visible)
        return SurfacePoints(*(values[:, chosen] for values in fields))


class SpecularReflection(Protocol):
    """Light that surfaces reflect towards the viewer beyond the diffuse part."""

    def reflectance(self, to_light: Array, normals: Array, rays: Array) -> Array:
        """Share (N,) of a light's strength that is reflected along -rays (3, N), including the cosine at the
        surface. to_light and normals: unit (3, N)."""
        ...


class Medium(Protocol):
    """A homogeneous medium between surfaces and cameras."""

    @property
    def airlight(self) -> Color:
        """Color of the medium itself, in [0, 1]."""
        ...

    def transmittance(self, distance_m: Array) -> NDArray[np.float32]:
        """Share (N,) of a surface's light that arrives from this distance; 0 from infinity."""
        ...


class ShadowModel(Protocol):
    """Shadows of moving parts."""

    def blocked_light(
        self,
        surface: SurfacePoints,
        light: Light,
        moving: Sequence[PlacedParts],
        specular: SpecularReflection | None,
    ) -> Array:
        """Part of the surface points' colors (3, N) that the moving parts take away."""
        ...


class Switch(Protocol):
    """Lamps that go on and out."""

    def on(self, t_s: float) -> bool:
        """Whether all lamps are on at an instant."""
        ...

    def without(self, light: Light) -> Light:
        """What is left of a light when they are out."""
        ...


def shade_diffuse(
    light: Light, albedo: Array, points: Array, normals: Array, visible: Array | None = None
) -> Array:
    """Colors (3, N) of surface points (3, N) under ambient light and Lambert's law. visible (S, N): see
    SurfacePoints; None replaces the light by one unshadowed point at its center."""
    low, high = np.array(light.ambient_below)[:, None], np.array(light.ambient_above)[:, None]
    ambient = low + (high - low) * (0.5 + 0.5 * normals[2])
    sources = light.points if visible is not None else light.points.mean(axis=0, keepdims=True)
    direct = np.zeros(points.shape[1])
    for k, source in enumerate(sources):
        term = _lambert(source, light.falloff_m, points, normals)
        direct += term if visible is None else term * visible[k]
    return albedo * (ambient + np.array(light.tint)[:, None] * (light.strength / len(sources)) * direct)


def direct_light(
    surface: SurfacePoints, light: Light, source: Array, specular: SpecularReflection | None
) -> Array:
    """Colors (3, N) that one of the light's points (3,) adds to surface points that see it."""
    diffuse = surface.albedo * _lambert(source, light.falloff_m, surface.points, surface.normals)
    if specular is None:
        return light.point_color * diffuse
    return light.point_color * (diffuse + _reflected(specular, source, light.falloff_m, surface))


def specular_light(light: Light, specular: SpecularReflection, surface: SurfacePoints) -> Array:
    """Colors (3, N) that specular reflection of all visible light points adds to surface points."""
    total = np.zeros(surface.points.shape[1])
    for k, source in enumerate(light.points):
        total += _reflected(specular, source, light.falloff_m, surface) * surface.visible[k]
    return light.point_color * total


def _reflected(
    specular: SpecularReflection, source: Array, falloff_m: float, surface: SurfacePoints
) -> Array:
    to = source[:, None] - surface.points
    distance2 = np.maximum((to * to).sum(axis=0), 1e-12)
    share = specular.reflectance(to / np.sqrt(distance2), surface.normals, surface.rays)
    return share / (1.0 + distance2 / (falloff_m * falloff_m))


def _lambert(source: Array, falloff_m: float, points: Array, normals: Array) -> Array:
    to = source[:, None] - points
    distance2 = (to * to).sum(axis=0)
    cosine = np.maximum((to * normals).sum(axis=0), 0.0) / np.sqrt(np.maximum(distance2, 1e-12))
    # Gentler than the inverse square: a room that its walls light as well has no black corners.
    return cosine / (1.0 + distance2 / (falloff_m * falloff_m))


def contact_shadow(
    body: MovingBody, placed: PlacedParts, floor_points: Array
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Which floor points a body darkens, so that it does not seem to float, and the share of their light that
    is left. A point loses the share of its sky that each contact sphere covers, r^2 cos / d^2.

    placed: the body's parts at an instant. floor_points: (3, N). Returns indices (K,) and shares (K,).
    """
    if not body.contact:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.float32)
    spheres = np.array([[*placed.matrices[k, :3, 3], r] for k, r in body.contact])
    middle = spheres[:, :2].mean(axis=0)
    dx, dy = floor_points[0] - middle[0], floor_points[1] - middle[1]
    away2 = (dx * dx + dy * dy) / _REACH_M**2
    near = np.flatnonzero(away2 < 1.0)
    p = floor_points[:, near]
    covered = np.zeros(near.size)
    for x, y, z, r in spheres:
        # A sphere half sunk in the floor would cover more than all of it: lift it to rest on it.
        h = np.maximum(z - p[2], r)
        d2 = (p[0] - x) ** 2 + (p[1] - y) ** 2 + h * h
        covered += r * r * h / (d2 * np.sqrt(d2))
    # The window makes the truncation at the reach invisible.
    shadow = np.minimum(covered, _MOST_DARKENING) * (1.0 - away2[near])
    return near, (1.0 - shadow).astype(np.float32)
