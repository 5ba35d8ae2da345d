"""Shadows of moving parts on everything behind them.

Without this effect moving parts only darken the floor beneath them, and are lit as if nothing stood between
them and the light. Static parts always cast shadows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.effects import EffectParameters
from camera_node.synthetic.lighting import Light, SpecularReflection, SurfacePoints, direct_light
from camera_node.synthetic.placement import PlacedParts, place_parts
from camera_node.synthetic.render import blocked
from camera_node.synthetic.scene import Scene
from freshfield.geometry import Array
from freshfield.settings import within


class Shadows(EffectParameters, frozen=True):
    """Rendered ahead; free while streaming. List it ``in_truth: true`` if the field is to show the
    shadows."""

    opacity: Annotated[float, within(0.0, 1.0, "share of the light that a moving part holds back")] = 1.0
    light_points: Annotated[
        int,
        within(
            0, 1000, "points of the scene's light that are traced; fewer are faster, their penumbrae coarser; 0: all"
        ),
    ] = 0

    kind: ClassVar[str] = "world"

    def extend(self, scene: Scene) -> Scene:
        return scene.with_world(dataclasses.replace(scene.world, shadows=self))

    def blocked_light(
        self, surface: SurfacePoints, light: Light, moving: Sequence[PlacedParts], specular: SpecularReflection | None
    ) -> Array:
        """See ``lighting.ShadowModel``. Traces rays from points of the light to every surface point; a light
        of many points makes penumbrae."""
        lost = np.zeros_like(surface.albedo)
        casters = [_casters(placed) for placed in moving]
        count = len(light.points)
        traced = min(self.light_points or count, count)
        for k in np.linspace(0, count - 1, traced).round().astype(int):
            source = light.points[k]
            ray = surface.points - source[:, None]
            distance = np.sqrt((ray * ray).sum(axis=0))
            hidden = np.zeros(distance.size, dtype=np.bool_)
            for placed in casters:
                chosen = _behind(source, ray, distance, placed, surface.visible[k])
                if chosen.size:
                    hidden[chosen] |= blocked(source, ray[:, chosen], distance[chosen], placed)
            at = np.flatnonzero(hidden)
            if at.size:
                lost[:, at] += direct_light(surface.select(at), light, source, specular)
        return self.opacity * count / traced * lost


def _casters(placed: PlacedParts) -> PlacedParts:
    """The parts that cast a shadow."""
    casting = [k for k, part in enumerate(placed.parts) if part.casts_shadow]
    if len(casting) == len(placed.parts):
        return placed
    return place_parts([placed.parts[k] for k in casting], placed.matrices[casting])


def _behind(source: Array, ray: Array, distance: Array, placed: PlacedParts, visible: Array) -> NDArray[np.intp]:
    """Indices of the surface points that static parts do not hide from the light point ``source``, and that
    may lie behind the body ``placed``."""
    if not placed.parts:
        return np.empty(0, dtype=np.intp)
    center, radius = placed.bounding_sphere()
    to = center - source
    tangent2 = float(to @ to) - radius * radius
    # A light inside the sphere may be hidden from any point.
    within = to @ ray >= np.sqrt(max(tangent2, 0.0)) * distance if tangent2 > 0.0 else True
    return np.flatnonzero(within & (visible > 0.0))
