"""Gaussians as planes: depth where rays meet them, against a composition by hand."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.camera import ORIGIN
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.densification import GaussianCloud
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.kernels.project import (
    ALPHA,
    ALPHA_MIN,
    BASE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    QUATERNION,
    SCALE,
    Gaussians,
)
from edge_server.fields.splat.planar import (
    align,
    blend_planes,
    depth_normals,
    flatten,
    gaussian_normals,
    gaussian_planes,
    plane_depth,
    seen_sums,
)
from edge_server.fields.splat.settings import ALPHA_MAX, SplatSettings
from edge_server.surface.depth import render_depth_maps
from freshfield.geometry import Pinhole, look_at, matrix_to_quaternion, world_rays
from tests.edge_server.fields.scenes import ring

BOX = SceneBox((0.0, 0.0, 0.0), 1.0, 0.01, False, 2.0, 0.01)
LENS = Pinhole.from_fov(24, 24, 40.0)
POSE = look_at((0.5, -0.4, 2.0), (0, 0, 0))
POOL = Pool(2, nice=0)


def flat(count: int, tilt: np.ndarray, seed: int = 0, thickness: float = -7.0) -> np.ndarray:
    """Parameters of flat Gaussians strewn over the plane through the origin with normal tilt[:, 2]."""
    rng = np.random.default_rng(seed)
    p = np.zeros((count, BASE), np.float32)
    p[:, :3] = rng.uniform(-0.9, 0.9, (count, 2)) @ tilt[:, :2].T
    p[:, SCALE : SCALE + 2], p[:, SCALE + 2] = np.log(0.12), thickness
    p[:, QUATERNION : QUATERNION + 4] = matrix_to_quaternion(tilt)
    p[:, OPACITY] = 2.0
    return p


def looked(params: np.ndarray) -> tuple[RasterBuffers, Gaussians, np.ndarray]:
    gaussians = Gaussians(params, 0)
    raster, cams = RasterBuffers(POOL), camera_rows([POSE], [LENS], BOX)
    raster.project_and_bin(cams, gaussians)
    return raster, gaussians, cams[0]


def blended(raster: RasterBuffers, gaussians: Gaussians, camera: np.ndarray) -> np.ndarray:
    normal, distance, opacity = blend_planes(raster, gaussians, camera)
    return np.concatenate([normal, distance[..., None], opacity[..., None]], axis=-1)


def tilted(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@pytest.mark.parametrize("angle", [0.0, 0.6, -0.9])
def test_the_depth_of_a_plane_is_where_the_rays_meet_it(angle):
    tilt = tilted(angle)
    raster, gaussians, camera = looked(flat(400, tilt))
    depth, opacity = plane_depth(raster, gaussians, camera, LENS)
    origin, rays = world_rays(LENS, POSE)
    exact = -(origin @ tilt[:, 2]) / (rays @ tilt[:, 2])
    solid = opacity > 0.9
    assert solid.mean() > 0.2
    assert np.abs(depth / exact - 1)[solid].max() < 1e-4  # blended middles are off by centimeters


def test_the_kernel_blends_as_a_loop_over_pixels_does():
    rng = np.random.default_rng(4)
    params = flat(40, tilted(0.4), thickness=-3.0)
    params[:, :3] += rng.normal(0, 0.2, (40, 3))
    raster, gaussians, camera = looked(params)
    planes = gaussian_planes(gaussians, camera)
    out = blended(raster, gaussians, camera)
    lists = raster.lists
    for y, x in [(3, 5), (12, 12), (20, 9)]:
        tile, left, total = (y // 8) * 3 + x // 8, 1.0, np.zeros(5)
        for pair in lists.pair[0, lists.first[0, tile] : lists.first[0, tile + 1]]:
            i = lists.owner[0, pair]
            row = raster.projected[0, i].astype(float)
            dx, dy = x + 0.5 - row[MEAN_X], y + 0.5 - row[MEAN_Y]
            power = -0.5 * (row[CONIC_A] * dx * dx + row[CONIC_C] * dy * dy) - row[CONIC_B] * dx * dy
            alpha = min(row[ALPHA] * np.exp(power), ALPHA_MAX)
            if alpha < ALPHA_MIN or left < 1e-4:
                continue
            total += alpha * left * np.array([*planes[i], 1.0])
            left -= alpha * left
        np.testing.assert_allclose(out[y, x], total, atol=2e-5)


def test_what_pixels_tell_adds_up_to_what_they_show():
    raster, gaussians, camera = looked(flat(60, tilted(0.3)))
    values = np.random.default_rng(2).normal(size=(24, 24, 3)).astype(np.float32)
    found, opacity = seen_sums(raster, 60, values), blended(raster, gaussians, camera)[..., 4:]
    np.testing.assert_allclose(found.sum(axis=0), (opacity * values).sum(axis=(0, 1)), rtol=2e-3, atol=1e-2)
    ones = seen_sums(raster, 60, np.ones_like(values))
    assert ones[:, 0].sum() == pytest.approx(opacity.sum(), rel=1e-4)
    assert (ones[raster.lists.own_count[0, :60] == 0] == 0).all()


def test_gaussians_turn_to_the_surface_they_show_and_get_flat():
    settings = SplatSettings(flatten=0.05, align=0.5)
    tilt = tilted(0.2)
    params = flat(400, tilt, thickness=np.log(0.05))
    rng = np.random.default_rng(6)
    q = params[:, QUATERNION : QUATERNION + 4]
    q += rng.normal(0, 0.15, q.shape)
    cloud = GaussianCloud.new(params)
    off = [_degrees(cloud, tilt)]
    for _ in range(12):
        flatten(cloud, settings.flatten)
        raster, _, camera = looked(cloud.params)
        align(cloud, settings.align, raster, camera, LENS)
        off.append(_degrees(cloud, tilt))
    assert off[-1] < 0.4 * off[0]
    scale = cloud.params[:, SCALE : SCALE + 3]
    assert (scale.max(axis=1) - scale.min(axis=1)).min() > 1.3
    assert (scale.max(axis=1) - scale.min(axis=1)).max() <= np.log(20.0) + 1e-5


def _degrees(cloud: GaussianCloud, tilt: np.ndarray) -> float:
    """Mean angle between the normals of what is seen and the surface."""
    raster, _, _ = looked(cloud.params)
    seen = raster.lists.own_count[0, : len(cloud)] > 0
    along = np.abs(gaussian_normals(cloud.params)[seen] @ tilt[:, 2])
    return float(np.rad2deg(np.arccos(np.clip(along, 0, 1))).mean())


def test_normals_of_depth_are_those_of_the_plane():
    tilt = tilted(0.5)
    origin, rays = world_rays(LENS, POSE)
    depth = (-(origin @ tilt[:, 2]) / (rays @ tilt[:, 2])).astype(np.float32)
    found = depth_normals(depth, np.ones_like(depth), LENS)
    turn = camera_rows([POSE], [LENS], BOX)[0, :ORIGIN].reshape(3, 3)
    inner = found[1:-1, 1:-1]
    assert inner[..., 3].all() and not found[0, :, 3].any()
    np.testing.assert_allclose(inner[..., :3], np.broadcast_to(turn @ tilt[:, 2], inner[..., :3].shape), atol=1e-3)


def test_hard_cases_stay_finite():
    params = flat(50, tilted(0.3))
    params[0, QUATERNION : QUATERNION + 4] = 0.0
    params[1, SCALE : SCALE + 3] = -11.0
    params[2, :3] = POSE[:3, 3]  # in the camera
    raster, gaussians, camera = looked(params)
    depth, opacity = plane_depth(raster, gaussians, camera, LENS)
    assert np.isfinite(depth).all() and np.isfinite(opacity).all()
    cloud = GaussianCloud.new(params.copy())
    align(cloud, 1.0, raster, camera, LENS)
    flatten(cloud, 1.0)
    assert np.isfinite(cloud.params).all()
    empty, gaussians, camera = looked(params[:0])
    depth, opacity = plane_depth(empty, gaussians, camera, LENS)
    assert not depth.any() and not opacity.any()


def test_a_field_that_is_asked_for_surfaces_shows_their_planes():
    views = ring(5, size=32)
    fields = [
        StillField(SplatSettings(gaussians=512, start=256, **more))
        for more in ({}, {"flatten": 0.02, "align": 0.3}, {"flatten": 0.02, "align": 0.3})
    ]
    for field in fields:
        field.fit(views, Budget(steps=40))
    plain, planar, again = (field.cloud.params for field in fields)
    np.testing.assert_array_equal(planar, again)
    thin = [p[:, SCALE : SCALE + 3].max(axis=1) - p[:, SCALE : SCALE + 3].min(axis=1) for p in (plain, planar)]
    assert np.median(thin[1]) > np.median(thin[0]) + 0.3
    camera = (views[0].camera_to_world, views[0].intrinsics)
    snapshot = fields[1].snapshot()
    assert snapshot.planar and not fields[0].snapshot().planar
    (found,) = render_depth_maps(snapshot, [camera])
    shown = snapshot.render_surface(*camera)
    np.testing.assert_array_equal(found.depth[found.seen], shown.depth[found.seen])
