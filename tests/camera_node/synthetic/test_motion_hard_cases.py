"""Hard cases of the world in time: huge and negative instants, every speed, extreme cameras."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import SCENES, make_scene
from camera_node.synthetic.effects import NAMES, load_effects
from camera_node.synthetic.source import WorldSource
from freshfield.geometry import Pinhole, Pose, look_at

pytestmark = pytest.mark.stability

SMALL = {"width": 40, "height": 40, "supersample": 1}
# Every effect there is, with what is slow by default made coarser.
EFFECTS = {**dict.fromkeys(NAMES), "motion_blur": {"samples": 3}, "clock_drift": {"drift_ppm": 50.0}}


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


@pytest.mark.parametrize("t", [np.nan, np.inf, -np.inf])
def test_what_is_no_instant_is_refused(t):
    with pytest.raises(ValueError, match="time must be finite"):
        make_scene("room", SMALL).render("cam01", t)


@pytest.mark.parametrize("speed", [0.0, 0.05, 0.7, 1.0, 8.0])
def test_every_speed_repeats_exactly_through_the_cache(speed):
    scene = make_scene("room", {**SMALL, "speed_m_per_s": speed})
    camera = WorldSource("eye", scene, "cam01", 15)
    assert camera.repeats_after is not None
    for k in (0, 7):
        assert camera.read(k).image == camera.read(k + 10**9 * camera.repeats_after).image


def test_a_faster_world_is_the_same_world_sooner():
    slow, fast = (make_scene("room", {**SMALL, "speed_m_per_s": v}) for v in (1.0, 2.0))
    for phase in (0.1, 0.6):
        a = slow.render("cam02", phase * slow.period_s).astype(int)
        b = fast.render("cam02", phase * fast.period_s).astype(int)
        assert (np.abs(a - b) > 8).mean() < 0.01


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


@pytest.mark.slow
def test_all_effects_at_once_for_a_thousand_frames():
    made = load_effects(EFFECTS, lambda name: np.random.default_rng(2))
    scene = make_scene("room", {"width": 16, "height": 16, "supersample": 1, "speed_m_per_s": 8.0})
    camera = WorldSource("eye", scene, "cam01", 15, effects=made)
    pose = Pose.from_matrix(scene.cameras["cam01"][1])
    means, stamp = [], 0
    for k in range(1000):
        image = camera.read(camera.content(k)).image
        assert isinstance(image, np.ndarray) and image.shape == (16, 16, 3)
        means.append(image.mean())
        now = made.node_ns(10**18 + k * 66_666_667)
        assert now > stamp
        stamp = now
        far_m = np.subtract(made.reported_pose(pose, k).translation_m, pose.translation_m)
        assert np.abs(far_m).max() < 0.05
    assert np.ptp(means) < 90 and np.isfinite(means).all()
    # Nothing accumulates: two swings of the exposure, 20 s each, are as two others.
    assert abs(np.mean(means[:300]) - np.mean(means[600:900])) < 1.0
