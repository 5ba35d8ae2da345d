"""Fog thins a surface's light by Koschmieder's law, over the distance along each ray."""

from __future__ import annotations

import math

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects.fog import Fog
from camera_node.synthetic.placement import Part, at
from camera_node.synthetic.render import CameraRenderer, World
from camera_node.synthetic.shapes import Sphere
from camera_node.synthetic.textures import Plain
from freshfield.geometry import Pinhole, look_at
from tests.camera_node.synthetic.worlds import FLAT_LIGHT as FLAT
from tests.camera_node.synthetic.worlds import body, with_effect

CAMERA = Pinhole.from_fov(65, 65, 40.0)
POSE = look_at([0.0, 0.0, 0.0], [0.0, 5.0, 0.0])
AIR = (1.0, 0.9, 0.7)


def make(**parameters) -> Fog:
    return Fog(**{"airlight": AIR, **parameters})


def foggy(world: World, **parameters) -> World:
    return with_effect(make(**parameters), world)


def ball(distance_m: float, color: float, radius: float = 0.5) -> Part:
    return Part(Sphere(radius), Plain((color,) * 3), at(0.0, distance_m, 0.0))


@pytest.mark.parametrize("distance_m", [1.0, 3.0, 6.0, 12.0])
@pytest.mark.parametrize("moving", [False, True])
def test_the_transmission_at_a_known_distance(distance_m, moving):
    """The nearest point of a dark ball, on the axis: what arrives, and the airlight for the rest."""
    part = ball(distance_m + 0.5, 0.06)
    world = World((), (body(part),), FLAT) if moving else World((part,), (), FLAT)
    image = CameraRenderer(foggy(world, visibility_m=6.0), CAMERA, POSE).image(0.0)
    arrives = 0.02 ** (distance_m / 6.0)  # 2 % at the visibility
    expected = [255 * (0.06 * arrives + a * (1 - arrives)) for a in AIR]
    assert image[32, 32] == pytest.approx(expected, abs=0.6)


@pytest.mark.parametrize(("visibility_m", "threshold"), [(6.0, 0.02), (40.0, 0.05)])
def test_koschmieder_s_constant(visibility_m, threshold):
    """3.912 / visibility at 2 %, 2.996 / visibility at 5 %."""
    haze = make(visibility_m=visibility_m, contrast_threshold=threshold)
    assert haze.extinction_per_m * visibility_m == pytest.approx({0.02: 3.912, 0.05: 2.996}[threshold], abs=5e-4)
    far = np.array([0.0, 0.5 * visibility_m, visibility_m, np.inf])
    assert haze.transmittance(far) == pytest.approx([1.0, threshold**0.5, threshold, 0.0], rel=1e-6)


def test_the_threshold_defines_the_visibility():
    world = World((ball(5.5, 0.0),), (), FLAT)
    image = CameraRenderer(foggy(world, visibility_m=5.0, contrast_threshold=0.05), CAMERA, POSE).image(0.0)
    # A black object at the visibility keeps that contrast: (air - object) / air.
    contrast = 1 - image[32, 32] / (255 * np.array(AIR))
    assert contrast == pytest.approx([0.05] * 3, abs=0.004)


def test_nothing_to_see_is_all_fog_and_the_distance_is_along_the_ray():
    world = foggy(World((), (), FLAT, (0.1, 0.2, 0.3)), visibility_m=1000.0)
    assert (CameraRenderer(world, CAMERA, POSE).image(0.0) == np.rint(255 * np.array(AIR))).all()
    # Everywhere in the room what arrives is decided by distance(), not by depth along the axis.
    scene = make_scene("room", {"width": 40, "height": 40, "supersample": 1, "speed_m_per_s": 0.0})
    clear, fog = scene.renderer("cam01"), make(visibility_m=5.0).extend(scene).renderer("cam01")
    arrives = np.exp(math.log(0.02) / 5.0 * clear.distance())[..., None]
    expected = clear.image(0.0) * arrives + 255 * np.array(AIR) * (1 - arrives)
    gap = np.abs(fog.image(0.0) - expected).max(axis=-1)
    still = gap < 1.5  # all but the person, who stands nearer than the wall that distance() knows of
    assert 0.75 < still.mean() < 1.0


def test_a_body_hides_the_fog_behind_it_whatever_the_order():
    near, far = ball(2.5, 0.9), ball(6.0, 0.1, radius=1.4)
    bodies = [body(near), body(far)]
    images = [
        CameraRenderer(foggy(World((), tuple(order), FLAT)), CAMERA, POSE).image(0.0)
        for order in (bodies, bodies[::-1])
    ]
    assert np.array_equal(*images)
    still = CameraRenderer(foggy(World((near, far), (), FLAT)), CAMERA, POSE).image(0.0)
    assert np.abs(images[0].astype(int) - still).max() <= 1
