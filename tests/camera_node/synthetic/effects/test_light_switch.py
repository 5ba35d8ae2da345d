"""Lamps on one side go out for half of each period."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects.light_switch import LightSwitch
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.render import CameraRenderer

SMALL = {"count": 5, "width": 48, "height": 48, "supersample": 1}


def make(**parameters) -> LightSwitch:
    return LightSwitch(**parameters)


def left_of(light: Light, **parameters) -> Light:
    """What is left of it when the lamps are out."""
    switch = make(**parameters).extend(make_scene("room", SMALL)).world.switch
    assert switch is not None
    return switch.without(light)


def test_the_scene_is_lit_as_ever_and_then_without_the_lamps_of_one_side():
    scene = make_scene("room", SMALL)
    switched = make(period_s=2.0 * scene.period_s, azimuth_deg=0.0).extend(scene)
    assert switched.period_s == pytest.approx(2.0 * scene.period_s)
    on_s, off_s = 0.2 * scene.period_s, 1.2 * scene.period_s
    for camera in ("cam01", "cam04"):
        lit, dim = switched.render(camera, on_s), switched.render(camera, off_s)
        assert np.array_equal(lit, scene.render(camera, on_s))
        assert (dim.astype(int) <= scene.render(camera, off_s).astype(int) + 1).mean() > 0.95
        assert dim.mean() < lit.mean() - 5.0
        assert np.array_equal(lit, switched.render(camera, on_s))


def test_the_side_without_lamps_darkens_most():
    scene = make_scene("room", SMALL)
    light = scene.world.light
    east, west = (left_of(light, azimuth_deg=a) for a in (0.0, 180.0))
    assert east.points[:, 0].mean() < light.points[:, 0].mean() < west.points[:, 0].mean()
    for left in (east, west):
        assert left.point_color == pytest.approx(light.point_color)  # the lamps that stay are as bright


def test_one_lamp_stays_on():
    lone = Light(np.array([[0.0, 0.0, 3.0]]), 1.0, 2.0, (0.1, 0.1, 0.1), (0.1, 0.1, 0.1))
    assert len(left_of(lone, share=1.0).points) == 1


def test_rows_and_worlds_whose_bodies_move_otherwise_are_dim_too():
    scene = make_scene("room", SMALL)
    world = make(period_s=scene.period_s).extend(scene).world
    renderer = CameraRenderer(world, *scene.cameras["cam01"])
    dim = renderer.image(0.7 * scene.period_s)
    assert np.array_equal(renderer.image(0.7 * scene.period_s, (10, 20)), dim[10:20])
    assert np.array_equal(renderer.for_world(world).image(0.7 * scene.period_s), dim)
