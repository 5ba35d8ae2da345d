"""Moving parts cast the same shadows as static ones."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects import load_effects
from camera_node.synthetic.effects.shadows import Shadows
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import Part, at
from camera_node.synthetic.render import CameraRenderer, World
from camera_node.synthetic.shapes import Box, Quad, Sphere
from camera_node.synthetic.textures import Checker, Plain
from freshfield.geometry import Pinhole, look_at, se3_inverse
from tests.camera_node.synthetic.worlds import body, with_effect

LAMPS = Light(np.array([[0.0, 0.0, 3.0], [0.4, 0.2, 3.0]]), 0.6, 10.0, (0.2,) * 3, (0.2,) * 3, (1.0, 0.9, 0.8))
CAMERA = Pinhole.from_fov(96, 72, 60.0)
POSE = look_at([2.0, -2.0, 2.5], [0.0, 0.0, 0.0])
FLOOR = Part(Quad((3.0, 3.0)), Checker((0.5, 0.7, 0.9), (0.9, 0.8, 0.6), 0.4))
RED = Plain((0.8, 0.1, 0.1))


def shadowed(world: World, opacity: float = 1.0, light_points: int = 0) -> World:
    return with_effect(Shadows(opacity=opacity, light_points=light_points), world)


def image(world: World, pose: np.ndarray = POSE) -> np.ndarray:
    return CameraRenderer(world, CAMERA, pose).image(0.0).astype(int)


@pytest.mark.parametrize("listed", [{}, {"specular": {"roughness": 0.4}}])
def test_a_body_s_shadow_is_that_of_the_same_static_part(listed):
    """Static shadows are what the renderer always had: the reference. With specular, highlights go as
    well."""
    ball, box = Part(Sphere(0.4), RED, at(0.0, 0.0, 1.2)), Part(Box((0.2, 0.3, 0.3)), RED, at(-0.7, 0.3, 0.3))
    made = load_effects(listed, lambda name: np.random.default_rng(0))

    def lit(world: World) -> World:
        return with_effect(made, world)

    still = image(lit(World((FLOOR, ball, box), (), LAMPS)))
    moving = image(lit(shadowed(World((FLOOR,), (body(ball), body(box)), LAMPS))))
    assert np.abs(moving - still).max() <= 1
    among = image(lit(shadowed(World((FLOOR, box), (body(ball),), LAMPS))))  # a shadow falls on both kinds
    assert np.abs(among - still).max() <= 1
    assert np.abs(image(lit(World((FLOOR,), (body(ball), body(box)), LAMPS))) - still).max() > 40


def test_a_known_point_in_the_shadow_keeps_the_ambient_light():
    white = dataclasses.replace(FLOOR, texture=Plain((1.0, 1.0, 1.0)))
    one = dataclasses.replace(LAMPS, points=LAMPS.points[:1])
    world = World((white,), (body(Part(Sphere(0.4), RED, at(0.0, 0.0, 1.2))),), one)
    u, v = CAMERA.project((se3_inverse(POSE) @ [0.0, 0.0, 0.0, 1.0])[:3]).astype(int)
    assert image(shadowed(world))[v, u] == pytest.approx([51, 51, 51], abs=1)  # .2 of white
    lit = image(world)[v, u]
    # Straight below: .6 / (1 + 9 / 100) of the tint on top.
    assert lit == pytest.approx(255 * np.minimum(0.2 + 0.6 / 1.09 * np.array([1.0, 0.9, 0.8]), 1), abs=1)
    half = image(shadowed(world, opacity=0.5))[v, u]
    assert half == pytest.approx((51 + lit) / 2, abs=1)
    assert np.array_equal(image(shadowed(world, opacity=0.0)), image(world))


def test_two_lamps_make_a_penumbra():
    """Behind the ball both lamps are hidden, beside it one."""
    white = dataclasses.replace(FLOOR, texture=Plain((1.0, 1.0, 1.0)))
    world = World((white,), (body(Part(Sphere(0.2), RED, at(0.0, 0.0, 1.0))),), LAMPS)
    lost = image(world) - image(shadowed(world))
    levels = np.unique(lost[..., 0][lost[..., 0] > 20])
    assert levels.size and (np.diff(levels) > 20).sum() == 1  # two clusters: one lamp, both lamps


def test_fewer_points_of_the_light_stand_for_all():
    """One of two lamps: where both are hidden as much is lost; where only the other one is, nothing."""
    white = dataclasses.replace(FLOOR, texture=Plain((1.0, 1.0, 1.0)))
    world = World((white,), (body(Part(Sphere(0.2), RED, at(0.0, 0.0, 1.0))),), LAMPS)
    plain, all_of_it, half = image(world), image(shadowed(world)), image(shadowed(world, light_points=1))
    lost, lost_of_one = plain - all_of_it, plain - half
    umbra = lost[..., 0] > 0.9 * lost[..., 0].max()
    assert umbra.sum() > 3 and np.abs(lost_of_one - lost)[umbra].max() <= 0.05 * lost.max()
    seen = np.unique(lost_of_one[..., 0][lost_of_one[..., 0] > 20])
    assert seen.size and (np.diff(seen) > 20).sum() == 0  # no penumbra
    assert np.array_equal(image(shadowed(world, light_points=2)), all_of_it)
    assert np.array_equal(image(shadowed(world, light_points=1000)), all_of_it)


def test_what_casts_no_shadow_casts_none():
    ghost = Part(Sphere(0.4), RED, at(0.0, 0.0, 1.2), casts_shadow=False)
    world = World((FLOOR,), (body(ghost),), LAMPS)
    plain, shadows = image(world), image(shadowed(world))
    floor = np.isfinite(CameraRenderer(World((FLOOR,), (), LAMPS), CAMERA, POSE).distance())
    u, v = CAMERA.project((se3_inverse(POSE) @ [0.0, 0.0, 0.0, 1.0])[:3]).astype(int)
    assert floor[v, u] and np.array_equal(plain[v, u], shadows[v, u])


def test_a_light_among_the_moving_parts_does_no_harm():
    around = Part(Sphere(0.5), RED, at(0.0, 0.0, 3.0))
    assert image(shadowed(World((FLOOR,), (body(around),), LAMPS))).max() > 0


def test_the_person_of_the_room_darkens_what_is_behind_and_nothing_gets_brighter():
    scene = make_scene("room", {"width": 48, "height": 48, "supersample": 1})
    shadows = Shadows().extend(scene)
    gap = shadows.render("cam00", 1.0).astype(int) - scene.render("cam00", 1.0)
    person = np.abs(scene.render("cam00", 1.0).astype(int) - scene.render("cam00", 3.0)).max(axis=-1) > 8
    assert gap[~person].max() <= 1 and (gap.min(axis=-1) < -6).mean() > 0.01
    assert np.array_equal(shadows.render("cam00", 1.0), shadows.render("cam00", 1.0))
    rows = shadows.renderer("cam00").image(1.0, (20, 33))
    assert np.array_equal(rows, shadows.render("cam00", 1.0)[20:33])
