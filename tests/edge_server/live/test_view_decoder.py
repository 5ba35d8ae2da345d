"""Frames as views, decoded once, with depth at the image's pixels; cameras that move, and their earlier viewpoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge_server.fields import Budget, View
from edge_server.live import depth_in_image as module
from edge_server.live.buffer import FrameBuffer
from edge_server.live.camera_motion import CameraMotion
from edge_server.live.depth_in_image import depth_in_image
from edge_server.live.field_updater import FieldUpdater
from edge_server.live.keyframes import Keyframes
from edge_server.live.view_decoder import ViewDecoder
from edge_server.scheduler import make_policy
from edge_server.settings import KeyframesConfig
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield.limits import MAX_DEPTH_POINTS, MOST_DEPTH_MOVED
from tests.edge_server.fields_for_tests import tiny_field
from tests.edge_server.frames import CAMERA, damaged_frame, frame


def test_a_frame_is_decoded_once_and_carries_the_edges_time():
    decoder = ViewDecoder()
    item = frame(generated_ns=5, clock_offset_ns=7, received_ns=20)
    (first,) = decoder.views([item])
    (second,) = decoder.views([item])
    assert first is second
    assert first.generated_ns == 12
    assert first.image.shape == (24, 32, 3)
    assert np.allclose(first.camera_to_world, item.pose.matrix())


def test_a_damaged_payload_is_counted_once_and_loses_nothing_else():
    decoder = ViewDecoder()
    items = [damaged_frame("cam01"), frame("cam02")]
    assert [v.camera for v in decoder.views(items)] == ["cam02"]
    assert [v.camera for v in decoder.views(items)] == ["cam02"]
    assert decoder.undecodable == 1


def test_a_large_image_is_decoded_smaller_and_whole_when_asked_for():
    item = frame()  # 32 x 24
    for most, size in ((768, (24, 32)), (767, (12, 16)), (1, (3, 4))):
        view = ViewDecoder(most_pixels=most).view(item)
        assert view.image.shape[:2] == size == (view.intrinsics.height, view.intrinsics.width)
        if size == (24, 32):
            assert view.whole is None
            continue
        whole = view.whole()
        assert whole.image.shape[:2] == (24, 32) and whole.whole is None
        np.testing.assert_allclose(
            view.intrinsics.rays([[1.0, 2.0]]), whole.intrinsics.rays([[32 / size[1], 2.0 * 24 / size[0]]])
        )


def test_depth_comes_with_its_view_and_with_its_own_time():
    counts = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
    sent = DepthImage(counts, 0.002, after_image_ns=-30).encode()
    item = frame(generated_ns=100, clock_offset_ns=7, depth=sent)
    view = ViewDecoder().view(item)
    np.testing.assert_array_equal(view.depth, counts * np.float32(0.002))
    assert view.depth.dtype == np.float32 and (view.generated_ns, view.depth_ns) == (107, 77)
    small = ViewDecoder(most_pixels=200).view(item)
    assert small.depth.shape == small.image.shape[:2] == (12, 16)
    np.testing.assert_array_equal(small.whole().depth, view.depth)
    plain = ViewDecoder().view(frame())
    assert plain.depth is None and plain.depth_ns is None


@pytest.mark.stability
def test_damaged_depth_costs_the_depth_and_not_the_image():
    sent = DepthImage(np.random.default_rng(0).integers(0, 9000, (24, 32), np.uint16), 0.001).encode()
    cut = replace(sent, payload=sent.payload[: len(sent.payload) // 2])
    cut.check(frame().intrinsics, 1)  # it passes at the door
    decoder = ViewDecoder(most_pixels=200)
    for _ in range(2):
        (view,) = decoder.views([item := frame(depth=cut)])
        decoder.views([item])
        assert view.image.shape == (12, 16, 3) and view.depth is None and view.whole().depth is None
    assert (decoder.undecodable, decoder.undecodable_depth) == (0, 2)
    assert decoder.view(damaged_frame(depth=sent)) is None
    assert (decoder.undecodable, decoder.undecodable_depth) == (1, 2)


IMAGE = Pinhole.from_fov(64, 48, 70.0)
SENSOR = Pinhole(80, 60, 70.0, 70.0, 41.0, 29.0)
BESIDE = Pose((1.0, 0.0, 0.0, 0.0), (0.06, -0.01, 0.02))  # of the sensor, right of the camera


def depth(counts, **other) -> DepthImage:
    return DepthImage(np.asarray(counts, np.uint16), 0.001, **other)


def box_before_wall(sensor: Pinhole, pose: Pose) -> np.ndarray:
    """Millimeters that a sensor measures of a wall at 3 m and a square of 60 cm at 1.5 m, camera axes."""
    rays = sensor.rays() @ pose.matrix()[:3, :3].T
    at = np.array(pose.translation_m)
    reached = {}
    for z in (1.5, 3.0):
        scale = (z - at[2]) / rays[..., 2]
        reached[z] = at + rays * scale[..., None]
    on_box = np.abs(reached[1.5][..., :2]).max(-1) < 0.3
    z = np.where(on_box, 1.5, 3.0) - at[2]  # the axes are parallel
    return np.round(1000 * z)


def moved_point_by_point(measured: DepthImage, image: Pinhole) -> np.ndarray:
    """The reference: each measured pixel at a time, the nearest wins."""
    out = np.zeros((image.height, image.width))
    rays = measured.intrinsics.rays()
    for row, column in np.argwhere(measured.counts > 0):
        ray = rays[row, column]
        point = ray / ray[2] * measured.counts[row, column] * measured.meters_per_count
        world = measured.to_camera.matrix() @ [*point, 1.0]
        u, v = np.floor(image.project(world[:3]))
        if 0 <= u < image.width and 0 <= v < image.height:
            old = out[int(v), int(u)]
            out[int(v), int(u)] = world[2] if old == 0 else min(old, world[2])
    return out


def test_registered_depth_is_taken_as_it_is_or_the_nearest_of_another_size():
    counts = np.arange(48 * 64).reshape(48, 64)
    np.testing.assert_allclose(depth_in_image(depth(counts), IMAGE, 0), counts * 0.001, rtol=1e-6)
    fine = np.arange(96 * 128).reshape(96, 128)
    np.testing.assert_allclose(depth_in_image(depth(fine), IMAGE, 0), fine[1::2, 1::2] * 0.001, rtol=1e-6)
    coarse = np.arange(24 * 32).reshape(24, 32) + 1
    expected = np.kron(coarse, np.ones((2, 2))) * 0.001
    np.testing.assert_allclose(depth_in_image(depth(coarse), IMAGE, 0), expected, rtol=1e-6)


@pytest.mark.parametrize("halvings", [1, 3])
def test_halved_images_see_the_same_depth(halvings):
    """A plane's depth is known at every pixel; odd sides are rounded up."""
    lens = replace(IMAGE, width=63, height=47)
    small = lens.halved(halvings)
    large_m, small_m = (2 / (1 + rays @ [0.3, 0.2, 0.0] / rays[..., 2]) for rays in (lens.rays(), small.rays()))
    found = depth_in_image(depth(np.round(1000 * large_m)), lens, halvings)
    assert found.shape == (small.height, small.width)
    assert np.abs(found / small_m - 1)[:-1, :-1].max() < 0.009  # half a measured pixel


