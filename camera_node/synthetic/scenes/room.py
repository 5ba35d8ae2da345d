"""Scene ``room``: a person walks and waves in a furnished, textured room of 6 x 6 x 3 m.

Nineteen cameras look inward from a wide arc in three rows (DyNeRF-like). cam00, in the middle, is held out
and more than 15 degrees from every other.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from camera_node.synthetic import textures as tx
from camera_node.synthetic.camera_rig import build_rig, rings
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.person import make_walk, walking_person
from camera_node.synthetic.placement import Part, at
from camera_node.synthetic.render import World
from camera_node.synthetic.scene import Scene, pinhole
from camera_node.synthetic.scene_parameters import Fov, MovingParams
from camera_node.synthetic.scenes.shell import room_shell
from camera_node.synthetic.shapes import Box, Cylinder, RoundCone, Sphere
from freshfield.settings import within

_TARGET = (0.0, 0.75, 0.90)
_RADIUS_M = 3.2
_WIDE, _NARROW = (-12, 12, -37, 37, -62, 62), (-25, 25, -46, 46, -66, 66)
_ANGLES_DEG = rings((0.0, 20.0), [(5.0, _WIDE), (22.0, _NARROW), (38.0, _WIDE)])
_LOOP_CENTER, _LOOP_RADII_M = (0.0, 0.95), (0.74, 0.54)


class Params(MovingParams, frozen=True, kw_only=True):
    """speed_m_per_s: of the person's parts."""

    horizontal_fov_deg: Fov = 64.0
    people: Annotated[int, within(0, 4, "evenly along the loop")] = 1


def build(params: Params) -> Scene:
    """The room as a scene."""
    walk = make_walk(_LOOP_CENTER, _LOOP_RADII_M, params.speed_m_per_s, params.motion_seed)
    starts_s = (walk.start_s + k / params.people * walk.period_s for k in range(params.people))
    walks = [replace(walk, start_s=start_s) for start_s in starts_s]
    grid = np.stack(np.meshgrid([-0.8, 0.2, 1.2], [-1.0, 0.0, 1.0], [2.95]), axis=-1).reshape(-1, 3)
    light = Light(
        points=grid,
        strength=0.80,
        falloff_m=4.0,
        tint=(1.0, 0.96, 0.88),
        ambient_below=(0.30, 0.29, 0.29),
        ambient_above=(0.50, 0.52, 0.55),
    )
    return Scene(
        name="room",
        params=params,
        cameras=build_rig(_ANGLES_DEG, _TARGET, _RADIUS_M, params.count, pinhole(params)),
        target=_TARGET,
        world=World((*_shell(), *_furniture()), tuple(map(walking_person, walks)), light),
        bounds=np.array([[-3.0, -3.0, 0.0], [3.0, 3.0, 3.0]]),
        period_s=walk.period_s,
        moving=bool(walks) and not walk.still,
    )


def _shell() -> list[Part]:
    brick = tx.Noise(tx.Brick((0.72, 0.42, 0.32), (0.86, 0.80, 0.72), 0.60, 0.30), 0.5, 0.05, seed=1)
    paper = tx.Bands(
        tx.Diamonds((0.22, 0.48, 0.50), (0.34, 0.62, 0.60), (0.95, 0.86, 0.60), 0.5, 0.6),
        [(-4, 4, -2.0, -0.62, (0.88, 0.86, 0.80)), (-4, 4, -0.66, -0.58, (0.62, 0.46, 0.30))],
        soft=0.03,
    )
    stripes = tx.Bands(
        tx.Stripes((0.92, 0.78, 0.46), (0.97, 0.90, 0.72), 0.5, soft=0.05),
        [(-4, 4, -2.0, -1.32, (0.55, 0.36, 0.24))],
        soft=0.03,
    )
    plaster = tx.Noise(tx.Gradient((0.66, 0.72, 0.80), (0.84, 0.88, 0.92), -1.5, 1.5), 0.6, 0.06, seed=3)
    boards = tx.Planks((0.78, 0.58, 0.38), (0.58, 0.39, 0.24), 0.30, 1.8)
    ceiling = tx.Bands(
        tx.Noise(tx.Plain((0.86, 0.85, 0.83)), 0.8, 0.03, seed=4),
        [(-0.9, 1.3, -1.1, 1.1, (1.0, 0.99, 0.95))],
        soft=0.06,
    )
    walls: dict[str, tx.Texture] = {"north": brick, "west": paper, "east": stripes, "south": plaster}
    return room_shell(3.0, 3.0, walls, boards, ceiling, glow=0.5)


