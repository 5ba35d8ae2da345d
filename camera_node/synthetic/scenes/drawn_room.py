"""Scene ``drawn_room``: a person walks in a furnished room that is drawn from a seed.

Size, textures, furniture, light, path, speed, lens and the cameras' arc differ from seed to seed. The rooms of some
seeds are for choosing defaults, those of others show what they are worth in a room that none was chosen on
(docs/studies.md). cam00, in the middle of the arc, is held out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import msgspec
import numpy as np

from camera_node.synthetic import textures as tx
from camera_node.synthetic.camera_rig import build_rig
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.person import make_walk, walking_person
from camera_node.synthetic.placement import Part, at
from camera_node.synthetic.render import World
from camera_node.synthetic.scene import Scene, pinhole
from camera_node.synthetic.scene_parameters import MAX_CAMERAS, MovingParams
from camera_node.synthetic.scenes.shell import room_shell
from camera_node.synthetic.shapes import Box, Cylinder, RoundCone, Shape, Sphere
from freshfield.geometry import Array
from freshfield.settings import within

_CLEAR_M = 0.45  # between furniture and the path of the person
_BEFORE_LENS_M = 0.9  # free before every camera
_TRIES = 40  # to find a free place for one piece of furniture
_ROWS_DEG = (6.0, 22.0, 38.0)  # elevations of the cameras
_SIDES = ("north", "west", "east", "south")


class Params(MovingParams, frozen=True, kw_only=True):
    """layout_seed: draws the room. speed_m_per_s is multiplied by the room's own factor of .6 to 1.5."""

    layout_seed: Annotated[int, within(0, 2**31, "draws the room")] = 1


def build(params: Params) -> Scene:
    """The room as a scene."""
    rng = np.random.default_rng([params.layout_seed, 0])
    half, height = float(rng.uniform(2.6, 3.6)), float(rng.uniform(2.5, 3.3))
    center, radii = (float(rng.uniform(-0.3, 0.3)), float(rng.uniform(0.5, 1.1))), rng.uniform(0.5, 0.95, 2)
    speed = params.speed_m_per_s * float(np.exp(rng.uniform(np.log(0.6), np.log(1.5))))
    walk = make_walk(center, (float(radii[0]), float(radii[1])), speed, params.motion_seed)
    direction, start = float(rng.choice([-1.0, 1.0])), float(rng.random())
    if params.motion_seed is None:
        walk = replace(walk, direction=direction, start_s=start * walk.period_s)
    target = (center[0], center[1] - 0.2, float(rng.uniform(0.75, 1.05)))
    radius = min(float(rng.uniform(2.6, 3.6)), half + target[1] - 0.15)
    params = msgspec.structs.replace(params, horizontal_fov_deg=float(rng.uniform(56.0, 72.0)))
    walls = {side: _wall(rng, half) for side in _SIDES}
    shell = room_shell(half, height, walls, _floor(rng), tx.Noise(tx.Plain(_pale(rng)), 0.8, 0.03), glow=0.4)
    lamps = np.stack(np.meshgrid([-0.9, 0.2, 1.1], [-1.0, 0.0, 1.0], [height - 0.05]), axis=-1).reshape(-1, 3)
    light = Light(
        points=lamps + np.append(rng.uniform(-0.6, 0.6, 2), 0.0),
        strength=float(rng.uniform(0.5, 0.95)),
        falloff_m=float(rng.uniform(3.0, 5.0)),
        tint=(1.0, float(rng.uniform(0.88, 1.0)), float(rng.uniform(0.75, 1.0))),
        ambient_below=(0.28, 0.28, 0.28),
        ambient_above=(float(rng.uniform(0.4, 0.55)),) * 3,
    )
    everywhere = build_rig(_angles(rng), target, radius, MAX_CAMERAS, pinhole(params))
    eyes = np.stack([pose[:2, 3] for _, pose in everywhere.values()])
    return Scene(
        name="drawn_room",
        params=params,
        cameras=dict(list(everywhere.items())[: params.count]),
        target=target,
        world=World(
            (*shell, *_pictures(rng, half), *_furniture(rng, half, center, radii, eyes)), (walking_person(walk),), light
        ),
        bounds=np.array([[-half, -half, 0.0], [half, half, height]]),
        period_s=walk.period_s,
        moving=not walk.still,
    )