def test_depth_of_a_lens_and_a_pose_of_its_own_is_moved_as_one_by_one():
    measured = depth(box_before_wall(SENSOR, BESIDE), intrinsics=SENSOR, to_camera=BESIDE)
    measured.counts[5:9, 50:60] = 0
    np.testing.assert_allclose(depth_in_image(measured, IMAGE, 0), moved_point_by_point(measured, IMAGE), rtol=1e-5)


@pytest.mark.stability
def test_hard_depth_gives_holes_and_no_warning():
    behind = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -100.0))
    turned = Pose((0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0))  # looks back
    far = np.full((60, 80), 65535)
    for counts, pose in ((np.zeros((60, 80)), BESIDE), (far, behind), (far, turned), (np.ones((60, 80)), behind)):
        with np.errstate(all="raise"):
            found = depth_in_image(depth(counts, intrinsics=SENSOR, to_camera=pose), IMAGE, 1)
        assert found.shape == (24, 32) and not found.any()
    found = depth_in_image(depth(far, intrinsics=SENSOR), IMAGE, 0)
    assert np.isfinite(found).all() and found.max() == np.float32(65.535)


@pytest.mark.stability
def test_a_lens_with_distortion_takes_in_only_what_it_sees():
    """Beyond its image this lens's model leads back into it: a wide sensor's points must not land there."""
    lens = replace(IMAGE, distortion=(-0.28, 0.07, 0.0, 0.0))
    wide = Pinhole.from_fov(200, 150, 150.0)
    rays = wide.rays()
    outside = np.hypot(rays[..., 0], rays[..., 1]) / rays[..., 2] > 1.5
    assert outside.any()
    found = depth_in_image(depth(np.where(outside, 500, 2000), intrinsics=wide), lens, 0)
    assert not (found == np.float32(0.5)).any() and (found == np.float32(2.0)).mean() > 0.5
    assert module._reach(IMAGE) == pytest.approx(np.hypot(32.0 / IMAGE.fx, 24.0 / IMAGE.fy))


