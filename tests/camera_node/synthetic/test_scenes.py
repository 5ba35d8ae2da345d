"""Scenes as their users see them, their frames on disk, depth against geometry that the renderer does not use, and how
scenes look: five small views of each beside the images in ``golden``, so that figures measured on a scene stay figures
of that scene. After a wanted change:

    python -m tests.camera_node.synthetic.test_scenes
"""

import dataclasses
import os
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node import node_constants as tuned
from camera_node.synthetic import SCENES, frame_cache, make_scene
from camera_node.synthetic import source as source_module
from camera_node.synthetic.depth import DepthRenderer
from camera_node.synthetic.frame_cache import prune
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.person import loop_length_m, make_walk, walking_person
from camera_node.synthetic.placement import MovingBody, Part, at, facing
from camera_node.synthetic.render import CameraRenderer, Image, World
from camera_node.synthetic.shapes import Box, Cylinder, Quad, RoundCone, Sphere, nearest_hit
from camera_node.synthetic.source import WorldSource
from camera_node.synthetic.textures import Checker, Plain
from freshfield import payload
from freshfield.geometry import Pinhole, Pose, look_at, world_rays
from tests.support import refused

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


def test_walks_that_are_drawn_differ_in_speed_and_direction_and_face_forward():
    walks = [make_walk((0.0, 0.95), (0.74, 0.54), 1.0, seed) for seed in range(16)]
    assert make_walk((0.0, 0.95), (0.74, 0.54), 1.0, 7) == walks[7]
    speeds = [loop_length_m(w) / w.period_s for w in walks]
    assert 0.68 < min(speeds) < 0.85 and 1.15 < max(speeds) < 1.42 and {w.direction for w in walks} == {1.0, -1.0}
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
    refused(ValueError, "finite", scene.render, "cam02", float("inf"))


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


def room(**changes):
    """Its people walk round in 0.6 s: few frames."""
    return make_scene("room", {"width": 32, "height": 32, "supersample": 1, "speed_m_per_s": 8.0, **changes})


def source(scene=None, fps=15, camera="cam01", **options) -> WorldSource:
    return WorldSource("eye", scene or room(), camera, fps, **options)


def files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def test_a_frame_is_the_scene_at_its_instant_for_ever(tmp_path):
    scene = room()
    made = source(scene, folder=tmp_path)
    for tick in (0, 1, 8, 9, 10, 9 * 10**12 + 4):
        expected = payload.encode(scene.render("cam01", (tick % 9) / 15), "jpeg", 92)
        assert made.read(made.content(tick)).image == made.read(tick).image == expected
    endless = source(fps=29.97, folder=tmp_path / "endless")
    endless.prepare(lambda: False)
    t_s = float(Fraction(1000) / Fraction(2997, 100))
    assert endless.read(endless.content(1000)).image == payload.encode(scene.render("cam01", t_s), "jpeg", 92)
    assert files(tmp_path / "endless") == [], "what does not repeat is rendered as it goes"


@pytest.mark.parametrize("codec", payload.CODECS)
def test_prepared_once_nothing_is_rendered_again(tmp_path, codec, monkeypatch):
    first = source(codec=codec, folder=tmp_path)
    first.prepare(lambda: len(files(tmp_path)) >= 3)
    assert len(files(tmp_path)) == 3
    first.prepare(lambda: False)
    again = source(codec=codec, folder=tmp_path)
    monkeypatch.setattr(again, "_render", None)
    again.prepare(lambda: False)
    assert [again.read(k).image for k in range(9)] == [first.read(k).image for k in range(9)]


@pytest.mark.parametrize("damage", [b"", b"\xff\xd8\xff\xe0" * 200])
def test_a_damaged_entry_is_rendered_again_and_a_folder_that_cannot_be_written_costs_only_time(tmp_path, damage):
    source(folder=tmp_path).prepare(lambda: False)
    victim = files(tmp_path)[3]
    whole = victim.read_bytes()
    victim.write_bytes(damage)
    assert source(folder=tmp_path).read(3).image == whole == victim.read_bytes()
    blocked = source(folder=victim)
    for _ in range(2):
        assert blocked.read(3).image == whole and "Not a directory" in blocked.cache.error
        blocked.prepare(lambda: False)


