"""Gaussians as planes: depth where rays meet them, against a composition by hand."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.kernels.project import BASE, OPACITY, QUATERNION, SCALE, Gaussians
from edge_server.fields.splat.planar import plane_depth
from edge_server.fields.splat.settings import SplatSettings
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


def tilted(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@pytest.mark.parametrize("angle", [0.0, 0.6])
def test_the_depth_of_a_plane_is_where_the_rays_meet_it(angle):
    tilt = tilted(angle)
    raster, gaussians, camera = looked(flat(400, tilt))
    depth, opacity = plane_depth(raster, gaussians, camera, LENS)
    origin, rays = world_rays(LENS, POSE)
    exact = -(origin @ tilt[:, 2]) / (rays @ tilt[:, 2])
    solid = opacity > 0.9
    assert solid.mean() > 0.2
    assert np.abs(depth / exact - 1)[solid].max() < 1e-4  # blended middles are off by centimeters


def test_a_field_that_is_asked_for_surfaces_shows_their_planes():
    views = ring(5, size=32)
    fields = [StillField(SplatSettings(gaussians=512, start=256, **more)) for more in ({}, {"flatten": 0.02})]
    for field in fields:
        field.fit(views, Budget(steps=40))
    thin = [np.ptp(field.cloud.params[:, SCALE : SCALE + 3], axis=1) for field in fields]
    assert np.median(thin[1]) > np.median(thin[0]) + 0.3 and thin[1].max() <= np.log(20.0) + 1e-5
    camera = (views[0].camera_to_world, views[0].intrinsics)
    snapshot = fields[1].snapshot()
    assert snapshot.planar and not fields[0].snapshot().planar
    (found,) = render_depth_maps(snapshot, [camera])
    np.testing.assert_array_equal(found.depth[found.seen], snapshot.render_surface(*camera).depth[found.seen])
