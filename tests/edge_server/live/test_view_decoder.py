"""Frames as views, decoded once, with depth at the image's pixels; cameras that move, and their earlier viewpoints."""

from dataclasses import replace

import numpy as np
import pytest

from edge_server.live import depth_in_image as module
from edge_server.live.depth_in_image import depth_in_image
from edge_server.live.live_constants import MAX_DEPTH_POINTS, MOST_DEPTH_MOVED
from edge_server.live.view_decoder import ViewDecoder
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole, Pose
from tests.edge_server.frames import damaged_frame, frame


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
        expected = whole.intrinsics.rays([[32 / size[1], 2.0 * 24 / size[0]]])
        np.testing.assert_allclose(view.intrinsics.rays([[1.0, 2.0]]), expected)


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
    """A damaged image costs its frame. Each counts once."""
    sent = DepthImage(np.random.default_rng(0).integers(0, 9000, (24, 32), np.uint16), 0.001).encode()
    cut = replace(sent, payload=sent.payload[: len(sent.payload) // 2])
    cut.check(frame().intrinsics, 1)  # it passes at the door
    decoder = ViewDecoder(most_pixels=200)
    for _ in range(2):
        (view,) = decoder.views([item := frame(depth=cut)])
        decoder.views([item])
        assert view.image.shape == (12, 16, 3) and view.depth is None and view.whole().depth is None
    assert (decoder.undecodable, decoder.undecodable_depth) == (0, 2)
    items = [damaged_frame(depth=sent), frame("cam02")]
    for _ in range(2):
        assert [view.camera for view in decoder.views(items)] == ["cam02"]
    assert (decoder.undecodable, decoder.undecodable_depth) == (1, 2)


IMAGE = Pinhole.from_fov(64, 48, 70.0)
SENSOR = Pinhole(80, 60, 70.0, 70.0, 41.0, 29.0)
BESIDE = Pose((1.0, 0.0, 0.0, 0.0), (0.06, -0.01, 0.02))  # of the sensor, right of the camera


def depth(counts, **other) -> DepthImage:
    return DepthImage(np.asarray(counts, np.uint16), 0.001, **other)


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
    """A square of 60 cm at 1.5 m before a wall at 3 m. The axes of sensor and camera are parallel."""
    rays, at = SENSOR.rays(), np.array(BESIDE.translation_m)
    on_square = np.abs((at + rays * ((1.5 - at[2]) / rays[..., 2:]))[..., :2]).max(axis=-1) < 0.3
    millimeters = np.round(1000 * (np.where(on_square, 1.5, 3.0) - at[2]))
    measured = depth(millimeters, intrinsics=SENSOR, to_camera=BESIDE)
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
    assert [lens for lens, _, _ in module._kept] == [*lenses[-2:], lenses[0]]
    monkeypatch.setattr(module, "MAX_DEPTH_RAYS_BYTES", rays_bytes - 1)
    assert (depth_in_image(depth(counts, intrinsics=lenses[1]), IMAGE, 0) > 0).mean() > 0.6
    assert not module._kept
