"""Scene ``tower``: cameras on a mast look outward into a workshop of 10 x 10 x 4 m (Eyeful-like).

Each camera sees a different part of the surroundings, with little overlap. A person walks on one side and a
loaded cart drives on the other. cam00 is held out and more than 15 degrees from every other.
"""

from __future__ import annotations

import math

import numpy as np

from camera_node.synthetic import textures as tx
from camera_node.synthetic.camera_rig import build_rig, rings
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.person import Walk, make_walk, walking_person
from camera_node.synthetic.placement import MovingBody, Part, at, facing
from camera_node.synthetic.render import World
from camera_node.synthetic.scene import Scene, pinhole
from camera_node.synthetic.scene_parameters import Fov, MovingParams
from camera_node.synthetic.scenes.shell import room_shell
from camera_node.synthetic.shapes import Box, Cylinder, RoundCone, Sphere
from freshfield.geometry import Array

_MAST = (0.0, 0.0, 1.70)
_RADIUS_M = 0.55
# The rings are turned against each other.
_LEVEL, _DOWN, _UP = (28, 75, 128, 180, 232, 285, 332), (0, 52, 104, 156, 208, 256, 308), (0, 90, 180, 270)
_ANGLES_DEG = rings((0.0, 3.0), [(3.0, _LEVEL), (-25.0, _DOWN), (26.0, _UP)])
_HALF_M, _HEIGHT_M = 5.0, 4.0
_WALK_CENTER, _WALK_RADII_M = (0.2, -2.75), (1.35, 0.75)
_DRIVE_CENTER, _DRIVE_RADII_M = (0.0, 2.9), (1.9, 0.8)


class Params(MovingParams, frozen=True, kw_only=True):
    """speed_m_per_s: mean speed of the person's parts and of the cart; 0 stands still."""

    horizontal_fov_deg: Fov = 90.0


def build(params: Params) -> Scene:
    """The workshop as a scene."""
    walk = make_walk(_WALK_CENTER, _WALK_RADII_M, params.speed_m_per_s, params.motion_seed)
    bodies = (walking_person(walk), _cart(walk, params.speed_m_per_s))
    grid = np.stack(np.meshgrid([-2.6, 0.0, 2.6], [-2.6, 0.0, 2.6], [3.9]), axis=-1).reshape(-1, 3)
    light = Light(
        points=grid,
        strength=0.85,
        falloff_m=4.5,
        tint=(1.0, 0.97, 0.92),
        ambient_below=(0.30, 0.30, 0.31),
        ambient_above=(0.50, 0.52, 0.55),
    )
    return Scene(
        name="tower",
        params=params,
        cameras=build_rig(_ANGLES_DEG, _MAST, _RADIUS_M, params.count, pinhole(params), outward=True),
        target=_MAST,
        world=World((*_shell(), *_mast(), *_workshop()), bodies, light),
        bounds=np.array([[-_HALF_M, -_HALF_M, 0.0], [_HALF_M, _HALF_M, _HEIGHT_M]]),
        period_s=walk.period_s,
        moving=not walk.still,
    )


def _cart(walk: Walk, speed_m_per_s: float) -> MovingBody:
    """A cart that drives along an ellipse in the walk's period; the speed determines the ellipse's size."""
    deck = tx.Stripes((0.93, 0.72, 0.12), (0.16, 0.16, 0.18), 0.2, soft=0.03)
    crate = tx.Framed(tx.Checker((0.24, 0.46, 0.78), (0.90, 0.88, 0.82), 0.12), (0.55, 0.37, 0.20), (0.24, 0.24), 0.04)
    drum = tx.Stripes((0.80, 0.24, 0.20), (0.94, 0.92, 0.88), 0.2, axis=1, soft=0.03)
    tire = tx.Plain((0.13, 0.13, 0.14))
    parts = [
        (Part(Box((0.55, 0.32, 0.05)), deck), at(0.0, 0.0, 0.25)),
        (Part(Box((0.24, 0.24, 0.24)), crate), at(-0.22, 0.0, 0.54)),
        (Part(Cylinder(0.17, 0.22), drum), at(0.30, 0.05, 0.52)),
        (Part(RoundCone(0.025, 0.025, 0.65), tx.Plain((0.25, 0.26, 0.30))), at(0.55, 0.0, 0.30)),
        *((Part(Sphere(0.11), tire), at(x, y, 0.11)) for x in (-0.38, 0.38) for y in (-0.27, 0.27)),
    ]
    local = np.stack([matrix for _, matrix in parts])
    radii = np.array(_DRIVE_RADII_M)
    if not walk.still:
        angle = 2 * math.pi * np.arange(720)[:, None] / 720
        path = radii * np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
        length_m = float(np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1).sum())
        radii = radii * (speed_m_per_s * walk.period_s / length_m)

    def matrices(t_s: float) -> Array:
        a = 2 * math.pi * walk.phase(t_s) * walk.direction
        x, y = _DRIVE_CENTER[0] + radii[0] * math.cos(a), _DRIVE_CENTER[1] + radii[1] * math.sin(a)
        heading = math.atan2(radii[1] * math.cos(a) * walk.direction, -radii[0] * math.sin(a) * walk.direction)
        return np.asarray(at(x, y, 0.0, math.degrees(heading)) @ local, dtype=np.float64)

    return MovingBody(tuple(part for part, _ in parts), matrices, contact=tuple((k, 0.2) for k in range(4, 8)))


