"""The scenes as their users see them: cameras, bounds, motion, and what is refused. How they look is in ``golden``."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import SCENES, make_scene
from camera_node.synthetic.person import loop_length_m, make_walk, walking_person
from camera_node.synthetic.placement import MovingBody
from camera_node.synthetic.shapes import Box
from freshfield.geometry import Pinhole, Pose, look_at, world_rays
from freshfield.settings import ScenarioError

SMALL = {"width": 48, "height": 48, "supersample": 1}


@pytest.mark.parametrize(("name", "params"), [*((name, {}) for name in SCENES), ("tile", {"bench": True})])
def test_cameras_look_at_the_target_the_held_out_one_from_afar_and_all_they_see_is_in_bounds(name, params):
    scene = make_scene(name, {"count": 19, **SMALL, **params})
    assert list(scene.cameras) == [f"cam{k:02d}" for k in range(19)]
    axes = np.stack([pose[:3, 2] for _, pose in scene.cameras.values()])
    assert np.degrees(np.arccos(np.clip(axes[1:] @ axes[0], -1, 1))).min() >= 15.0
    for camera_id, (camera, pose) in scene.cameras.items():
        Pose.from_matrix(pose)
        to = np.asarray(scene.target) - pose[:3, 3]
        outward = -1.0 if name == "tower" else 1.0
        assert pose[:3, 2] @ to / np.linalg.norm(to) == pytest.approx(outward)
        origin, d = world_rays(camera, pose)
        t = scene.renderer(camera_id).distance()
        points = (origin + np.where(np.isfinite(t), t, 0.0)[..., None] * d)[np.isfinite(t)]
        assert (points >= scene.bounds[0] - 1e-6).all() and (points <= scene.bounds[1] + 1e-6).all()
        assert np.isfinite(t).all() or name == "tile"


@pytest.mark.parametrize("speed", [0.05, 1.0, 8.0])
def test_the_person_and_the_cart_move_at_the_speed_asked_for(speed):
    """Measured independently: middles of all parts, by finite differences over one period in seconds."""
    walk = make_walk((0.0, 1.0), (0.74, 0.54), speed)
    cart = make_scene("tower", {"speed_m_per_s": speed, **SMALL})
    deck = MovingBody(cart.world.moving_bodies[1].parts[:1], cart.world.moving_bodies[1].matrices)
    for body, period_s in ((walking_person(walk), walk.period_s), (deck, cart.period_s)):
        centers = []
        for k in range(401):
            m = body.matrices(period_s * k / 400)[: len(body.parts)]
            local = np.stack([p.shape.bounding_sphere()[0] for p in body.parts])
            centers.append((m[:, :3, :3] @ local[:, :, None])[:, :, 0] + m[:, :3, 3])
        meters = np.linalg.norm(np.diff(np.stack(centers), axis=0), axis=2).sum(axis=0).mean()
        assert meters / period_s == pytest.approx(speed, rel=0.03)
        assert np.allclose(centers[0], centers[-1], atol=1e-9), "it joins up at the end of the loop"


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("rooom", {}, "valid scenes: drawn_room, room, tile, tower"),
        ("room", {"people": 5}, "people: expected .*0 to 4"),
    ],
)
def test_an_invalid_scene_is_refused(name, params, message):
    with pytest.raises(ScenarioError, match=message):
        make_scene(name, params)


@pytest.mark.parametrize("name", ["room", "tower"])
def test_a_motion_that_is_drawn_follows_from_its_seed_alone(name):
    def seen(**params) -> np.ndarray:
        scene = make_scene(name, {"count": 3, **SMALL, **params})
        return np.concatenate([m.matrices(0.3).ravel() for m in scene.world.moving_bodies])

    own, *drawn = seen(), *(seen(motion_seed=seed) for seed in range(6))
    assert np.array_equal(seen(motion_seed=2), drawn[2])
    assert not any(np.allclose(one, other) for k, one in enumerate(drawn) for other in (own, *drawn[:k]))


def test_motions_that_are_drawn_differ_in_speed_direction_start_and_path_and_face_forward():
    walks = [make_walk((0.0, 0.95), (0.74, 0.54), 1.0, seed) for seed in range(40)]
    speeds = [loop_length_m(w) / w.period_s for w in walks]
    assert 0.68 < min(speeds) < 0.85 and 1.15 < max(speeds) < 1.42
    assert {w.direction for w in walks} == {1.0, -1.0}
    assert np.ptp([w.start_s / w.period_s for w in walks]) > 0.8
    assert np.ptp([w.center[0] for w in walks]) > 0.3 and np.ptp([w.radii[1] for w in walks]) > 0.15
    for walk in walks[:9]:
        step = np.subtract(walk.at(0.3 + 1e-6), walk.at(0.3 - 1e-6))
        assert np.allclose(step / np.linalg.norm(step), walk.heading(0.3), atol=1e-5)


@pytest.mark.parametrize(("name", "speed"), [("room", 8.0), ("tower", 8.0), ("drawn_room", 1.0)])
def test_motions_stay_within_the_bounds_off_the_cameras_and_out_of_the_furniture(name, speed):
    for seed in range(4):
        drawn = {"layout_seed" if name == "drawn_room" else "motion_seed": seed}
        scene = make_scene(name, {"speed_m_per_s": speed, **drawn, **SMALL})
        eyes = np.stack([pose[:3, 3] for _, pose in scene.cameras.values()])
        boxes = [p for p in scene.world.static_parts if isinstance(p.shape, Box) and p.shape.half[2] > 0.1]
        into = [(np.linalg.inv(p.matrix), np.array(p.shape.half)) for p in boxes]
        for body in scene.world.moving_bodies:
            for t in np.linspace(0, scene.period_s, 21):
                for part, m in zip(body.parts, body.matrices(t)):
                    center, radius = part.shape.bounding_sphere()
                    at = m[:3, :3] @ center + m[:3, 3]
                    assert (at + radius < scene.bounds[1]).all()
                    assert (at[:2] - radius > scene.bounds[0][:2]).all()
                    assert np.linalg.norm(eyes - at, axis=1).min() > radius + 0.3
                    for inverse, half in into:
                        assert (np.abs(inverse[:3, :3] @ at + inverse[:3, 3]) > half).any()


@pytest.mark.stability
@pytest.mark.parametrize("turns", [-1000, 208_333_333])  # the last is 1e9 seconds
def test_the_world_repeats_however_late_it_is(turns):
    scene = make_scene("room", SMALL)
    for t in (0.0, 0.3, 2.0, 4.7):
        early, late = scene.render("cam02", t), scene.render("cam02", t + turns * scene.period_s)
        # 1e9 s has a resolution of 1e-7 s: edges move by nanometers, a ray in a thousand may flip.
        assert (np.abs(early.astype(int) - late) > 2).mean() < 2e-3
    with pytest.raises(ValueError, match="finite"):
        scene.render("cam02", float("inf"))


@pytest.mark.stability
@pytest.mark.parametrize("fov", [5.0, 150.0])
@pytest.mark.parametrize("shape", [(64, 8), (8, 64)])
@pytest.mark.filterwarnings("error")
def test_extreme_lenses_and_sizes(fov, shape):
    params = {"width": shape[0], "height": shape[1], "horizontal_fov_deg": fov, "count": 2}
    for name in SCENES:
        assert make_scene(name, params).render("cam01", 0.5).shape == (shape[1], shape[0], 3)


@pytest.mark.stability
@pytest.mark.parametrize(
    ("eye", "target"),
    [
        ([0.0, 0.95, 1.2], [0.0, 3.0, 1.2]),  # within the walker's reach
        ([0.0, 0.5, 2.99], [0.0, 0.5, 0.0]),  # straight down, along the up vector
        ([0.0, 0.5, 0.0], [0.0, 0.5, 3.0]),  # in the floor's plane, straight up
        ([3.0, 3.0, 3.0], [-3.0, -3.0, 0.0]),  # in the corner where three planes meet
    ],
)
@pytest.mark.filterwarnings("error")
def test_cameras_in_awkward_places(eye, target):
    scene = make_scene("room", SMALL)
    renderer = scene.view(Pinhole.from_fov(48, 48, 80.0), look_at(eye, target))
    for t in np.arange(12) / 12 * scene.period_s:
        assert renderer.image(float(t)).shape == (48, 48, 3)
