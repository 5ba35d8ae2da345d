"""Scene ``tile``: a static inspection object in the manner of the thesis's reactor tile (section 4.7).

A metal carrier holds two rows of slightly inclined, grooved segments (castellations) with bolts, paint
marks and damage; the background is plain, or with ``bench`` a workbench on which other things stand. Cameras
stand on a half-hemisphere; cam00 is held out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from camera_node.synthetic import textures as tx
from camera_node.synthetic.camera_rig import build_rig, rings
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.motion import PERIOD_UNIT_S
from camera_node.synthetic.placement import Part, at, facing
from camera_node.synthetic.render import World
from camera_node.synthetic.scene import Scene, pinhole
from camera_node.synthetic.scene_parameters import BaseParams, Fov
from camera_node.synthetic.shapes import Box, Cylinder, Quad, Sphere
from freshfield.geometry import Array

_BACKGROUND = (0.80, 0.83, 0.86)
_TARGET = (0.0, 0.0, 0.03)
_RADIUS_M = 0.85
BOTTOM_M = -0.06
_BENCH_BOUNDS = [[-1.6, -0.65, -0.4], [1.6, 0.72, 1.4]]
# The rings are of the half-hemisphere on the -y side.
_LOW, _MIDDLE, _HIGH = (-85, -51, -17, 17, 51, 85), (-82, -56, -28, 28, 56, 82), (-75, -25, 25, 75)
_ANGLES_DEG = rings((0.0, 40.0), [(16.0, _LOW), (40.0, _MIDDLE), (64.0, _HIGH), (82.0, (-40, 140))])


class Params(BaseParams, frozen=True, kw_only=True):
    """bench: the tile lies on a workbench before a wall, with tools, boxes and scrap around it."""

    horizontal_fov_deg: Fov = 40.0
    bench: bool = False


def build(params: Params) -> Scene:
    """The tile as a scene. It does not move, so it has the shortest period."""
    grid = np.stack(np.meshgrid([-0.5, -0.3, -0.1], [-0.5, -0.3, -0.1], [0.9]), axis=-1).reshape(-1, 3)
    light = Light(
        points=grid,
        strength=0.95,
        falloff_m=1.2,
        tint=(1.0, 0.97, 0.92),
        ambient_below=(0.28, 0.29, 0.31),
        ambient_above=(0.50, 0.52, 0.54),
    )
    around = _bench() if params.bench else []
    return Scene(
        name="tile",
        params=params,
        cameras=build_rig(_ANGLES_DEG, _TARGET, _RADIUS_M, params.count, pinhole(params)),
        target=_TARGET,
        world=World((*object_parts(), *around), (), light, _BACKGROUND),
        bounds=np.array(_BENCH_BOUNDS if params.bench else [[-0.26, -0.20, -0.07], [0.26, 0.20, 0.13]]),
        period_s=PERIOD_UNIT_S,
        moving=False,
    )


def object_parts() -> list[Part]:
    """The tile itself, the first parts of the scene, its lowest point ``BOTTOM_M`` high."""
    return _carrier() + _segments() + _bolts()


def _at(x: float, y: float, z: float, tilt_x_deg: float = 0.0, tilt_y_deg: float = 0.0) -> Array:
    a, b = np.deg2rad(tilt_x_deg), np.deg2rad(tilt_y_deg)
    rx = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    out = np.eye(4)
    out[:3, :3] = ry @ rx
    out[:3, 3] = x, y, z
    return out


def _carrier() -> list[Part]:
    steel = tx.Noise(tx.Plain((0.46, 0.47, 0.50)), 0.05, 0.10, seed=21, stretch=5.0)
    hazard = tx.Stripes((0.95, 0.76, 0.12), (0.16, 0.15, 0.15), 0.06, soft=0.006)
    return [
        Part(Box((0.24, 0.18, 0.025)), steel, _at(0, 0, -0.035)),
        Part(Box((0.20, 0.14, 0.012)), tx.Plain((0.22, 0.22, 0.24)), _at(0, 0, 0.0)),
        Part(Box((0.236, 0.004, 0.012)), hazard, _at(0, -0.1795, -0.035)),
    ]


def _segments() -> list[Part]:
    """Two rows of four blocks, each inclined a little and scored by grooves; three carry marks."""
    parts = []
    red, blue, green = (0.82, 0.20, 0.15), (0.12, 0.36, 0.72), (0.15, 0.52, 0.30)
    soot, paint = (0.13, 0.11, 0.10), (0.96, 0.94, 0.90)
    for row in range(2):
        for column in range(4):
            tone = 0.62 + 0.05 * ((column + row) % 2)
            metal: tx.Texture = tx.Noise(
                tx.Plain((tone + 0.03, tone, tone - 0.05)), 0.035, 0.07, seed=30 + 4 * row + column
            )
            if (row, column) == (0, 1):
                metal = tx.Spots(
                    metal,
                    [(0.005, 0.0, 0.026, soot), (0.012, 0.006, 0.013, (0.42, 0.26, 0.16)), (-0.026, 0.03, 0.009, soot)],
                    soft=0.012,
                )
            if (row, column) == (1, 2):
                metal = tx.Spots(
                    metal, [(0.0, 0.0, 0.036, red), (0.0, 0.0, 0.024, paint), (0.0, 0.0, 0.012, red)], soft=0.004
                )
            if (row, column) == (1, 0):
                metal = tx.Bands(
                    metal, [(-0.03, 0.03, -0.012, 0.012, blue), (-0.012, 0.012, -0.04, 0.04, blue)], soft=0.004
                )
            if (row, column) == (0, 3):
                metal = tx.Bands(
                    metal,
                    [
                        (-0.032, 0.0, -0.032, 0.0, green),
                        (0.0, 0.032, 0.0, 0.032, green),
                        (-0.032, 0.0, 0.0, 0.032, paint),
                        (0.0, 0.032, -0.032, 0.0, paint),
                    ],
                    soft=0.004,
                )
            x, y = -0.1455 + 0.097 * column, -0.068 + 0.136 * row
            # Alternate inclination, as tiles are set so that no edge faces the flow.
            tilt_x, tilt_y = (5.0 if row == 0 else -5.0), (4.0 if column % 2 == 0 else -4.0)
            parts.append(Part(Box((0.044, 0.062, 0.022)), _Grooved(metal), _at(x, y, 0.036, tilt_x, tilt_y)))
    return parts


@dataclass(frozen=True)
class _Grooved:
    """Two dark grooves across a block, one along it."""

    base: tx.Texture

    def __call__(self, uv: Array) -> Array:
        line = np.maximum(tx.soft_line(uv[1] + 0.0205, 0.041, 0.0035, 0.003), tx.soft_line(uv[0], 0.3, 0.0035, 0.003))
        return self.base(uv) * (1.0 - 0.62 * line)


def _bolts() -> list[Part]:
    brass = tx.Stripes((0.80, 0.62, 0.26), (0.62, 0.44, 0.16), 1 / 6, soft=0.06)
    parts = []
    for x in (-0.22, 0.22):
        for y in (-0.155, 0.0, 0.155):
            parts.append(Part(Cylinder(0.014, 0.010), brass, _at(x, y, 0.0)))
    parts.append(Part(Cylinder(0.020, 0.012), brass, _at(0.0, 0.0, 0.046)))
    spotted = tx.Checker((0.90, 0.42, 0.12), (0.98, 0.90, 0.78), 1 / 8, 0.5, 0.05)
    # A round inspection probe left on the carrier: something that is not flat.
    parts.append(Part(Sphere(0.030), spotted, _at(0.19, -0.13, 0.02)))
    return parts


def _bench() -> list[Part]:
    """A workbench with a wall behind it, and what lies on it, none of it part of the tile."""
    wood = tx.Planks((0.66, 0.50, 0.34), (0.52, 0.37, 0.23), 0.16, 0.9)
    wall = tx.Brick((0.58, 0.60, 0.63), (0.44, 0.45, 0.47), 0.22, 0.075, 0.008)
    steel = tx.Noise(tx.Plain((0.50, 0.51, 0.54)), 0.04, 0.12, seed=71, stretch=4.0)
    hazard = tx.Stripes((0.95, 0.76, 0.12), (0.16, 0.15, 0.15), 0.07, soft=0.006)
    brass = tx.Stripes((0.80, 0.62, 0.26), (0.62, 0.44, 0.16), 1 / 6, soft=0.06)
    orange = tx.Checker((0.90, 0.42, 0.12), (0.98, 0.90, 0.78), 1 / 8, 0.5, 0.05)
    books = tx.Stripes((0.20, 0.30, 0.46), (0.86, 0.83, 0.76), 0.024, 1, 0.004)
    top, low = Box((0.85, 0.65, 0.02)), BOTTOM_M

    def standing(
        shape: Box | Cylinder | Sphere, height: float, texture: tx.Texture, x: float, y: float, turn_deg: float = 0.0
    ) -> Part:
        return Part(shape, texture, at(x, y, low + height, turn_deg))

    return [
        Part(top, wood, at(0.0, 0.0, low - 0.02)),
        Part(Quad((1.6, 0.9)), wall, facing((1, 0, 0), (0, 0, 1), (0.0, 0.72, 0.5)), casts_shadow=False),
        standing(Box((0.12, 0.07, 0.05)), 0.05, tx.Plain((0.72, 0.16, 0.14)), -0.46, 0.26, 25.0),
        standing(Box((0.10, 0.08, 0.02)), 0.02, steel, 0.42, 0.02, 15.0),
        standing(Box((0.044, 0.062, 0.022)), 0.022, steel, 0.40, 0.03, 60.0),
        standing(Box((0.09, 0.12, 0.03)), 0.03, books, 0.10, 0.40, 8.0),
        standing(Box((0.20, 0.03, 0.03)), 0.03, hazard, -0.08, -0.36, -6.0),
        standing(Cylinder(0.045, 0.06), 0.06, tx.Plain((0.14, 0.42, 0.33)), 0.38, 0.34),
        standing(Cylinder(0.030, 0.045), 0.045, brass, -0.40, -0.12),
        standing(Cylinder(0.020, 0.012), 0.012, brass, -0.33, 0.05),
        standing(Cylinder(0.014, 0.010), 0.010, brass, 0.31, -0.14),
        standing(Sphere(0.04), 0.04, orange, 0.44, -0.30),
        standing(Sphere(0.03), 0.03, tx.Plain((0.20, 0.22, 0.62)), -0.30, -0.25),
        standing(Box((0.05, 0.05, 0.05)), 0.05, tx.Plain((0.88, 0.86, 0.80)), -0.26, 0.38, 40.0),
    ]
