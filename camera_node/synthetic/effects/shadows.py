"""Shadows: what moves takes the light from what lies behind it, as furniture always does.

Without this effect moving parts only darken the floor beneath them, and are lit as if nothing stood
between them and the light.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.effects import check_ranges
from camera_node.synthetic.lighting import Gloss, Light, Lit, direct
from camera_node.synthetic.placement import Placed, place
from camera_node.synthetic.render import SHADOW_BIAS, cast
from camera_node.synthetic.shapes import Array

if TYPE_CHECKING:
    from camera_node.synthetic.scene import Scene


@dataclass(frozen=True)
class ShadowsParameters:
    """opacity: share of the light that a moving part holds back; 1 is solid. light_points: how many points of
    the scene's light are traced, each standing for its share of all; 0 traces all. Fewer are faster and
    coarsen the penumbrae."""

    opacity: float = 1.0
    light_points: int = 0
    in_truth: bool = False

    def __post_init__(self) -> None:
        check_ranges(self, opacity=(0.0, 1.0), light_points=(0, 1000))


@dataclass(frozen=True)
class MovingShadows:
    """A ``lighting.Shadower``: points of the light are traced to every surface point, so that a
    light of many points gives penumbrae."""

    opacity: float
    light_points: int

    def darken(self, lit: Lit, light: Light, there: Sequence[Placed], gloss: Gloss | None) -> Array:
        lost = np.zeros_like(lit.albedo)
        casters = [_casters(placed) for placed in there]
        count = len(light.points)
        traced = min(self.light_points or count, count)
        for k in np.linspace(0, count - 1, traced).round().astype(int):
            source = light.points[k]
            ray = lit.points - source[:, None]
            distance = np.sqrt((ray * ray).sum(axis=0))
            hidden = np.zeros(distance.size, dtype=np.bool_)
            for placed in casters:
                chosen = _behind(source, ray, distance, placed, lit.visible[k])
                if not chosen.size:
                    continue
                far = np.maximum(distance[chosen], 1e-12)
                _, hit = cast(source, ray[:, chosen] / far, placed, far * (1.0 - SHADOW_BIAS))
                hidden[chosen[hit >= 0]] = True
            at = np.flatnonzero(hidden)
            if at.size:
                lost[:, at] += direct(lit.part(at), light, source, gloss)
        return self.opacity * count / traced * lost


def _casters(placed: Placed) -> Placed:
    """Without the parts that cast no shadow."""
    casting = [k for k, part in enumerate(placed.parts) if part.casts_shadow]
    if len(casting) == len(placed.parts):
        return placed
    return place([placed.parts[k] for k in casting], placed.matrices[casting])


def _behind(source: Array, ray: Array, distance: Array, placed: Placed, visible: Array) -> NDArray[np.intp]:
    """Numbers of the points that may lie behind a mover, seen from a light point that they see."""
    if not placed.parts:
        return np.empty(0, dtype=np.intp)
    centre = placed.centres.mean(axis=0)
    radius = float((np.linalg.norm(placed.centres - centre, axis=1) + placed.radii).max())
    to = centre - source
    tangent2 = float(to @ to) - radius * radius
    # The light may stand among the parts: then they may hide anything.
    within = to @ ray >= np.sqrt(max(tangent2, 0.0)) * distance if tangent2 > 0.0 else True
    return np.flatnonzero(within & (visible > 0.0))


class Shadows:
    """Rendered ahead; nothing while streaming. What stands still keeps the shadows that it always had.
    List it ``in_truth: true`` where the shadows belong to what a field is to show."""

    kind: ClassVar[str] = "world"
    Parameters = ShadowsParameters

    def __init__(self, parameters: ShadowsParameters, rng: np.random.Generator) -> None:
        self._shadower = MovingShadows(parameters.opacity, parameters.light_points)

    def extend(self, scene: Scene) -> Scene:
        world = dataclasses.replace(scene.world, shadower=self._shadower)
        return scene.with_world(world, scene.period_s, scene.moving)
