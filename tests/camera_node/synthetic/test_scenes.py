"""The scenes as their users see them: names, cameras, bounds, motion, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import SCENES, make_scene
from camera_node.synthetic.person import loop_length_m, make_walk
from camera_node.synthetic.scenes.tile import object_parts
from camera_node.synthetic.shapes import Box
from freshfield.geometry import Pinhole, Pose, look_at, world_rays
from freshfield.settings import ScenarioError

SMALL = {"width": 48, "height": 48}
TINY = {"width": 40, "height": 40, "supersample": 1}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("count", [1, 13])
def test_cameras_are_named_posed_and_look_at_the_target(name, count):
    scene = make_scene(name, {"count": count, **SMALL})
    assert list(scene.cameras) == [f"cam{k:02d}" for k in range(count)]
    for camera, pose in scene.cameras.values():
        Pose.from_matrix(pose)
        assert (camera.width, camera.height) == (48, 48)
        to = np.asarray(scene.target) - pose[:3, 3]
        outward = -1.0 if name == "tower" else 1.0
        assert pose[:3, 2] @ to / np.linalg.norm(to) == pytest.approx(outward)


@pytest.mark.parametrize("name", SCENES)
def test_the_held_out_camera_is_15_degrees_from_every_other(name):
    scene = make_scene(name, {"count": 19, **SMALL})
    axes = np.stack([pose[:3, 2] for _, pose in scene.cameras.values()])
    angles = np.degrees(np.arccos(np.clip(axes[1:] @ axes[0], -1, 1)))
    assert angles.min() >= 15.0


@pytest.mark.parametrize("name", SCENES)
def test_everything_seen_lies_within_the_bounds(name):
    scene = make_scene(name, {"count": 19, **SMALL, "supersample": 1})
    for camera_id, (camera, pose) in scene.cameras.items():
        origin, d = world_rays(camera, pose)
        t = scene.renderer(camera_id).distance()
        points = (origin + np.where(np.isfinite(t), t, 0.0)[..., None] * d)[np.isfinite(t)]
        assert (points >= scene.bounds[0] - 1e-6).all() and (points <= scene.bounds[1] + 1e-6).all()
        assert np.isfinite(t).all() or name == "tile"


def test_on_the_bench_the_tile_alone_is_the_object():
    plain, bench = (make_scene("tile", {"count": 5, "supersample": 1, **SMALL, "bench": b}) for b in (False, True))
    assert len(bench.world.static_parts) > len(plain.world.static_parts) == len(object_parts())
    for name, (lens, pose) in plain.cameras.items():
        origin, rays = world_rays(lens, pose)
        shown, t = plain.renderer(name).distance(), bench.renderer(name).distance()
        alone = np.isfinite(shown)
        assert (alone & (t > shown - 1e-9)).sum() > 0.9 * alone.sum(), "something may stand before it"
        points = (origin + np.where(np.isfinite(t), t, 0.0)[..., None] * rays)[np.isfinite(t)]
        assert len(points) > 1.5 * alone.sum()
        assert (points >= bench.bounds[0] - 1e-6).all() and (points <= bench.bounds[1] + 1e-6).all()


@pytest.mark.parametrize("speed", [0.4, 4.0])
def test_the_cart_of_the_tower_moves_at_the_speed_asked_for(speed):
    scene = make_scene("tower", {"speed_m_per_s": speed, **SMALL})
    cart = scene.world.moving_bodies[1]
    deck = np.stack([cart.matrices(t)[0] for t in np.arange(2000) / 2000 * scene.period_s])
    steps = np.diff(deck[:, :3, 3], axis=0, append=deck[:1, :3, 3])
    assert np.linalg.norm(steps, axis=1).sum() / scene.period_s == pytest.approx(speed, rel=1e-3)
    # It drives forwards: its long axis along the way.
    along = (steps / np.linalg.norm(steps, axis=1, keepdims=True) * deck[:, :3, 0]).sum(axis=1)
    assert along.min() > 0.99


@pytest.mark.parametrize("params", [{"speed_m_per_s": 0.0}, None])
def test_what_does_not_move_is_the_same_at_every_instant(params):
    scene = make_scene("room" if params else "tile", {**SMALL, **(params or {})})
    assert not scene.moving
    first = scene.render("cam00", 0.0)
    for t in (0.1, 3.21, 1e9, -5.0):
        assert np.array_equal(scene.render("cam00", t), first)


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("rooom", {}, "valid scenes: drawn_room, room, tile, tower"),
        ("room", {"people": 5}, "people: expected .*0 to 4"),
        ("room", {"count": 20}, "count: expected .*1 to 19"),
        ("tower", {"horizontal_fov_deg": 160}, "horizontal_fov_deg: expected .*5 to 150"),
        ("room", {"width": 5000}, "width: expected .*8 to"),
        ("room", {"speed_m_per_s": -1.0}, "speed_m_per_s: expected .*0 to 8"),
    ],
)
def test_an_invalid_scene_is_refused_in_one_line(name, params, message):
    with pytest.raises(ScenarioError, match=message) as error:
        make_scene(name, params)
    assert "\n" not in str(error.value)


def test_an_unknown_camera_is_refused_by_name():
    with pytest.raises(ScenarioError, match="no camera 'cam13'; it has cam00, cam01"):
        make_scene("room", SMALL).render("cam13", 0.0)


@pytest.mark.parametrize("name", ["room", "tower"])
def test_a_motion_that_is_drawn_follows_from_its_seed_alone(name):
    def seen(**params) -> np.ndarray:
        scene = make_scene(name, {"count": 3, "supersample": 1, **SMALL, **params})
        return np.concatenate([m.matrices(0.3).ravel() for m in scene.world.moving_bodies])

    own, drawn = seen(), [seen(motion_seed=seed) for seed in range(6)]
    assert np.array_equal(seen(motion_seed=2), drawn[2])
    for k, one in enumerate(drawn):
        assert not np.allclose(one, own) and not any(np.allclose(one, other) for other in drawn[:k])
    still = seen(speed_m_per_s=0.0)
    assert np.array_equal(seen(speed_m_per_s=0.0, motion_seed=4), still)
    with pytest.raises(ScenarioError, match=r"motion_seed: expected .*0"):
        seen(motion_seed=-1)


def test_motions_that_are_drawn_differ_in_speed_direction_start_and_path():
    walks = [make_walk((0.0, 0.95), (0.74, 0.54), 1.0, seed) for seed in range(40)]
    speeds = [loop_length_m(w) / w.period_s for w in walks]
    assert 0.68 < min(speeds) < 0.85 and 1.15 < max(speeds) < 1.42
    assert {w.direction for w in walks} == {1.0, -1.0}
    assert np.ptp([w.start_s / w.period_s for w in walks]) > 0.8
    assert np.ptp([w.center[0] for w in walks]) > 0.3 and np.ptp([w.radii[1] for w in walks]) > 0.15


def test_a_person_on_a_clockwise_walk_faces_forward():
    walk = next(w for s in range(9) if (w := make_walk((0.0, 1.0), (0.7, 0.5), 1.0, s)).direction < 0)
    for phase in np.linspace(0, 1, 13):
        step = np.subtract(walk.at(phase + 1e-6), walk.at(phase - 1e-6))
        assert np.allclose(step / np.linalg.norm(step), walk.heading(phase), atol=1e-5)


@pytest.mark.parametrize("name", ["room", "tower"])
def test_renderers_of_drawn_motions_share_what_stands_still_and_nothing_else(name):
    params = {"count": 2, "supersample": 1, **SMALL}
    scenes = [make_scene(name, {**params, "motion_seed": seed}) for seed in (1, 2)]
    images = [scene.render("cam01", 0.4) for scene in scenes]
    for scene, image in zip(scenes, images):
        assert np.array_equal(scene.view(*scene.cameras["cam01"]).image(0.4), image)
    assert not np.array_equal(*images)
    assert scenes[0].renderer("cam01")._static_colors is scenes[1].renderer("cam01")._static_colors
    assert make_scene(name, params).static_key is None  # nothing is kept where no motion is drawn


def test_rooms_are_drawn_from_their_seeds():
    def seen(seed):
        return make_scene("drawn_room", {**SMALL, "supersample": 1, "layout_seed": seed}).render("cam01", 0.4)

    rooms = [seen(seed) for seed in (1, 2, 101)]
    assert np.array_equal(seen(1), rooms[0])
    for k, one in enumerate(rooms):
        assert one.std() > 15.0 and all(np.abs(one.astype(int) - other).mean() > 20.0 for other in rooms[:k])


@pytest.mark.parametrize(
    "name, speed", [(n, v) for n in ("room", "tower") for v in (0.05, 8.0)] + [("drawn_room", 1.0)]
)
def test_motions_stay_within_the_bounds_off_the_cameras_and_out_of_the_furniture(name, speed):
    for seed in (None, *range(6)):
        layout = {"layout_seed": 0 if seed is None else seed + 1} if name == "drawn_room" else {}
        motion_seed = None if layout else seed
        scene = make_scene(name, {"speed_m_per_s": speed, "motion_seed": motion_seed, **layout, **SMALL})
        eyes = np.stack([pose[:3, 3] for _, pose in scene.cameras.values()])
        boxes = [p for p in scene.world.static_parts if isinstance(p.shape, Box) and p.shape.half[2] > 0.1]
        into = [(np.linalg.inv(p.matrix), np.array(p.shape.half)) for p in boxes]
        for body in scene.world.moving_bodies:
            for t in np.linspace(0, scene.period_s, 41 if seed is None else 21):
                for part, m in zip(body.parts, body.matrices(t)):
                    center, radius = part.shape.bounding_sphere()
                    at = m[:3, :3] @ center + m[:3, 3]
                    assert (at + radius < scene.bounds[1]).all()
                    assert (at[:2] - radius > scene.bounds[0][:2]).all()
                    assert np.linalg.norm(eyes - at, axis=1).min() > radius + 0.3
                    for inverse, half in into:
                        assert (np.abs(inverse[:3, :3] @ at + inverse[:3, 3]) > half).any()


@pytest.mark.stability
@pytest.mark.parametrize("turns", [-1000, 1, 208_333_333])  # the last is 1e9 seconds
def test_the_world_repeats_however_late_it_is(turns):
    scene = make_scene("room", TINY)
    for t in (0.0, 0.3, 2.0, 4.7):
        early, late = scene.render("cam02", t), scene.render("cam02", t + turns * scene.period_s)
        difference = np.abs(early.astype(int) - late)
        # 1e9 s has a resolution of 1e-7 s: edges move by nanometers, a ray in a thousand may flip.
        assert (difference > 2).mean() < 2e-3


@pytest.mark.stability
@pytest.mark.parametrize("t", [-0.1, 1e-300, 1e15])
def test_any_finite_instant_gives_a_sound_image(t):
    scene = make_scene("room", TINY)
    usual = scene.render("cam01", 1.0).mean()
    assert abs(scene.render("cam01", t).mean() - usual) < 10


@pytest.mark.stability
@pytest.mark.parametrize("fov", [5.0, 150.0])
@pytest.mark.parametrize("shape", [(8, 8), (64, 8), (8, 64)])
@pytest.mark.filterwarnings("error")
def test_extreme_lenses_and_sizes(fov, shape):
    params = {"width": shape[0], "height": shape[1], "horizontal_fov_deg": fov, "count": 2}
    for name in SCENES:
        image = make_scene(name, params).render("cam01", 0.5)
        assert image.shape == (shape[1], shape[0], 3)


@pytest.mark.stability
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
    scene = make_scene("room", TINY)
    renderer = scene.view(Pinhole.from_fov(48, 48, 80.0), look_at(eye, target))
    for t in np.arange(12) / 12 * scene.period_s:
        image = renderer.image(float(t))
        assert image.shape == (48, 48, 3)
