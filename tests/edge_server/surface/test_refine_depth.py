"""Depth from pictures that agree: the cost against plain numpy, and plates whose depth is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from edge_server.fields import Rendering, View
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.surface import surface_constants as tuned
from edge_server.surface.depth import DepthMap, depth_map
from edge_server.surface.kernels import patch_match
from edge_server.surface.kernels.patch_images import Planes
from edge_server.surface.reconstruct import covering_maps, make_depth_maps
from edge_server.surface.refine_depth import _images, _view, exposures, refine_depth
from edge_server.surface.settings import MeshSettings
from edge_server.surface.surface_constants import REACH, UNSURE
from freshfield.geometry import Pinhole, look_at, world_rays

LENS = Pinhole.from_fov(72, 72, 45.0)
TEXTURE = gaussian_filter(np.random.default_rng(1).normal(size=(400, 400)), 2.0, mode="wrap")
EYES = [(0.0, 0.0, 0.3), (0.12, 0.0, 0.28), (-0.1, 0.05, 0.29), (0.0, -0.13, 0.27)]
POSES = [look_at(eye, (0, 0, 0), up=(0, 1, 0)) for eye in EYES]
POOL = Pool(2, nice=0)


def texture(x, y) -> np.ndarray:
    return 128 + 400 * map_coordinates(TEXTURE, [x / 0.001 + 200, y / 0.001 + 200], order=1, mode="wrap")


def trench(pose, half_m=0.012, deep_m=0.03) -> tuple[np.ndarray, np.ndarray]:
    """Exact depth and a picture of a textured plate, z = 0, with a trench along y."""
    origin, rays = world_rays(LENS, pose)
    top = -origin[2] / rays[..., 2]
    at = origin + rays * top[..., None]
    inside = np.abs(at[..., 0]) < half_m
    floor = (-deep_m - origin[2]) / rays[..., 2]
    with np.errstate(divide="ignore"):
        wall = (np.sign(rays[..., 0]) * half_m - origin[0]) / rays[..., 0]
    wall = np.where(wall > top, wall, np.inf)
    depth = np.where(inside, np.minimum(floor, wall), top)
    x, y, z = (origin + rays * depth[..., None]).transpose(2, 0, 1)
    gray = texture(x + 3.0 * z, y + z)  # a wall shows another part of the texture
    picture = np.repeat(np.rint(np.clip(gray, 0, 255)).astype(np.uint8)[..., None], 3, axis=-1)
    return depth.astype(np.float32), picture


def textured_plane(pose) -> tuple[np.ndarray, np.ndarray]:
    """Exact depth and a picture of the plate without the trench."""
    return trench(pose, half_m=0.0)


def errors(found, exact, least_trust=0.0) -> np.ndarray:
    """Absolute errors, meters, of all pixels with a depth and more trust than ``least_trust``."""
    kept = [m.seen & (m.trust > least_trust) for m in found]
    return np.concatenate([np.abs(m.depth - e)[k] for m, e, k in zip(found, exact, kept)])


@pytest.fixture(scope="module")
def rig() -> tuple[list[DepthMap], list[np.ndarray], list[np.ndarray]]:
    """Four cameras whose depth is 2 to 4 % off, their pictures, and the exact depth."""
    shown = [textured_plane(pose) for pose in POSES]
    y = np.linspace(0, 3, 72)[:, None]
    wrong = [(d * (1.03 + 0.01 * np.sin(y + k))).astype(np.float32) for k, (d, _) in enumerate(shown)]
    maps = [depth_map(d, picture, pose, LENS) for d, (_, picture), pose in zip(wrong, shown, POSES)]
    return maps, [picture for _, picture in shown], [d for d, _ in shown]


def test_a_trench_that_the_field_has_closed_opens_whatever_the_number_of_threads():
    shown = [trench(pose) for pose in POSES]
    closed, pictures = [textured_plane(pose)[0] for pose in POSES], [picture for _, picture in shown]
    maps = [depth_map(d, picture, pose, LENS) for d, picture, pose in zip(closed, pictures, POSES)]
    found, alike = (refine_depth(maps, pictures, Pool(threads, nice=0)) for threads in (1, 3))
    for one, other in zip(found, alike):
        np.testing.assert_array_equal([one.depth, one.trust], [other.depth, other.trust])
    straight = found[0]  # looks down into it: the floor is 30 mm below the lid
    deep = (shown[0][0] > closed[0] + 0.02) & (np.abs(np.arange(72) - 36) < 20)[:, None]
    assert deep.sum() > 100
    error = np.abs(straight.depth - shown[0][0])[deep & (straight.trust > 0.1)]
    assert len(error) > 0.5 * deep.sum()
    assert np.median(error) < 0.002


def test_a_picture_taken_darker_is_brightened_before(rig):
    maps, pictures, exact = rig
    darker = [pictures[0], (0.7 * pictures[1]).astype(np.uint8), *pictures[2:]]
    gray = [p[..., 0].astype(np.float32) for p in darker]
    gains = exposures(maps, gray)
    assert gains[1] / gains[0] == pytest.approx(0.7, abs=0.05)
    assert gains[2] / gains[0] == pytest.approx(1.0, abs=0.05)
    np.testing.assert_array_equal(exposures(maps, [p[..., 0].astype(np.float32) for p in pictures]), 1.0)
    after = errors(refine_depth(maps, darker, POOL), exact, 0.3)
    assert np.median(after) < 0.0005 and len(after) > 0.5 * sum(m.seen.sum() for m in maps)


def test_the_cost_is_that_of_plain_numpy(rig):
    maps, pictures, exact = rig
    gray = [p[..., 0].astype(np.float32) for p in pictures]
    planes = [Planes(np.where(m.seen, m.depth, 0).astype(np.float32), None, None) for m in maps]
    images, view = _images(maps, gray, planes), _view(0, maps[0], gray[0])
    view.chosen[..., 0] = 1
    row, column, normal = 30, 41, np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
    depth = 1.01 * float(exact[0][row, column])
    across, down, fade = (np.empty(patch_match.LANES, np.float32) for _ in range(3))
    patch, weight = np.empty(patch_match.LANES, np.float32), np.empty(patch_match.LANES, np.float32)
    patch_match._pattern(across, down, fade)
    facts = patch_match._take_patch(gray[0], row, column, across, down, fade, patch, weight)
    taps = across, down, patch, weight, facts, 0.0
    found, shown = patch_match.plane_cost(images, view, row, column, depth, *normal, *taps)
    # Every tap's ray meets the plane; the affine approximation is off by a hundredth of a pixel.
    radius = patch_match.PATCH_RADIUS_PX
    j, i = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    near = ((abs(i) < radius) & (abs(j) < radius)) | (i == 0) | (j == 0)
    i, j = i[near], j[near]
    rays, origin = view.rays, maps[0].camera_to_world[:3, 3]
    reach = depth * (normal @ rays[row, column])
    points = origin + rays[row + j, column + i] * (reach / (rays[row + j, column + i] @ normal))[:, None]
    pose = maps[1].camera_to_world
    at = LENS.project((points - pose[:3, 3]) @ pose[:3, :3])
    other = map_coordinates(gray[1].astype(float), [at[:, 1] - 0.5, at[:, 0] - 0.5], order=1)
    own = gray[0][row + j, column + i].astype(float)
    w = np.exp(-np.abs(own - gray[0][row, column]) / tuned.SIMILAR - tuned.FADE * (i * i + j * j))
    w /= w.sum()
    a, b = own - w @ own, other - w @ other
    like = (w @ (a * b)) / np.sqrt((w @ a**2 + tuned.NOISE) * (w @ b**2 + tuned.NOISE))
    levels = tuned.LEVELS + np.sqrt(w @ a**2)
    unlike = min(w @ np.abs(own - other) / levels, 2.0)
    wanted = (1 - tuned.DIFFERENCE) * (1 - like) + tuned.DIFFERENCE * unlike
    assert found == pytest.approx(wanted, abs=0.02) and shown == 1
    away = patch_match.plane_cost(images, view, row, column, depth, *-normal, *taps)
    assert away == (tuned.WORST, 0), "turned away"


def test_unknown_pixels_take_the_nearest_depth_and_empty_ones_none(rig):
    maps, pictures, exact = rig
    holed = []
    for m in maps:
        depth = m.depth.copy()
        depth[30:40, 30:40], depth[:, :6] = 0.0, np.inf
        holed.append(depth_map(depth, m.color, m.camera_to_world, LENS))
    found = refine_depth(holed, pictures, POOL)
    error = np.abs(found[0].depth - exact[0])[31:39, 31:39]
    assert np.isfinite(error).all() and np.median(error) < 0.0006
    assert np.isposinf(found[0].depth[:, :6]).all()


@pytest.mark.parametrize("sharpen", [False, True])
def test_depth_is_sharpened_where_that_is_asked_for_and_there_are_two_views(rig, sharpen) -> None:
    maps, pictures, exact = rig
    opaque = np.ones((72, 72), np.float32)
    of = {m.camera_to_world.tobytes(): Rendering(m.color / np.float32(255.0), m.depth, opaque) for m in maps}
    field = SimpleNamespace(render=lambda pose, lens: of[pose.tobytes()])
    views = [View(f"cam{k}", picture, pose, LENS) for k, (picture, pose) in enumerate(zip(pictures, POSES))]
    found = make_depth_maps(field, views, MeshSettings(sharpen=sharpen))
    assert (np.median(errors(found, exact)) < 0.002) == sharpen and len(found) == 4
    (alone,) = make_depth_maps(field, views[:1], MeshSettings(sharpen=sharpen))
    np.testing.assert_array_equal(alone.depth, maps[0].depth)


def test_only_the_maps_that_see_most_together_are_sharpened() -> None:
    elsewhere = look_at((5.0, 0.0, 0.25), (5.0, 0.0, 0.0), up=(0, 1, 0))
    maps = [depth_map(*textured_plane(pose), pose, LENS) for pose in (POSES[0], POSES[0], POSES[0], elsewhere)]
    maps[2] = replace(maps[2], depth=np.zeros_like(maps[2].depth))
    # The third sees nothing, the second the same as the first; two are compared with each other, however large.
    for most, chosen in ((4, [0, 1, 2, 3]), (3, [0, 1, 3]), (2, [0, 3]), (0.5, [0, 3])):
        assert covering_maps(maps, int(most * maps[0].depth.size)) == chosen


PICTURES = {
    "plain": lambda k: np.full((72, 72, 3), 90, np.uint8),
    "noise": lambda k: np.random.default_rng(k).integers(0, 255, (72, 72, 3), dtype=np.uint8),
    "contradictory": lambda k: np.full((72, 72, 3), 255 * (k % 2), np.uint8),
}


@pytest.mark.stability
@pytest.mark.parametrize("kind", PICTURES)
def test_pictures_of_nothing_give_bounded_depth_and_are_hardly_trusted(rig, kind):
    """And never NaN: nothing lies farther from where it was than is searched."""
    maps = rig[0]
    found = refine_depth(maps, [PICTURES[kind](k) for k in range(4)], POOL)
    for before, after in zip(maps, found):
        assert np.isfinite(after.trust).all() and np.isfinite(after.cosine).all() and not np.isnan(after.depth).any()
        both = before.seen & after.seen
        assert (np.abs(after.depth / np.where(both, before.depth, 1) - 1)[both] <= REACH + 1e-5).all()
        np.testing.assert_array_equal(np.isposinf(after.depth), np.isposinf(before.depth))
        if kind == "plain":
            assert after.trust[before.seen].max() <= UNSURE + 1e-6
        if kind == "noise":
            assert np.mean(after.trust[before.seen] <= 0.1) > 0.8, "no map confirms it"