@pytest.mark.stability
@pytest.mark.parametrize(
    ("side", "width", "height", "fov_deg", "step", "moved"),
    [
        (128, 1280, 1280, 70.0, 0, 1.02 * MAX_DEPTH_POINTS * 128**2),  # about as many as a small image has pixels
        (128, 1280, 1280, 175.0, 0, 1.02 * MAX_DEPTH_POINTS * 128**2),
        (1200, 848, 480, 70.0, 1, 848 * 480),  # what sensors measure at this size is moved whole
        (1200, 1280, 1280, 70.0, 2, MOST_DEPTH_MOVED),
    ],
)
def test_of_large_depth_few_points_are_moved_and_they_leave_no_gaps(side, width, height, fov_deg, step, moved):
    image, sensor = Pinhole.from_fov(side, side, 60.0), Pinhole.from_fov(width, height, fov_deg)
    module._kept.clear()
    found = depth_in_image(depth(np.full((height, width), 2000), intrinsics=sensor), image, 0)
    (rays,) = module._kept.values()
    assert 0.2 * moved < rays[..., 0].size <= moved
    inside = found[side // 3 : 2 * side // 3, side // 4 : 3 * side // 4]
    if side == 1200:
        assert rays.shape[:2] == (height // step, width // step)
        assert (inside == np.float32(2.0)).all()
    assert (inside == np.float32(2.0)).mean() > 0.97


@pytest.mark.stability
def test_lenses_that_differ_in_each_frame_do_not_fill_the_memory(monkeypatch):
    counts = np.full((60, 80), 2000)
    rays_bytes = 60 * 80 * 12
    monkeypatch.setattr(module, "MAX_DEPTH_RAYS_BYTES", 3 * rays_bytes)
    module._kept.clear()
    lenses = [replace(SENSOR, cx=40.0 + 0.01 * k) for k in range(9)]
    for lens in lenses:
        for each in (lens, lenses[0]):  # the first is used all the time, and stays
            assert (depth_in_image(depth(counts, intrinsics=each), IMAGE, 0) > 0).mean() > 0.6
    kept = [lens for lens, _, _ in module._kept]
    assert kept == [*lenses[-2:], lenses[0]]
    monkeypatch.setattr(module, "MAX_DEPTH_RAYS_BYTES", rays_bytes - 1)
    assert (depth_in_image(depth(counts, intrinsics=lenses[1]), IMAGE, 0) > 0).mean() > 0.6
    assert not module._kept


LENS = Pinhole.from_fov(8, 8, 60.0)


def view(camera, degrees, t_ms, radius_m=1.0, value=0):
    a = np.deg2rad(degrees)
    pose = look_at([radius_m * np.sin(a), -radius_m * np.cos(a), 0.5], [0, 0, 0])
    return View(camera, np.full((8, 8, 3), value, np.uint8), pose, LENS, t_ms * 1_000_000)


def names(views):
    return [v.camera for v in views]


def test_earlier_viewpoints_follow_the_newest_view_and_are_as_they_were():
    kept = Keyframes(KeyframesConfig(apart_m=0.1))
    first, second = view("hand", 0, 0, value=1), view("hand", 20, 1, value=2)
    kept.with_earlier([first])
    given = kept.with_earlier([second, view("still", 0, 1)])
    assert given[0] is second and names(given) == ["hand", "still", "hand#0"]
    earlier = given[2]
    assert earlier.image is first.image and earlier.generated_ns == 0
    assert np.array_equal(earlier.camera_to_world, first.camera_to_world)
    # The same objects come again, so that a field need not look at them again.
    assert kept.with_earlier([second])[1] is earlier


def test_a_place_seen_again_is_seen_anew():
    kept = Keyframes(KeyframesConfig(apart_m=0.1, apart_deg=8.0))
    for t_ms, degrees in enumerate((0, 20, 2)):  # the third is where the first was
        given = kept.with_earlier([view("hand", degrees, t_ms, value=t_ms)])
    assert names(given) == ["hand", "hand#1"] and len(kept) == 2
    given = kept.with_earlier([view("hand", 40, 3)])
    assert [v.image[0, 0, 0] for v in given[1:]] == [2, 1]
    for degrees, places in ((7.9, 1), (8.1, 2)):
        kept = Keyframes(KeyframesConfig(apart_m=1.0, apart_deg=8.0))
        for t_ms, turned in enumerate((0, degrees)):
            kept.with_earlier([view("hand", turned, t_ms)])
        assert len(kept) == places


@pytest.mark.parametrize("step_deg", [0.3, 4.0])
def test_a_slow_camera_leaves_as_many_viewpoints_behind_as_a_fast_one(step_deg):
    kept = Keyframes(KeyframesConfig(most=48, apart_m=0.1, apart_deg=8.0))
    walked = [view("hand", degrees, t_ms) for t_ms, degrees in enumerate(np.arange(0.0, 120.0, step_deg))]
    for each in walked:
        given = kept.with_earlier([each])
    # A viewpoint each tenth of a meter or so, of the two meters walked.
    assert 15 <= len(kept) <= 21
    places = np.array([v.camera_to_world[:3, 3] for v in given])
    for each in walked:  # nothing that it passed is forgotten, the start neither
        assert np.linalg.norm(places - each.camera_to_world[:3, 3], axis=1).min() < 0.1
    # Back the same way: no more viewpoints, and every picture a newer one.
    for t_ms, each in enumerate(walked[::-1]):
        given = kept.with_earlier([replace(each, generated_ns=(1000 + t_ms) * 1_000_000)])
    assert len(kept) <= 21 and min(v.generated_ns for v in given) >= 1_000_000_000


def test_the_oldest_gives_way():
    kept = Keyframes(KeyframesConfig(most=3, apart_m=0.01))
    for t_ms in range(10):
        given = kept.with_earlier([view("hand", 15 * t_ms, t_ms)])
        assert len(kept) == min(3, t_ms + 1)
    assert sorted(v.generated_ns for v in given) == [7_000_000, 8_000_000, 9_000_000]
    kept.clear()
    assert len(kept.with_earlier([view("hand", 0, 11)])) == 1


def test_a_field_of_few_viewpoints_is_begun_anew_when_they_double_and_a_resumed_one_never():
    kept = Keyframes(KeyframesConfig())
    counts = (1, 1, 2, 3, 4, 4, 7, 9, 15, 16, 18, 40)
    assert [n for n in counts if kept.should_restart(n)] == [2, 4, 9, 18]
    kept.clear()
    assert [n for n in (1, 2) if kept.should_restart(n)] == [2]
    assert not any(Keyframes(KeyframesConfig(), resumed=True).should_restart(n) for n in counts)
    many = Keyframes(KeyframesConfig())  # a rig of twenty is no beginning
    assert not any(many.should_restart(n) for n in (20, 40, 80))


def test_updates_hand_them_to_the_field_and_report_frames_only():
    policy = make_policy("all", None, np.random.default_rng(0))
    u = FieldUpdater(FrameBuffer(["hand"]), policy, tiny_field(), 0, keyframes=Keyframes(KeyframesConfig()))
    given, fit, reset = [], u.field.fit, u.field.reset

    def watched(views, budget):
        given.append(names(views))
        return replace(fit(views, budget), refused=("hand#0", "hand"))

    u.field.fit = watched
    u.field.reset = lambda: given.append("reset") or reset()
    for k in range(3):
        assert names(_update(u, k)) == ["hand"]
    assert given == [["hand"], "reset", ["hand", "hand#0"], ["hand", "hand#0", "hand#1"]]
    u.reset()
    _update(u, 3)
    assert given[-2:] == ["reset", ["hand"]]


def _update(u, k):
    pose = Pose.from_matrix(view("", 30 * k, 0, radius_m=2.0).camera_to_world)
    u.buffer.put(frame("hand", sequence=k, generated_ns=k * 10**9, pose=pose), k * 10**9)
    views, report = u.fit(u.select(u.plan(k * 10**9), k * 10**9), Budget(steps=1))
    assert report.refused == ("hand",)  # without "hand#0", an earlier viewpoint
    return views


def placed(number: int, x_m: float = 0.0, turned_deg: float = 0.0, camera: str = "cam01") -> View:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", turned_deg, degrees=True).as_matrix()
    pose[0, 3] = x_m
    return View(camera, np.zeros((24, 32, 3), np.uint8), pose, CAMERA, number * 10**8)


def first_seen(places_m) -> int | None:
    """Number of the frame with which the camera is seen to move; its frames are taken at ``places_m``."""
    motion = CameraMotion()
    for number, x_m in enumerate(places_m):
        if motion.moving([placed(number, camera="cam00"), placed(number, x_m)]) is not None:
            return number
    return None


def test_a_camera_that_moves_on_is_seen_to_move_with_its_fifth_frame_and_a_slow_one_later():
    assert first_seen([0.0, 0.1, 0.2, 0.3, 0.4, 0.5]) == 4
    motion = CameraMotion()
    assert [motion.moving([placed(n, 0.0, 6.0 * n)]) for n in range(5)] == [None, None, None, None, "cam01"]
    assert first_seen([0.0] * 50 + [0.004 * k for k in range(60)]) == 50 + 18


def test_what_is_no_motion():
    for places_m in (
        [0.0] * 100,
        [0.0] * 20 + [0.5] * 200,  # knocked, or calibrated anew
        [0.0, 0.0, 9.0, 0.0, 0.0, 9.0, 0.0, 9.0, 0.0],  # single wrong poses
        [0.03 * (k % 2) for k in range(100)],
        np.random.default_rng(4).normal(0.0, 0.005, 2000),
    ):
        assert first_seen(places_m) is None


def test_a_frame_that_is_used_again_and_one_that_was_overtaken_do_not_count():
    motion = CameraMotion()
    assert motion.moving([placed(0)]) is None
    for number, x_m in ((5, 1.0), (5, 1.0), (3, 2.0), (5, 1.0), (1, 3.0), (6, 0.0)):
        assert motion.moving([placed(number, x_m)]) is None
