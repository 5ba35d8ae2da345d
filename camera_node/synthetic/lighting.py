"""Light on surfaces: diffuse reflection and contact shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic import synthetic_constants as tuned
from camera_node.synthetic.placement import MovingBody, PlacedParts
from camera_node.synthetic.textures import Color
from freshfield.geometry import Array


@dataclass(frozen=True)
class Light:
    """A soft overhead light made of point lights, and an ambient term that varies with a surface's direction.

    points: (S, 3). strength: of all points together. falloff_m: distance at which a point's light has halved.
    ambient_below, ambient_above: ambient color on surfaces that face down, up. tint: color of the points.
    """

    points: Array
    strength: float
    falloff_m: float
    ambient_below: Color
    ambient_above: Color
    tint: Color = (1.0, 1.0, 1.0)


def shade_diffuse(light: Light, albedo: Array, points: Array, normals: Array, visible: Array | None = None) -> Array:
    """Colors (3, N) of surface points under ambient light and Lambert's law.

    albedo, points, normals: (3, N).
    visible: (S, N), 0 if a static part stands between light point and surface point, else 1; None replaces the
        light by one unshadowed point at its center.
    """
    low, high = np.array(light.ambient_below)[:, None], np.array(light.ambient_above)[:, None]
    ambient = low + (high - low) * (0.5 + 0.5 * normals[2])
    sources = light.points if visible is not None else light.points.mean(axis=0, keepdims=True)
    direct = np.zeros(points.shape[1])
    for k, source in enumerate(sources):
        to = source[:, None] - points
        distance2 = (to * to).sum(axis=0)
        cosine = np.maximum((to * normals).sum(axis=0), 0.0) / np.sqrt(np.maximum(distance2, 1e-12))
        # Softer than the inverse square law: indirect light from walls leaves no black corners in a room.
        term = cosine / (1.0 + distance2 / (light.falloff_m * light.falloff_m))
        direct += term if visible is None else term * visible[k]
    return albedo * (ambient + np.array(light.tint)[:, None] * (light.strength / len(sources)) * direct)


def contact_shadow(
    body: MovingBody, placed: PlacedParts, floor_points: Array
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Ambient occlusion of the floor beneath a body, so that it does not seem to float. A point loses the
    share of its sky that each contact sphere covers, r^2 cos / d^2.

    placed: the body's parts at an instant. floor_points: (3, N).
    Returns the indices (K,) of the darkened points, and the shares (K,) of their light that are left.
    """
    if not body.contact:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.float32)
    spheres = np.array([[*placed.matrices[k, :3, 3], r] for k, r in body.contact])
    middle = spheres[:, :2].mean(axis=0)
    dx, dy = floor_points[0] - middle[0], floor_points[1] - middle[1]
    away2 = (dx * dx + dy * dy) / tuned.CONTACT_REACH_M**2
    near = np.flatnonzero(away2 < 1.0)
    p = floor_points[:, near]
    covered = np.zeros(near.size)
    for x, y, z, r in spheres:
        # A sphere that is half sunk in the floor would cover more than the whole sky: lift it onto the floor.
        h = np.maximum(z - p[2], r)
        d2 = (p[0] - x) ** 2 + (p[1] - y) ** 2 + h * h
        covered += r * r * h / (d2 * np.sqrt(d2))
    # The window makes the truncation at the reach invisible.
    shadow = np.minimum(covered, tuned.CONTACT_MOST_DARKENING) * (1.0 - away2[near])
    return near, (1.0 - shadow).astype(np.float32)
