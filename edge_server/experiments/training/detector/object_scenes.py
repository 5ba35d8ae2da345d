"""Training scenes of the detector of one object: the tile of scene ``tile`` among other things, with masks.

A seed gives one world: the tile without some of its parts, or (in one world of seven) no tile, with or
without a bench below, with boxes, cylinders, balls and plates around it, in varied light. It is seen from
several near and far viewpoints, some of which show the tile cut off by the image's edge, or not at all.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic import textures as tx
from camera_node.synthetic.camera_rig import on_sphere
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import Part, at, facing, place_static
from camera_node.synthetic.scene import Scene, make_scene
from camera_node.synthetic.scenes.tile import BOTTOM_M, object_parts
from camera_node.synthetic.shapes import Box, Cylinder, Quad, Shape, Sphere
from edge_server.experiments.training.detector.scenes import Boxes, boxes_of
from freshfield.geometry import Array, Pinhole, so3_exp

KINDS = ("tile",)
VIEWS = 8
# Shares of the worlds without the tile, and with a bench below it.
_ABSENT, _BENCH = 0.15, 0.8
# Shares of the tile's parts that are left out, and that get a random texture.
_LEFT_OUT, _REPAINTED = 0.15, 0.1
_HALF_M = (0.24, 0.18)  # half sizes of the tile's area, in which no other object is placed
_NEAR_M, _FAR_M = 0.28, 2.2
_AIM = 0.8  # the tile's center is within this share of the distance from the image's center to its edge
_OFF = 0.2  # share of the views that may look further aside
# Viewpoints of scenario ``cell``: of a hand that moves a camera round the tile.
_HAND_M, _HAND_FOV_DEG = 0.34, 75.0
_HAND_ANGLES_DEG = tuple((a, e) for e in (30, 52, 75) for a in range(-180, 180, 30))


@dataclass(frozen=True)
class ObjectShot:
    """One scene from several viewpoints."""

    scene: Scene
    views: Sequence[tuple[Pinhole, Array]]

    def take(self) -> tuple[NDArray[np.uint8], list[Boxes], NDArray[np.bool_]]:
        """Render the images (n, H, W, 3), the object's box in each that shows it, and its masks (n, H, W)."""
        images = np.stack([self.scene.view(lens, pose).image(0.0) for lens, pose in self.views])
        masks = np.stack([self.scene.object_mask(lens, pose) for lens, pose in self.views])
        return images, [boxes_of(np.where(mask, 0, -1), [0]) for mask in masks], masks


def own_shots(side: int) -> dict[str, ObjectShot]:
    """The shipped tile: from its own rig, and from a hand in ``cell`` and on the bench of ``scan``. The
    detector is not trained on these."""
    size = {"width": side, "height": side}
    rig = make_scene("tile", {"count": 19, **size})
    lens = Pinhole.from_fov(side, side, _HAND_FOV_DEG)
    hand = [(lens, on_sphere(rig.target, _HAND_M, a, e)) for a, e in _HAND_ANGLES_DEG]
    bench = make_scene("tile", {"count": 19, "bench": True, **size})
    return {
        "tile": ObjectShot(rig, list(rig.cameras.values())),
        "cell": ObjectShot(rig, hand),
        "scan": ObjectShot(bench, hand),
        "scan, from its rig": ObjectShot(bench, list(bench.cameras.values())),
    }


def variation(seed: int, purpose: str, side: int) -> ObjectShot:
    """The world of a seed. ``purpose`` separates training and held-out worlds of equal seeds."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, *purpose.encode()]))
    scene = make_scene("tile", {"count": 1, "width": side, "height": side})
    tile = [] if rng.random() < _ABSENT else _tile(rng)
    others = _others(rng, bool(tile))
    world = dataclasses.replace(
        scene.world, static_parts=(*tile, *others), light=_light(rng, scene.world.light), background=_color(rng)
    )
    scene = dataclasses.replace(scene.with_world(world), object_parts=len(tile))
    return ObjectShot(scene, [_viewpoint(rng, scene, side) for _ in range(VIEWS)])


def _tile(rng: np.random.Generator) -> list[Part]:
    """The carrier, and most of the parts on it."""
    first, *rest = object_parts()
    kept = [first, *(part for part in rest if rng.random() >= _LEFT_OUT)]
    return [dataclasses.replace(part, texture=_texture(rng)) if rng.random() < _REPAINTED else part for part in kept]


def _others(rng: np.random.Generator, around_tile: bool) -> list[Part]:
    """Bench, walls and other objects. around_tile: keep the tile's area free."""
    found = []
    if rng.random() < _BENCH:
        half = rng.uniform(0.3, 1.4, 2)
        found.append(Part(Box((half[0], half[1], 0.02)), _texture(rng), at(0, 0, BOTTOM_M - 0.02)))
        for turn in rng.choice(4, int(rng.integers(0, 3)), replace=False):
            a = 0.5 * math.pi * float(turn)
            out = np.array([math.cos(a), math.sin(a), 0.0])
            along = (-out[1], out[0], 0.0)
            middle = out * rng.uniform(0.6, 1.6) + (0.0, 0.0, 0.5)
            wall = facing((-along[0], -along[1], 0.0), (0.0, 0.0, 1.0), tuple(middle))
            found.append(Part(Quad((2.0, 1.2)), _texture(rng), wall, casts_shadow=False))
    for _ in range(int(rng.integers(0, 13))):
        shape, lift = _shape(rng)
        reach = shape.bounding_sphere()[1]
        for _ in range(20):
            x, y = rng.uniform(-0.9, 0.9, 2)
            if not around_tile or abs(x) - reach > _HALF_M[0] or abs(y) - reach > _HALF_M[1]:
                found.append(Part(shape, _texture(rng), at(x, y, BOTTOM_M + lift, rng.uniform(0, 360))))
                break
    return found