def _furniture() -> list[Part]:
    oak = tx.Noise(tx.Plain((0.62, 0.42, 0.24)), 0.12, 0.10, seed=5, stretch=4.0)
    white = tx.Plain((0.93, 0.92, 0.90))
    rug = tx.Framed(
        tx.Diamonds((0.62, 0.20, 0.24), (0.86, 0.62, 0.42), (0.20, 0.26, 0.42), 0.45, 0.45),
        (0.94, 0.88, 0.76),
        (1.35, 1.05),
        0.10,
        0.04,
    )
    sky = tx.Spots(
        tx.Bands(
            tx.Gradient((0.80, 0.90, 0.98), (0.38, 0.62, 0.92), -0.5, 0.5),
            [(-2, 2, -0.9, -0.22, (0.40, 0.62, 0.30))],
            soft=0.08,
        ),
        [(0.28, 0.2, 0.12, (1.0, 0.93, 0.62)), (-0.3, 0.12, 0.1, (1, 1, 1)), (-0.18, 0.15, 0.12, (1, 1, 1))],
        soft=0.05,
    )
    window = tx.Framed(
        tx.Bands(sky, [(-0.03, 0.03, -1, 1, (0.95, 0.95, 0.93)), (-1, 1, -0.03, 0.03, (0.95, 0.95, 0.93))]),
        (0.95, 0.95, 0.93),
        (0.75, 0.60),
        0.07,
    )
    sunset = tx.Framed(
        tx.Spots(
            tx.Gradient((0.30, 0.14, 0.36), (0.98, 0.62, 0.30), -0.35, 0.35), [(0.0, 0.02, 0.13, (1.0, 0.90, 0.55))]
        ),
        (0.25, 0.17, 0.12),
        (0.55, 0.42),
        0.06,
    )
    abstract = tx.Framed(
        tx.Spots(
            tx.Plain((0.94, 0.93, 0.88)),
            [
                (-0.16, 0.12, 0.20, (0.16, 0.36, 0.70)),
                (0.16, -0.02, 0.17, (0.90, 0.34, 0.22)),
                (-0.02, -0.22, 0.12, (0.96, 0.76, 0.20)),
            ],
        ),
        (0.14, 0.14, 0.16),
        (0.5, 0.5),
        0.05,
    )
    books = tx.Books(
        [(0.74, 0.20, 0.18), (0.16, 0.36, 0.56), (0.93, 0.78, 0.36), (0.24, 0.50, 0.34), (0.86, 0.84, 0.78)],
        (0.50, 0.33, 0.19),
        0.12,
        0.42,
    )
    sofa = tx.Plaid((0.24, 0.42, 0.40), (0.16, 0.30, 0.32), (0.66, 0.78, 0.70), 0.36, 0.36)
    leaf = tx.Noise(tx.Plain((0.26, 0.52, 0.22)), 0.16, 0.22, seed=8)
    pot = tx.Stripes((0.84, 0.46, 0.30), (0.95, 0.84, 0.70), 0.16, axis=1, soft=0.03)
    globe = tx.Noise(tx.Checker((0.16, 0.42, 0.76), (0.90, 0.88, 0.70), 1 / 8, 0.5, 0.05), 0.3, 0.1, seed=9)
    ball = tx.Stripes((0.96, 0.96, 0.94), (0.90, 0.26, 0.20), 1 / 3, soft=0.03)
    crate = tx.Framed(
        tx.Stripes((0.80, 0.62, 0.36), (0.70, 0.50, 0.28), 0.12, axis=1), (0.55, 0.37, 0.20), (0.25, 0.25), 0.05
    )
    dice = tx.Checker((0.96, 0.80, 0.22), (0.30, 0.20, 0.42), 0.11)
    cushion = tx.Stripes((0.96, 0.84, 0.44), (0.90, 0.60, 0.24), 0.14)
    shade = tx.Plain((0.98, 0.90, 0.70))
    parts = [
        Part(Box((1.35, 1.05, 0.006)), rug, at(0, 0.95, 0.006), casts_shadow=False, takes_contact=True),
        Part(Box((0.75, 0.03, 0.60)), window, at(0.25, 2.97, 1.70)),
        Part(Box((0.03, 0.55, 0.42)), sunset, at(-2.97, 0.9, 1.80)),
        Part(Box((0.03, 0.50, 0.50)), abstract, at(2.97, 0.7, 1.75)),
        Part(Box((0.65, 0.20, 1.05)), books, at(-1.95, 2.78, 1.05)),
        # A table with a globe, a vase and a cube.
        Part(Box((0.70, 0.42, 0.03)), oak, at(1.75, 2.25, 0.75, -8)),
        Part(Sphere(0.19), globe, at(1.45, 2.22, 0.97, 30)),
        Part(RoundCone(0.10, 0.05, 0.24), pot, at(2.10, 2.34, 0.88)),
        Part(Box((0.11, 0.11, 0.11)), dice, at(1.78, 2.0, 0.89, 25)),
        # A sofa along the left wall.
        Part(Box((0.38, 0.80, 0.21)), sofa, at(-2.50, 1.15, 0.21)),
        Part(Box((0.12, 0.80, 0.22)), sofa, at(-2.84, 1.15, 0.60)),
        Part(Box((0.14, 0.24, 0.14)), cushion, at(-2.60, 0.70, 0.56, 14)),
        # A plant, a lamp, a crate, a ball.
        Part(RoundCone(0.15, 0.20, 0.22), pot, at(2.55, 1.10, 0.15)),
        Part(Sphere(1.0), leaf, at(2.55, 1.10, 0.92) @ np.diag([0.34, 0.34, 0.46, 1.0])),
        Part(Cylinder(0.025, 0.75), tx.Plain((0.20, 0.20, 0.22)), at(-0.95, 2.72, 0.75)),
        Part(RoundCone(0.22, 0.10, 0.24), shade, at(-0.95, 2.72, 1.50), casts_shadow=False, glow=0.35),
        Part(Box((0.25, 0.25, 0.25)), crate, at(-1.55, 0.05, 0.25, 20)),
        Part(Sphere(0.20), ball, at(1.45, -0.05, 0.20, 40)),
    ]
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = at(1.75, 2.25, 0.0, -8) @ at(0.62 * sx, 0.34 * sy, 0.36)
            parts.append(Part(Box((0.035, 0.035, 0.36)), white, leg))
    return parts
