"""Small worlds of few parts, for tests of rendering and of effects."""

from __future__ import annotations

import dataclasses

import numpy as np

from camera_node.synthetic import Scene, make_scene
from camera_node.synthetic.effects import Effects, WorldEffect
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import MovingBody, Part
from camera_node.synthetic.render import World

# Ambient only: every surface shows its albedo.
FLAT_LIGHT = Light(np.array([[0.0, 0.0, 50.0]]), 0.0, 1.0, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))


def body(part: Part) -> MovingBody:
    """A body of one part that does not move."""
    return MovingBody((part,), lambda t_s: part.matrix[None])


def scene_of(world: World) -> Scene:
    """A scene without cameras."""
    return dataclasses.replace(make_scene("room", {"width": 8, "height": 8}), world=world, cameras={})


def with_effect(effect: WorldEffect | Effects, world: World) -> World:
    return effect.extend(scene_of(world)).world