def _shape(rng: np.random.Generator) -> tuple[Shape, float]:
    """A box, plate, cylinder or ball on the bench, and the height of its center above the bench."""
    which = int(rng.integers(4))
    if which == 0:
        a, b, c = rng.uniform(0.02, 0.13, 3)
        return Box((a, b, 0.6 * c)), 0.6 * c
    if which == 1:
        a, b, c = rng.uniform((0.04, 0.04, 0.005), (0.24, 0.18, 0.03))
        return Box((a, b, c)), c
    radius = rng.uniform(0.01, 0.07)
    if which == 2:
        half = radius * rng.uniform(0.3, 2.0)
        return Cylinder(radius, half), half
    return Sphere(radius), radius


def _light(rng: np.random.Generator, light: Light) -> Light:
    """The light with three of its points, displaced, and a random strength and tint."""
    points = light.points[rng.choice(len(light.points), 3, replace=False)]
    dim = rng.uniform(0.6, 1.1)

    def tinted(color: tuple[float, ...]) -> tx.Color:
        r, g, b = np.array(color) * dim * rng.uniform(0.85, 1.1, 3)
        return float(r), float(g), float(b)

    return dataclasses.replace(
        light,
        points=points + rng.uniform((-0.4, -0.4, -0.2), (1.0, 1.0, 0.6)),
        strength=light.strength * rng.uniform(0.5, 1.4),
        tint=tinted(light.tint),
        ambient_below=tinted(light.ambient_below),
        ambient_above=tinted(light.ambient_above),
    )


def _color(rng: np.random.Generator) -> tx.Color:
    """A random color, or nearly gray."""
    r, g, b = rng.uniform(0.05, 0.98, 3) if rng.random() < 0.5 else rng.uniform(0.1, 0.95) * rng.uniform(0.9, 1.1, 3)
    return min(float(r), 1.0), min(float(g), 1.0), min(float(b), 1.0)


def _texture(rng: np.random.Generator) -> tx.Texture:
    """A random texture: plain, brushed, striped, checkered, boards or bricks."""
    one, other, size = _color(rng), _color(rng), float(rng.uniform(0.02, 0.12))
    made: list[tx.Texture] = [
        tx.Plain(one),
        tx.Noise(tx.Plain(one), 0.04, 0.12, seed=int(rng.integers(1000)), stretch=float(rng.uniform(1, 5))),
        tx.Stripes(one, other, size, int(rng.integers(2)), 0.1 * size),
        tx.Checker(one, other, size, soft=0.1 * size),
        tx.Planks(one, other, 2.0 * size, 12.0 * size),
        tx.Brick(one, other, 3.0 * size, size, 0.1 * size),
    ]
    return made[int(rng.integers(len(made)))]


def _viewpoint(rng: np.random.Generator, scene: Scene, side: int) -> tuple[Pinhole, Array]:
    """A random camera above the bench, outside of all objects."""
    placed = place_static([p for p in scene.world.static_parts if not isinstance(p.shape, Quad)])
    while True:
        lens = Pinhole.from_fov(side, side, float(rng.uniform(36, 80)))
        distance = float(np.exp(rng.uniform(math.log(_NEAR_M), math.log(_FAR_M))))
        pose = on_sphere(scene.target, distance, rng.uniform(-180, 180), rng.uniform(6, 88))
        apart = np.linalg.norm(placed.centers - pose[:3, 3], axis=1) if len(placed.parts) else np.ones(1)
        # Wide parts (bench, tile) are not tested: a camera is never inside them, but inside their spheres.
        if not ((apart < placed.radii + 0.02) & (placed.radii < 0.2)).any():
            break
    half = math.atan(_AIM * 0.5 * side / lens.fx)
    right, down = rng.uniform(-half, half, 2) * (2.2 if rng.random() < _OFF else 1.0)
    roll = rng.uniform(-math.pi, math.pi) if rng.random() < 0.3 else rng.normal(0.0, 0.1)
    pose = pose.copy()
    pose[:3, :3] = pose[:3, :3] @ so3_exp((0.0, right, 0.0)) @ so3_exp((down, 0.0, 0.0)) @ so3_exp((0.0, 0.0, roll))
    return lens, pose
