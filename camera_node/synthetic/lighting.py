"""Light on surfaces: what they scatter, what a gloss mirrors, what a shadower and a veil take away.

Scattering is always there. Gloss, shadower and veil are what effects hang on a world: this file knows only
what they have to answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.placement import Placed
from camera_node.synthetic.shapes import Array
from camera_node.synthetic.textures import Colour


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
class Lit:
    """Surface points (3, N), what they scatter (albedo), their unit normals and the unit rays (3, N) that met
    them, and which of the light's points each sees past what stands still (S, N)."""

    points: Array
    albedo: Array
    normals: Array
    rays: Array
    visible: Array

    def part(self, chosen: NDArray[np.intp] | slice) -> Lit:
        return Lit(*(a[:, chosen] for a in (self.points, self.albedo, self.normals, self.rays, self.visible)))


class Gloss(Protocol):
    """What surfaces send towards the viewer beyond what they scatter."""

    def share(self, to_light: Array, normals: Array, rays: Array) -> Array:
        """Share (N,) of a light's strength that is mirrored along -rays (3, N), the cosine at the surface
        included; to_light and normals are unit (3, N)."""
        ...


class Veil(Protocol):
    """A medium between surfaces and cameras, the same everywhere."""

    @property
    def airlight(self) -> Colour:
        """What the medium itself looks like, in [0, 1]."""
        ...

    def clear(self, distance_m: Array) -> NDArray[np.float32]:
        """Share (N,) of a surface's light that arrives from so far; 0 from infinity."""
        ...


class Shadower(Protocol):
    """Takes away the light that moving parts keep from surfaces."""

    def darken(self, lit: Lit, light: Light, there: Sequence[Placed], gloss: Gloss | None) -> Array:
        """What surface points (N,) lose of their colours (3, N) to the parts that are ``there``."""
        ...


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


def direct(lit: Lit, light: Light, source: Array, gloss: Gloss | None) -> Array:
    """Colours (3, N) that one of the light's points (3,) adds to surface points that see it: scattered and,
    with a gloss, mirrored."""
    tint = np.array(light.tint)[:, None] * (light.strength / len(light.points))
    scattered = lit.albedo * _lambert(source, light.reach_m, lit.points, lit.normals)
    if gloss is None:
        return tint * scattered
    return tint * (scattered + _mirrored(gloss, source, light.reach_m, lit))


def _mirrored(gloss: Gloss, source: Array, reach_m: float, lit: Lit) -> Array:
    to = source[:, None] - lit.points
    distance2 = np.maximum((to * to).sum(axis=0), 1e-12)
    share = gloss.share(to / np.sqrt(distance2), lit.normals, lit.rays)
    return share / (1.0 + distance2 / (reach_m * reach_m))


def gleam(light: Light, gloss: Gloss, lit: Lit) -> Array:
    """Colours (3, N) that a gloss adds to surface points."""
    total = np.zeros(lit.points.shape[1])
    for k, source in enumerate(light.points):
        total += _mirrored(gloss, source, light.reach_m, lit) * lit.visible[k]
    return np.array(light.tint)[:, None] * (light.strength / len(light.points)) * total


def _lambert(source: Array, reach_m: float, points: Array, normals: Array) -> Array:
    to = source[:, None] - points
    distance2 = (to * to).sum(axis=0)
    cosine = np.maximum((to * normals).sum(axis=0), 0.0) / np.sqrt(np.maximum(distance2, 1e-12))
    # Gentler than the inverse square: a room lit by its walls as well has no black corners.
    return cosine / (1.0 + distance2 / (reach_m * reach_m))
