"""Training scenes of the detector: variations of the shipped worlds, with exact bounding boxes.

A seed gives one variation: a shipped scene without some of its furniture, with people, carts, balls and drums
on random paths, seen by one camera. The kind of an object follows from its shape: a figure is a person, a
sphere a ball, a cylinder of drum-like proportions a drum. A box encloses the visible pixels.
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
from camera_node.synthetic.person import make_walk, walking_person
from camera_node.synthetic.placement import MovingBody, Part, at, place_parts, place_static
from camera_node.synthetic.render import CameraRenderer, World, cast_rays
from camera_node.synthetic.scene import Scene, make_scene
from camera_node.synthetic.shapes import Cylinder, Quad, Shape, Sphere
from freshfield.geometry import Array, Pinhole, look_at, world_rays

KINDS = ("person", "cart", "ball", "drum")
# Least side and area, in visible pixels, of a box.
MIN_SIDE_PX, MIN_PIXELS = 5, 20
# Range of height over width of a cylinder that is a drum, not a pole or a coin.
_DRUM_PROPORTIONS = (0.4, 3.0)
_PRESENT = 0.75  # share of the furniture that a variation keeps
_SHARES = {"room": 0.45, "tower": 0.35, "tile": 0.20}

Boxes = NDArray[np.float32]
"""(n, 5): left, top, right, bottom in pixels (right and bottom exclusive), number of the kind."""


@dataclass(frozen=True)
class Shot:
    """One camera in one world. kinds: for each moving body its index in KINDS."""

    world: World
    camera: Pinhole
    camera_to_world: Array
    kinds: tuple[int, ...]
    supersample: int = 2

    def take(self, instants_s: Sequence[float]) -> tuple[NDArray[np.uint8], list[Boxes]]:
        """Render images (n, H, W, 3) and the boxes in each."""
        renderer = CameraRenderer(self.world, self.camera, self.camera_to_world, self.supersample)
        origin, rays = world_rays(self.camera, self.camera_to_world)
        rays = np.ascontiguousarray(rays.reshape(-1, 3).T)
        statics = place_static(self.world.static_parts)
        limit, still = cast_rays(origin, rays, statics, np.full(rays.shape[1], np.inf))
        still_kinds = [kind_of(p.shape, p.matrix) for p in self.world.static_parts]
        images, boxes = [], []
        for t_s in instants_s:
            t, owner = limit, np.where(still >= 0, still, -1).astype(np.int64)
            for k, mover in enumerate(self.world.moving_bodies):
                t, which = cast_rays(origin, rays, place_parts(mover.parts, mover.matrices(t_s)), t)
                owner[which >= 0] = len(still_kinds) + k
            images.append(renderer.image(t_s))
            shape = (self.camera.height, self.camera.width)
            boxes.append(boxes_of(owner.reshape(shape), [*still_kinds, *self.kinds]))
        return np.stack(images), boxes


def kind_of(shape: Shape, matrix: Array) -> int | None:
    """Index of the kind of a single part, by its shape; None for furniture."""
    stretch = np.linalg.norm(matrix[:3, :3], axis=0)
    if isinstance(shape, Sphere) and np.ptp(stretch) < 0.05 * stretch.max():
        return KINDS.index("ball")
    if isinstance(shape, Cylinder) and _DRUM_PROPORTIONS[0] <= shape.half_height / shape.radius <= _DRUM_PROPORTIONS[1]:
        return KINDS.index("drum")
    return None


def boxes_of(owner: NDArray[np.int64], kinds: Sequence[int | None]) -> Boxes:
    """Boxes of the visible objects. owner: (H, W), the index into ``kinds`` of the object that each pixel
    shows, -1 for none."""
    found = []
    for thing in np.unique(owner):
        kind = kinds[thing] if thing >= 0 else None
        if kind is None:
            continue
        rows, columns = np.nonzero(owner == thing)
        box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        if min(box[2] - box[0], box[3] - box[1]) >= MIN_SIDE_PX and len(rows) >= MIN_PIXELS:
            found.append((*box, kind))
    return np.array(found, dtype=np.float32).reshape(-1, 5)


def own_rig(name: str, camera: str, side: int) -> Shot:
    """A camera of the shipped scene; the detector is not trained on these."""
    scene = make_scene(name, {"count": 19, "width": side, "height": side})
    kinds = {"room": ("person",), "tower": ("person", "cart"), "tile": ()}[name]
    return Shot(scene.world, *scene.cameras[camera], tuple(KINDS.index(k) for k in kinds))


def _base_scene(seed: int, purpose: str) -> tuple[str, np.random.Generator]:
    rng = np.random.default_rng(np.random.SeedSequence([seed, *purpose.encode()]))
    return str(rng.choice(list(_SHARES), p=list(_SHARES.values()))), rng


def variation(seed: int, purpose: str, side: int) -> tuple[Shot, np.random.Generator]:
    """The shot of a seed, and the generator to draw its instants from. ``purpose`` separates training and
    held-out worlds of equal seeds."""
    name, rng = _base_scene(seed, purpose)
    scene = make_scene(name, {"count": 1, "width": side, "height": side})
    statics = tuple(p for p in scene.world.static_parts if isinstance(p.shape, Quad) or rng.random() < _PRESENT)
    things = _small_things(rng) if name == "tile" else _things(rng, name)
    light = scene.world.light
    world = dataclasses.replace(
        scene.world,
        static_parts=statics,
        moving_bodies=tuple(mover for _, mover in things),
        light=dataclasses.replace(light, strength=light.strength * rng.uniform(0.7, 1.2)),
    )
    camera = Pinhole.from_fov(side, side, float(rng.uniform(38, 48) if name == "tile" else rng.uniform(50, 85)))
    pose = _viewpoint(rng, name, scene, [mover for _, mover in things])
    return Shot(world, camera, pose, tuple(KINDS.index(kind) for kind, _ in things)), rng


def _things(rng: np.random.Generator, name: str) -> list[tuple[str, MovingBody]]:
    """People, carts, balls and drums on the floor of a room or workshop."""
    reach = 1.6 if name == "room" else 3.4

    def somewhere() -> tuple[float, float]:
        while True:
            x, y = rng.uniform(-reach, reach, 2)
            y += 0.6 if name == "room" else 0.0
            if name == "room" or math.hypot(x, y) > 1.2:  # a workshop's cameras stand in its middle
                return float(x), float(y)

    found: list[tuple[str, MovingBody]] = []
    for _ in range(rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2])):
        walk = make_walk(somewhere(), (rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.9)), 1.0)
        found.append(("person", walking_person(walk)))
    if rng.random() < 0.5:
        cart = make_scene("tower", {"count": 1}).world.moving_bodies[1]
        x, y = somewhere()
        found.append(("cart", _moved(cart, at(x, y, 0.0, rng.uniform(0, 360)) @ at(0.0, -2.9, 0.0))))
    for _ in range(rng.choice([0, 1, 2, 3], p=[0.25, 0.35, 0.25, 0.15])):
        x, y = somewhere()
        found.append(_thing(rng, (x, y, rng.uniform(0.0, 1.2)), rng.uniform(0.12, 0.45), 0.5))
    return found


def _small_things(rng: np.random.Generator) -> list[tuple[str, MovingBody]]:
    """Balls and drums of the size of a bolt or a probe, above the tile."""
    return [
        _thing(rng, (*rng.uniform((-0.2, -0.15), (0.2, 0.15)), 0.06), rng.uniform(0.018, 0.06), 0.05)
        for _ in range(rng.integers(0, 4))
    ]


def _thing(
    rng: np.random.Generator, place_m: tuple[float, float, float], size_m: float, path_m: float
) -> tuple[str, MovingBody]:
    """A ball or a drum in random colors that circles ``place_m`` and rotates."""
    kind = str(rng.choice(["ball", "drum"]))
    tall = rng.uniform(0.7, 1.8)
    shape: Shape = Sphere(size_m) if kind == "ball" else Cylinder(size_m * 0.8, size_m * 0.8 * tall)
    spin, tilt, phase = rng.uniform(-180, 180), rng.uniform(-25, 25), rng.uniform(0, 2 * math.pi)
    a = math.radians(tilt)
    lean = np.eye(4)
    lean[1:3, 1:3] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
    x, y, z = place_m
    lift = size_m * (1.0 if kind == "ball" else 0.8 * tall)

    def matrices(t_s: float) -> Array:
        turn = phase + 2 * math.pi * t_s / 3.0
        where = at(x + path_m * math.cos(turn), y + path_m * math.sin(turn), z + lift, spin * t_s)
        return np.asarray(where @ lean, dtype=np.float64)[None]

    return kind, MovingBody((Part(shape, _texture(rng)),), matrices)


def _texture(rng: np.random.Generator) -> tx.Texture:
    def color() -> tx.Color:
        r, g, b = rng.uniform(0.08, 0.98, 3)
        return float(r), float(g), float(b)

    period = float(rng.choice([1 / 3, 1 / 4, 1 / 6]))
    made: list[tx.Texture] = [
        tx.Plain(color()),
        tx.Stripes(color(), color(), period, soft=0.04),
        tx.Checker(color(), color(), 1 / 8, 0.5, 0.05),
    ]
    return made[int(rng.integers(len(made)))]


def _moved(mover: MovingBody, matrix: Array) -> MovingBody:
    return dataclasses.replace(mover, matrices=lambda t_s: np.asarray(matrix @ mover.matrices(t_s)))


def _viewpoint(rng: np.random.Generator, name: str, scene: Scene, movers: Sequence[MovingBody]) -> Array:
    """A random camera pose of the scene; half of the poses look towards a moving body."""
    target = np.asarray(scene.target, dtype=np.float64)
    if name == "tile":
        aim = target + rng.uniform((-0.12, -0.1, -0.02), (0.12, 0.1, 0.02))
        return on_sphere(aim, rng.uniform(0.55, 1.0), rng.uniform(-180, 180), rng.uniform(12, 82))
    if movers and rng.random() < 0.5:
        seen = movers[int(rng.integers(len(movers)))].matrices(0.0)[:, :3, 3].mean(axis=0)
        target = seen + rng.uniform(-0.5, 0.5, 3)
    elif name == "tower":
        a = rng.uniform(0, 2 * math.pi)
        target = target + 3.0 * np.array([math.cos(a), math.sin(a), rng.uniform(-0.5, 0.3)])
    else:
        target = target + rng.uniform(-0.5, 0.5, 3)
    if name == "room":  # its walls are transparent from outside
        return on_sphere(target, rng.uniform(2.2, 3.6), rng.uniform(-75, 75), rng.uniform(3, 42))
    eye = np.asarray(scene.target) + rng.uniform((-0.7, -0.7, -0.5), (0.7, 0.7, 0.5))
    return look_at(eye, target)