def _shell() -> list[Part]:
    brick = tx.Noise(tx.Brick((0.70, 0.40, 0.30), (0.88, 0.82, 0.74), 0.80, 0.40), 0.6, 0.06, seed=41)
    tiles = tx.Bands(
        tx.Diamonds((0.26, 0.50, 0.48), (0.38, 0.64, 0.58), (0.96, 0.88, 0.62), 0.8, 0.8),
        [(-6, 6, -3, -0.95, (0.86, 0.85, 0.80)), (-6, 6, -1.0, -0.88, (0.52, 0.36, 0.24))],
        soft=0.04,
    )
    steel = tx.Bands(
        tx.Stripes((0.44, 0.54, 0.66), (0.56, 0.66, 0.76), 0.5, soft=0.08),
        [(-6, 6, -0.15, 0.25, (0.94, 0.76, 0.20)), (-3.2, -1.4, -2, 0.6, (0.62, 0.30, 0.24))],
        soft=0.04,
    )
    plaster = tx.Spots(
        tx.Noise(tx.Gradient((0.58, 0.64, 0.50), (0.90, 0.88, 0.78), -2, 2), 0.7, 0.10, seed=43),
        [
            (-3.4, 0.3, 0.55, (0.90, 0.42, 0.26)),
            (-1.2, 0.7, 0.40, (0.22, 0.42, 0.70)),
            (1.4, 0.2, 0.60, (0.95, 0.80, 0.36)),
            (3.5, 0.6, 0.45, (0.46, 0.28, 0.52)),
        ],
        soft=0.06,
    )
    floor = tx.Noise(tx.Checker((0.62, 0.62, 0.60), (0.46, 0.47, 0.50), 0.5, soft=0.05), 0.5, 0.10, seed=44)
    beams = tx.Bands(
        tx.Noise(tx.Plain((0.80, 0.79, 0.76)), 0.9, 0.06, seed=45),
        [(-5, 5, y - 0.12, y + 0.12, (0.50, 0.36, 0.24)) for y in (-3.6, -1.2, 1.2, 3.6)],
        soft=0.06,
    )
    walls: dict[str, tx.Texture] = {"north": brick, "west": tiles, "east": steel, "south": plaster}
    return room_shell(_HALF_M, _HEIGHT_M, walls, floor, beams, glow=0.4)


def _mast() -> list[Part]:
    gray = tx.Plain((0.34, 0.35, 0.38))
    hazard = tx.Stripes((0.95, 0.76, 0.12), (0.16, 0.15, 0.15), 0.25, axis=1, soft=0.02)
    return [Part(Cylinder(0.07, 1.30), hazard, at(0, 0, 1.30)), Part(Box((0.32, 0.32, 0.04)), gray, at(0, 0, 0.04, 45))]