def _angles(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Azimuth and elevation of the held-out camera and of three rows of six, in degrees."""
    widest = rng.uniform(55.0, 75.0)
    rows = [(a + rng.uniform(-4.0, 4.0), e + rng.uniform(-4.0, 4.0)) for e in _ROWS_DEG for a in _row(widest)]
    return [(0.0, 18.0), *((float(a), float(e)) for a, e in rows)]


def _row(widest_deg: float) -> Array:
    side = np.linspace(0.3, 1.0, 3) * widest_deg
    return np.concatenate([-side, side])


def _color(rng: np.random.Generator) -> tx.Color:
    full = rng.uniform(0.12, 0.95, 3)
    r, g, b = (full.mean() + 0.6 * (full - full.mean())).tolist()  # few things at home are of a pure color
    return r, g, b


def _pale(rng: np.random.Generator) -> tx.Color:
    r, g, b = (0.8 + 0.15 * rng.random(3)).tolist()
    return r, g, b


def _pattern(rng: np.random.Generator, size: float) -> tx.Texture:
    """One of the textures, with features of about ``size`` in the texture's coordinates."""
    a, b, c = _color(rng), _color(rng), _color(rng)
    kind = int(rng.integers(6))
    if kind == 0:
        return tx.Stripes(a, b, size, axis=int(rng.integers(2)), soft=0.05)
    if kind == 1:
        return tx.Checker(a, b, 0.5 * size)
    if kind == 2:
        return tx.Diamonds(a, b, c, size, 1.2 * size)
    if kind == 3:
        return tx.Plaid(a, b, c, size, size)
    if kind == 4:
        return tx.Noise(tx.Brick(a, b, 1.2 * size, 0.6 * size), 0.5, 0.05, seed=int(rng.integers(99)))
    return tx.Noise(tx.Plain(a), 0.7 * size, 0.25, seed=int(rng.integers(99)))


def _wall(rng: np.random.Generator, half: float) -> tx.Texture:
    """A pattern, now and then plain plaster, with a skirting board."""
    plain = rng.random() < 0.25
    base = tx.Noise(tx.Plain(_pale(rng)), 0.6, 0.05, seed=int(rng.integers(99))) if plain else _pattern(rng, 0.55)
    return tx.Bands(base, [(-half, half, -3.0, -1.1 - 0.3 * rng.random(), _color(rng))], soft=0.03)


def _floor(rng: np.random.Generator) -> tx.Texture:
    return tx.Planks(_color(rng), _color(rng), 0.3, 1.8) if rng.random() < 0.5 else _pattern(rng, 0.7)


def _pictures(rng: np.random.Generator, half: float) -> list[Part]:
    """Framed pictures on the walls that most cameras see."""
    parts = []
    for _ in range(int(rng.integers(2, 6))):
        side, along = str(rng.choice(_SIDES[:3])), float(rng.uniform(-0.6, 0.6)) * half
        w, h = float(rng.uniform(0.25, 0.6)), float(rng.uniform(0.25, 0.5))
        texture = tx.Framed(_pattern(rng, 0.3), _color(rng), (w, h), 0.05)
        up, deep = float(rng.uniform(1.4, 1.8)), half - 0.03
        if side == "north":
            parts.append(Part(Box((w, 0.03, h)), texture, at(along, deep, up)))
        else:
            parts.append(Part(Box((0.03, w, h)), texture, at(-deep if side == "west" else deep, along, up)))
    return parts


def _furniture(
    rng: np.random.Generator, half: float, center: tuple[float, float], radii: Array, eyes: Array
) -> list[Part]:
    """Boxes, cylinders, balls and cones on the floor, clear of the path and of each other."""
    parts: list[Part] = []
    taken: list[tuple[float, float, float]] = []
    for _ in range(int(rng.integers(7, 14))):
        shape, reach, up = _piece(rng)
        for _ in range(_TRIES):
            x, y = rng.uniform(-half + reach, half - reach), rng.uniform(-0.2 * half, half - reach)
            off = np.hypot(
                (x - center[0]) / (radii[0] + reach + _CLEAR_M), (y - center[1]) / (radii[1] + reach + _CLEAR_M)
            )
            # A piece close before a lens would hide the scene.
            far = np.hypot(*(eyes - [x, y]).T).min() > reach + _BEFORE_LENS_M
            if off > 1.0 and far and all(np.hypot(x - a, y - b) > reach + r for a, b, r in taken):
                taken.append((x, y, reach))
                parts.append(Part(shape, _pattern(rng, 0.25), at(x, y, up, float(rng.uniform(0, 90)))))
                break
    return parts


def _piece(rng: np.random.Generator) -> tuple[Shape, float, float]:
    """A shape, the radius of the floor that it takes, and the height of its center."""
    kind = int(rng.integers(4))
    if kind == 0:
        a, b, c = rng.uniform(0.15, 0.55, 3).tolist()
        c *= float(rng.choice([1.0, 1.8]))
        return Box((a, b, c)), float(np.hypot(a, b)), c
    radius = float(rng.uniform(0.12, 0.35))
    if kind == 1:
        tall = float(rng.uniform(0.2, 0.8))
        return Cylinder(radius, tall), radius, tall
    if kind == 2:
        return Sphere(radius), radius, radius
    tall = float(rng.uniform(0.2, 0.5))
    return RoundCone(radius, 0.6 * radius, tall), radius, radius