def test_the_key_follows_all_that_decides_the_bytes(monkeypatch):
    base = source().key()
    assert source(fps=15.0).key() == source(room(count=5)).key() == base
    others = [source(**change) for change in ({"camera": "cam02"}, {"fps": 30}, {"codec": "png"}, {"quality": 80})]
    others += [source(phase_ns=1), source(room(supersample=2)), source(room(horizontal_fov_deg=50.0))]
    assert len({base, *(made.key() for made in others)}) == len(others) + 1
    monkeypatch.setattr(source_module, "renderer_version", lambda: "another renderer")
    assert source().key() != base


def test_the_first_frame_a_process_writes_makes_room_and_the_longest_unused_goes_first(tmp_path, monkeypatch):
    for k in range(4):
        folder = tmp_path / f"{k:032x}"
        folder.mkdir()
        (folder / "000000.jpeg").write_bytes(bytes(1000))
        os.utime(folder, (1000 + k, 1000 + k))
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "weights").write_bytes(bytes(10**5))
    assert prune(tmp_path, keep=tmp_path / f"{0:032x}", limit_bytes=2500) == 2000
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{0:032x}", f"{3:032x}", "models"]
    monkeypatch.setattr(frame_cache, "_pruned", set())
    monkeypatch.setattr(tuned, "RENDERED_DISK_BYTES", 1000)
    source(folder=tmp_path).prepare(lambda: False)
    assert not (tmp_path / f"{0:032x}").exists() and len(files(tmp_path)) == 9 + 2


GOLDEN = Path(__file__).parent / "golden"
SHOWN = {
    "drawn_room": ("drawn_room", {"layout_seed": 2}),
    "room": ("room", {"people": 2}),
    "tower": ("tower", {}),
    "tile": ("tile", {}),
    "bench": ("tile", {"bench": True}),
}
VIEWS = (("cam00", 0.0), ("cam04", 1.3), ("cam08", 2.9), ("cam12", 5.0), ("cam05", 3.7))


def views(name: str, later_s: float = 0.0) -> Image:
    """Five views of a scene, side by side."""
    kind, params = SHOWN[name]
    scene = make_scene(kind, {**params, "width": 96, "height": 72})
    return np.hstack([scene.render(camera, t_s + later_s) for camera, t_s in VIEWS])


@pytest.mark.parametrize("name", SHOWN)
def test_a_scene_looks_as_it_did(name):
    """Of the instants the nearest counts at each pixel, to a level of gray."""
    golden = cv2.imread(str(GOLDEN / f"{name}.png"))[..., ::-1].astype(np.int16)
    off = np.full(golden.shape[:2], 255)
    # A ray that just hits or misses a moving part does the other a nanosecond earlier or later, as on another kind of
    # processor, which rounds the last bits differently.
    for later_s in (0.0, 1e-9, -1e-9):
        off = np.minimum(off, np.abs(views(name, later_s).astype(np.int16) - golden).max(axis=2))
        if (off > 1).sum() <= 3:
            return
    pytest.fail(f"{(off > 1).sum()} pixels differ")


# Their surfaces, edges, corners and axes lie on the grid of origins below.
SOLIDS = [
    Sphere(0.5),
    Box((0.5, 0.3, 0.7)),
    Cylinder(0.4, 0.6),
    RoundCone(0.4, 0.1, 0.9),
    RoundCone(0.2, 0.4, 0.3),
    RoundCone(0.3, 0.3, 0.6),
]