def _workshop() -> list[Part]:
    """Shelves, a bench, machines, pipes and pillars: something near in every direction."""
    oak = tx.Noise(tx.Plain((0.62, 0.42, 0.24)), 0.2, 0.12, seed=46, stretch=4.0)
    books = tx.Books(
        [(0.74, 0.20, 0.18), (0.16, 0.36, 0.56), (0.93, 0.78, 0.36), (0.24, 0.50, 0.34), (0.86, 0.84, 0.78)],
        (0.50, 0.33, 0.19),
        0.2,
        0.6,
    )
    plaid = tx.Plaid((0.24, 0.42, 0.40), (0.16, 0.30, 0.32), (0.66, 0.78, 0.70), 0.5, 0.5)
    crate = tx.Framed(
        tx.Stripes((0.80, 0.62, 0.36), (0.66, 0.46, 0.26), 0.2, axis=1), (0.50, 0.33, 0.18), (0.4, 0.4), 0.07
    )
    dice = tx.Checker((0.96, 0.80, 0.22), (0.30, 0.20, 0.42), 0.18)
    drum = tx.Stripes((0.20, 0.44, 0.62), (0.90, 0.88, 0.82), 0.35, axis=1, soft=0.04)
    pipe = tx.Stripes((0.82, 0.44, 0.28), (0.92, 0.80, 0.66), 0.5, axis=1, soft=0.05)
    globe = tx.Noise(tx.Checker((0.16, 0.42, 0.76), (0.90, 0.88, 0.70), 1 / 8, 0.5, 0.05), 0.3, 0.1, seed=47)
    leaf = tx.Noise(tx.Plain((0.26, 0.52, 0.22)), 0.2, 0.22, seed=48)
    pillar = tx.Brick((0.58, 0.60, 0.62), (0.40, 0.41, 0.44), 0.25, 0.5, 0.03)
    lamp = tx.Plain((0.98, 0.92, 0.76))
    parts = [
        Part(Box((1.2, 0.25, 1.2)), books, at(-2.8, 4.7, 1.2)),
        Part(Box((0.9, 0.25, 1.0)), books, at(1.5, -4.7, 1.0)),
        Part(Box((0.25, 0.8, 0.9)), dice, at(-4.72, -0.3, 0.9)),
        # A bench with a globe on it, a press, a sofa.
        Part(Box((0.45, 1.2, 0.05)), oak, at(4.4, 0.6, 0.85)),
        Part(Box((0.40, 1.1, 0.40)), plaid, at(4.4, 0.6, 0.40)),
        Part(Sphere(0.30), globe, at(4.3, 1.0, 1.20, 30)),
        Part(RoundCone(0.16, 0.07, 0.35), drum, at(4.35, 0.0, 1.05)),
        Part(Box((0.5, 0.5, 0.9)), plaid, at(3.9, -3.6, 0.9, 25)),
        Part(Cylinder(0.30, 0.35), drum, at(3.9, -3.6, 2.15)),
        # Crates and barrels.
        Part(Box((0.4, 0.4, 0.4)), crate, at(-3.9, -3.6, 0.4, 15)),
        Part(Box((0.3, 0.3, 0.3)), dice, at(-3.85, -3.55, 1.1, 40)),
        Part(Box((0.4, 0.4, 0.4)), crate, at(-2.9, -4.2, 0.4, -10)),
        Part(Cylinder(0.32, 0.5), drum, at(3.6, 4.2, 0.5)),
        Part(Cylinder(0.32, 0.5), pipe, at(2.8, 4.4, 0.5)),
        Part(
            Sphere(0.28), tx.Stripes((0.96, 0.96, 0.94), (0.90, 0.26, 0.20), 1 / 3, soft=0.03), at(-3.4, 1.4, 0.28, 40)
        ),
        Part(RoundCone(0.22, 0.28, 0.30), pipe, at(-4.3, 3.3, 0.22)),
        Part(Sphere(1.0), leaf, at(-4.3, 3.3, 1.25) @ np.diag([0.48, 0.48, 0.65, 1.0])),
        # Pipes under the ceiling, lamps from it.
        Part(Cylinder(0.12, 5.0), pipe, facing((0, 1, 0), (0, 0, 1), (0, -4.6, 3.3))),
        Part(Cylinder(0.12, 5.0), drum, facing((0, 0, 1), (1, 0, 0), (-4.6, 0, 3.2))),
        *(Part(Box((0.22, 0.22, 2.0)), pillar, at(x, y, 2.0)) for x in (-2.6, 2.6) for y in (-1.2, 1.2)),
    ]
    for x, y in ((-1.6, -3.4), (1.6, 3.4), (3.4, -1.9), (-3.5, 1.9)):
        parts.append(Part(Sphere(0.2), lamp, at(x, y, 3.3), casts_shadow=False, glow=0.4))
    return parts
