"""Hard cases of the world in time: huge and negative instants, every speed, extreme cameras."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import SCENES, make_scene
from freshfield.geometry import Pinhole, look_at

pytestmark = pytest.mark.stability

SMALL = {"width": 40, "height": 40, "supersample": 1}


@pytest.mark.parametrize("turns", [1, 1000, 208_333_333])  # the last is 1e9 seconds
def test_the_world_repeats_however_late_it_is(turns):
    scene = make_scene("room", SMALL)
    for t in (0.0, 0.3, 2.0, 4.7):
        early, late = scene.render("cam02", t), scene.render("cam02", t + turns * scene.period_s)
        difference = np.abs(early.astype(int) - late)
        # 1e9 s has a resolution of 1e-7 s: edges move by nanometers, a ray in a thousand may flip.
        assert (difference > 2).mean() < 2e-3


@pytest.mark.parametrize("t", [-1e9, -0.1, 1e-300, 1e9, 1e15])
def test_any_finite_instant_gives_a_sound_image(t):
    scene = make_scene("room", SMALL)
    usual = scene.render("cam01", 1.0).mean()
    assert abs(scene.render("cam01", t).mean() - usual) < 10


@pytest.mark.parametrize("fov", [5.0, 150.0])
@pytest.mark.parametrize("shape", [(8, 8), (64, 8), (8, 64)])
@pytest.mark.filterwarnings("error")
def test_extreme_lenses_and_sizes(fov, shape):
    params = {"width": shape[0], "height": shape[1], "horizontal_fov_deg": fov, "count": 2}
    for name in SCENES:
        image = make_scene(name, params).render("cam01", 0.5)
        assert image.shape == (shape[1], shape[0], 3)


@pytest.mark.parametrize(
    ("eye", "target"),
    [
        ([0.0, 0.95, 1.2], [0.0, 3.0, 1.2]),  # within the walker's reach
        ([0.0, 0.5, 2.99], [0.0, 0.5, 0.0]),  # straight down, along the up vector
        ([0.0, 0.5, 0.0], [0.0, 0.5, 3.0]),  # in the floor's plane, straight up
        ([3.0, 3.0, 3.0], [-3.0, -3.0, 0.0]),  # in the corner where three planes meet
        ([0.0, -40.0, 2.0], [0.0, 0.0, 1.0]),  # outside
    ],
)
@pytest.mark.filterwarnings("error")
def test_cameras_in_awkward_places(eye, target):
    scene = make_scene("room", SMALL)
    renderer = scene.view(Pinhole.from_fov(48, 48, 80.0), look_at(eye, target))
    for t in np.arange(12) / 12 * scene.period_s:
        image = renderer.image(float(t))
        assert image.shape == (48, 48, 3)