@pytest.mark.stability
@pytest.mark.parametrize("shape", [*SOLIDS, Quad((0.5, 0.5))], ids=repr)
@pytest.mark.filterwarnings("error")
def test_rays_along_the_axes_from_everywhere_are_finite_or_miss(shape):
    """Origins on a grid that holds the surfaces, edges, corners, axes and center of every shape."""
    axes = np.concatenate([np.eye(3), -np.eye(3)]).T
    steps = np.array([-2.0, -0.7, -0.5, -0.3, 0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.9, 2.0])
    for origin in np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3):
        t = nearest_hit(shape, origin[:, None], axes)
        assert not np.isnan(t).any() and (t > 0).all()
        hit = np.isfinite(t)
        if hit.any():
            normal, uv = shape.surface(origin[:, None] + t[hit] * axes[:, hit])
            assert np.isfinite(normal).all() and np.isfinite(uv).all()


# Ambient only: every surface shows its albedo.
FLAT = Light(np.array([[0.0, 0.0, 50.0]]), 0.0, 1.0, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
WHITE = Plain((1.0, 1.0, 1.0))


@pytest.mark.stability
@pytest.mark.parametrize("shape", SOLIDS, ids=repr)
@pytest.mark.filterwarnings("error")
def test_a_camera_inside_a_shape_sees_its_inside(shape):
    light = Light(np.array([[0.0, 0.0, 5.0]]), 0.5, 3.0, (0.4,) * 3, (0.6,) * 3)
    world = World((Part(shape, Checker((0.2,) * 3, (0.9,) * 3, 0.1)),), (), light)
    pose = look_at([0.01, 0.02, 0.05], [0.3, 0.2, 0.1])
    renderer = CameraRenderer(world, Pinhole.from_fov(32, 32, 90.0), pose)
    assert np.isfinite(renderer.distance()).all()
    assert renderer.image(0.0).min() > 0


@pytest.mark.stability
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("z", [0.0, 0.5, 0.499])
def test_a_light_inside_or_on_a_surface_does_no_harm(z):
    light = Light(np.array([[0.0, 0.0, z]]), 0.8, 3.0, (0.1,) * 3, (0.2,) * 3)
    world = World((Part(Sphere(0.5), Checker((0.2,) * 3, (0.9,) * 3, 0.1)),), (), light)
    pose = look_at([0.0, -2.0, 1.0], [0.0, 0.0, 0.0])
    assert CameraRenderer(world, Pinhole.from_fov(32, 32, 40.0), pose).image(0.0).max() > 0


def test_depth_is_z_at_pixel_centers_of_parts_that_stand_and_move_and_0_where_nothing_is():
    lens = dataclasses.replace(Pinhole.from_fov(64, 48, 60.0), distortion=(-0.25, 0.06, 0.004, -0.003))
    pose = look_at([0.0, -3.0, 1.0], [0.0, 0.0, 1.0])  # looks along +y
    wall = Part(Quad((50.0, 50.0)), WHITE, facing((1, 0, 0), (0, 0, 1), (0, 1, 0)))
    ball = Part(Sphere(0.3), WHITE)
    moving = MovingBody((ball,), lambda t_s: at(t_s, 0.0, 1.0)[None])
    behind = MovingBody((ball,), lambda t_s: at(t_s, 3.0, 1.0)[None])  # never seen: behind the wall
    renderer = DepthRenderer(World((wall,), (behind, moving), FLAT), lens, pose)
    for t_s in (0.0, 0.8, -0.8, 0.0):
        depth = renderer.depth(t_s)
        u, v = lens.project(np.array([t_s, 0.0, 3.0])).astype(int)
        assert depth.dtype == np.float32 and depth[v, u] == pytest.approx(2.7, abs=0.03)
        # A ball of .3 m at 3 m: pi (.3 f / 3)^2 pixels.
        assert (depth < 3.9).sum() == pytest.approx(np.pi * (0.1 * lens.fx) ** 2, rel=0.15)
        assert np.allclose(depth[depth > 3.1], 4.0, atol=1e-5)
    assert not DepthRenderer(World((), (), FLAT), lens, pose).depth(0.0).any()


if __name__ == "__main__":
    for scene in SHOWN:
        cv2.imwrite(str(GOLDEN / f"{scene}.png"), views(scene)[..., ::-1])
