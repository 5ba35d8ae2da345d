"""Depth from pictures that agree: the kernel against plain numpy, and a textured plate whose depth is
known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.surface import SurfaceError
from edge_server.surface.depth import DepthMap, depth_map
from edge_server.surface.kernels.sweep import NONE, REACH, SourceImages, correlation
from edge_server.surface.refine_depth import neighboring_maps, refine_depth, smooth_normals
from freshfield.geometry import Pinhole, look_at, world_rays

LENS = Pinhole.from_fov(72, 72, 45.0)
TEXTURE = gaussian_filter(np.random.default_rng(1).normal(size=(400, 400)), 2.0, mode="wrap")


def plate(pose) -> tuple[np.ndarray, np.ndarray]:
    """Exact depth of the plane z = 0 and a picture of a random texture on it."""
    origin, rays = world_rays(LENS, pose)
    depth = -origin[2] / rays[..., 2]
    x, y = (origin + rays * depth[..., None])[..., :2].transpose(2, 0, 1)
    grey = map_coordinates(TEXTURE, [x / 0.001 + 200, y / 0.001 + 200], order=1, mode="wrap")
    picture = np.clip(128 + 400 * grey, 0, 255).astype(np.uint8)
    return depth.astype(np.float32), np.repeat(picture[..., None], 3, axis=-1)


@pytest.fixture(scope="module")
def rig() -> tuple[list[DepthMap], list[np.ndarray], list[np.ndarray]]:
    """Four cameras whose depth is 2 to 4 % off, their pictures, and the exact depth."""
    eyes = [(0.0, 0.0, 0.3), (0.12, 0.0, 0.28), (-0.1, 0.05, 0.29), (0.0, -0.13, 0.27)]
    poses = [look_at(eye, (0, 0, 0), up=(0, 1, 0)) for eye in eyes]
    shown = [plate(pose) for pose in poses]
    y = np.linspace(0, 3, 72)[:, None]
    wrong = [(d * (1.03 + 0.01 * np.sin(y + k))).astype(np.float32) for k, (d, _) in enumerate(shown)]
    maps = [depth_map(d, picture, pose, LENS) for d, (_, picture), pose in zip(wrong, shown, poses)]
    return maps, [picture for _, picture in shown], [d for d, _ in shown]


def test_depth_moves_to_where_the_pictures_agree(rig):
    maps, pictures, exact = rig
    found = refine_depth(maps, pictures)
    before = [np.abs(m.depth - e)[m.seen] for m, e in zip(maps, exact)]
    after = [np.abs(m.depth - e)[m.seen & (m.trust > 0.3)] for m, e in zip(found, exact)]
    assert np.median(np.concatenate(before)) > 0.005
    assert np.median(np.concatenate(after)) < 0.0004  # a tenth of a pixel
    assert sum(map(len, after)) > 0.6 * sum(map(len, before))


def test_the_number_of_threads_changes_no_bit(rig):
    maps, pictures, _ = rig
    one, three = (refine_depth(maps[:3], pictures[:3], pool=p) for p in (Pool(1, nice=0), Pool(3, nice=0)))
    for a, b in zip(one, three):
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_array_equal(a.trust, b.trust)


def test_agreement_is_the_correlation_of_two_patches():
    rng = np.random.default_rng(3)
    grey = rng.uniform(0, 255, (30, 40)).astype(np.float32)
    others = SourceImages(
        np.zeros((1, 8)), np.eye(3)[None], np.zeros((1, 3)), np.array([0, grey.size]), np.array([[40, 30]]),
        grey.ravel(),
    )  # fmt: skip
    patch = rng.uniform(0, 255, (5, 5)).astype(np.float32)
    u, v, ux, vx, uy, vy = 20.3, 14.8, 1.1, 0.2, -0.3, 0.9
    j, i = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1]
    at = [v - 0.5 + i * vx + j * vy, u - 0.5 + i * ux + j * uy]
    other = map_coordinates(grey.astype(float), at, order=1)
    centred = (patch - patch.mean()).ravel()
    found = correlation(centred, np.float32(centred @ centred), others, 0, u, v, ux, vx, uy, vy)
    assert found == pytest.approx(np.corrcoef(patch.ravel(), other.ravel())[0, 1], abs=1e-4)
    assert correlation(centred, np.float32(1.0), others, 0, 1.0, 1.0, 1.0, 0.0, 0.0, 1.0) == NONE
    same = grey[12:17, 17:22] - grey[12:17, 17:22].mean()
    exact = correlation(same.ravel(), np.float32((same**2).sum()), others, 0, 19.5, 14.5, 1.0, 0.0, 0.0, 1.0)
    assert exact == pytest.approx(1.0, abs=1e-4)


def test_normals_are_those_of_the_plate(rig):
    _, pictures, exact = rig
    pose = look_at((0.12, 0.0, 0.28), (0, 0, 0), up=(0, 1, 0))
    found = depth_map(exact[1], pictures[1], pose, LENS)
    normal = smooth_normals(found, LENS.rays() @ pose[:3, :3].T)
    assert (np.abs(normal[10:-10, 10:-10, 2]) > 0.9995).all()


def test_a_map_is_compared_with_those_that_see_the_same_from_aside(rig):
    maps, _, _ = rig
    far = depth_map(maps[0].depth, maps[0].color, look_at((5.0, 0, 0.3), (5, 0, 0), up=(0, 1, 0)), LENS)
    assert set(neighboring_maps([*maps, far], 0)) == {1, 2, 3}
    assert neighboring_maps([maps[0], maps[0]], 0) == []  # no angle between them, no depth


def test_pictures_must_belong_to_the_maps(rig):
    maps, pictures, _ = rig
    with pytest.raises(SurfaceError, match="3 pictures do not belong to 4"):
        refine_depth(maps, pictures[:3])
    with pytest.raises(SurfaceError, match="does not belong to a depth map"):
        refine_depth(maps, [p[:10] for p in pictures])
