"""The coat reflects as the microfacet model says: at known angles, both ways alike, no more than arrives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects.specular import Specular
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import Part
from camera_node.synthetic.render import CameraRenderer, World
from camera_node.synthetic.shapes import Quad
from camera_node.synthetic.textures import Plain
from freshfield.geometry import Pinhole, look_at
from tests.camera_node.synthetic.worlds import body, with_effect

UP = np.array([[0.0], [0.0], [1.0]])


def towards(polar_deg: float, azimuth_deg: float = 0.0) -> np.ndarray:
    p, a = math.radians(polar_deg), math.radians(azimuth_deg)
    return np.array([[math.sin(p) * math.cos(a)], [math.sin(p) * math.sin(a)], [math.cos(p)]])


def share(coat: Specular, light_deg: float, view_deg: float, azimuth_deg: float = 180.0) -> float:
    return float(coat.reflectance(towards(light_deg), UP, -towards(view_deg, azimuth_deg))[0])


@pytest.mark.parametrize("roughness", [0.1, 0.35, 1.0])
@pytest.mark.parametrize("angle", [0.0, 40.0, 75.0])
def test_the_peak_at_the_mirror_angle(roughness, angle):
    """There the half vector is the normal: D = 1 / (pi a^2), and Smith's masking has a closed form."""
    c = math.cos(math.radians(angle))
    sine_inside = math.sin(math.radians(angle)) / 1.5
    c_inside = math.sqrt(1 - sine_inside**2)
    perpendicular = ((c - 1.5 * c_inside) / (c + 1.5 * c_inside)) ** 2  # Fresnel's equations themselves
    parallel = ((1.5 * c - c_inside) / (1.5 * c + c_inside)) ** 2
    lambda_ = 0.5 * (math.sqrt(1 + roughness**2 * (1 / c**2 - 1)) - 1)
    masking = 1 / (1 + 2 * lambda_)
    expected = (0.5 * (perpendicular + parallel)) * masking / (4 * c * c) / roughness**2 * c
    assert share(Specular(1.5, roughness), angle, angle) == pytest.approx(expected, rel=1e-9)


def test_off_the_peak_it_falls_as_the_distribution_does():
    """Light straight above, seen from 2 x: the half vector leans by x, seen facets by cos x."""
    a, x = 0.2, math.radians(15.0)
    lean = math.tan(x) ** 2
    d = 1 / (a * a * math.cos(x) ** 4 * (1 + lean / a**2) ** 2)  # Walter's equation 33, times pi
    view = math.cos(2 * x)
    lambda_view = 0.5 * (math.sqrt(1 + a * a * (1 / view**2 - 1)) - 1)
    fresnel = float(Specular(1.5, a).fresnel(np.array([math.cos(x)]))[0])
    expected = d * fresnel / (1 + lambda_view) / (4 * view)
    assert share(Specular(1.5, a), 0.0, 30.0) == pytest.approx(expected, rel=1e-9)


def test_light_and_viewer_may_change_places():
    coat = Specular(1.6, 0.3)
    for light, view, azimuth in ((20, 60, 180), (5, 70, 90), (50, 10, 30)):
        there = share(coat, light, view, azimuth) / math.cos(math.radians(light))
        back = share(coat, view, light, azimuth) / math.cos(math.radians(view))
        assert there == pytest.approx(back, rel=1e-9)


@pytest.mark.parametrize("view", [0.0, 30.0, 60.0, 80.0])
@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
def test_no_more_is_reflected_than_arrives(view, roughness):
    """The integral of the reflectance times cosine over the hemisphere, for a coat that reflects nearly all
    of what meets a facet: at most 1, and seen from above what facets drawn by their slope would send up."""
    polar = np.deg2rad((np.arange(400) + 0.5) * 90 / 400)
    azimuth = np.deg2rad((np.arange(400) + 0.5) * 360 / 400)
    p, a = (m.ravel() for m in np.meshgrid(polar, azimuth))
    light = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)])
    n = light.shape[1]
    sent = Specular(50.0, roughness).reflectance(light, np.repeat(UP, n, 1), -np.repeat(towards(view), n, 1)) / np.pi
    whole = float((sent * np.sin(p)).sum() * (np.pi / 2 / 400) * (2 * np.pi / 400))
    assert whole <= 1.0
    if view == 0.0:
        u = (np.arange(100_000) + 0.5) / 100_000
        leans = 2 * np.arctan(roughness * np.sqrt(u / (1 - u)))  # twice the lean of a facet
        upwards = leans < np.pi / 2
        lambda_ = 0.5 * (np.sqrt(1 + roughness**2 * np.tan(leans) ** 2) - 1)
        facet = Specular(50.0, roughness).fresnel(np.cos(leans / 2))
        assert whole == pytest.approx(np.mean(np.where(upwards, facet / (1 + lambda_), 0.0)), rel=0.01)


def test_an_index_of_one_reflects_nothing_and_grazing_light_is_all_reflected():
    cosines = np.array([0.0, 0.3, 1.0])
    assert np.abs(Specular(1.0, 0.2).fresnel(cosines)).max() < 1e-12
    assert Specular(1.5, 0.2).fresnel(cosines)[[0, 2]] == pytest.approx([1.0, 0.04])


def test_light_from_below_gives_nothing():
    below = np.array([[0.0], [0.6], [-0.8]])
    assert Specular(1.5, 0.3).reflectance(below, UP, -towards(30.0))[0] == 0.0


LAMP = Light(np.array([[0.0, 1.5, 2.0]]), 0.8, 5.0, (0.1,) * 3, (0.1,) * 3, (1.0, 0.9, 0.8))


@pytest.mark.parametrize("moving", [False, True])
def test_the_highlight_stands_where_the_mirror_image_of_the_lamp_is(moving):
    """On a floor, seen from (0, -1.5, 2): halfway between; its value from the model at that point."""
    floor = Part(Quad((4.0, 4.0)), Plain((0.2, 0.2, 0.2)))
    world = World((), (body(floor),), LAMP) if moving else World((floor,), (), LAMP)
    coat = Specular(refractive_index=1.8, roughness=0.15)
    shiny = with_effect(coat, world)
    camera = Pinhole.from_fov(65, 65, 50.0)
    pose = look_at([0.0, -1.5, 2.0], [0.0, 0.0, 0.0])
    images = [CameraRenderer(w, camera, pose).image(0.0).astype(float) for w in (shiny, world)]
    highlight = images[0] - images[1]
    # The maximum is a little off the mirror point, because what is nearer to the lamp is brighter.
    v, u = np.unravel_index(highlight[..., 2].argmax(), highlight.shape[:2])
    assert abs(v - 32) <= 2 and abs(u - 32) <= 1
    angle = math.degrees(math.atan2(1.5, 2.0))
    strength = 0.8 / (1 + (1.5**2 + 2.0**2) / 25)
    expected = 255 * np.array([1.0, 0.9, 0.8]) * strength * share(coat, angle, angle)
    assert images[1][32, 32].max() + expected.max() < 250  # not cut off
    assert highlight[32, 32] == pytest.approx(expected, abs=1.5)


def test_highlights_move_with_the_viewer_and_only_brighten():
    scene = make_scene("room", {"width": 48, "height": 48, "supersample": 1})
    shiny = Specular().extend(scene)
    for camera in ("cam00", "cam05"):
        gap = shiny.render(camera, 0.4).astype(int) - scene.render(camera, 0.4)
        assert gap.min() >= -1 and (gap.max(axis=-1) > 4).mean() > 0.05
