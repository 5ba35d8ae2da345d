"""What only the field of still Gaussians does, also with flat ones: ``test_every_representation`` has the rest."""

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.splat.densification import GaussianCloud, densify_and_prune, opacity
from edge_server.fields.splat.kernels.project import BASE, OPACITY, QUATERNION, SCALE
from edge_server.fields.splat.planar import plane_depth
from edge_server.surface.depth import render_depth_maps
from freshfield.geometry import Pinhole, look_at, matrix_to_quaternion, so3_exp, world_rays
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small import tiny
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, binned, random_params

RNG = np.random.default_rng(0)


def _cloud(count: int) -> GaussianCloud:
    """Gaussians that are seen, of equal gradient."""
    cloud = GaussianCloud.new(random_params(count))
    cloud.params[:, OPACITY] = 0.5
    cloud.slope[:], cloud.looks[:] = 1.0, 1.0
    return cloud


def test_the_largest_mean_gradient_is_split_first_and_what_is_too_wide_always() -> None:
    """Not what was seen most often: both have the same sum, one of ten looks, one of a single one."""
    cloud = _cloud(2)
    cloud.looks[:] = 10.0, 1.0
    before = cloud.params.copy()
    assert densify_and_prune(cloud, 3, 100.0, RNG).tolist() == [0, 1, 1]
    np.testing.assert_array_equal(cloud.params[0], before[0])
    assert not np.array_equal(cloud.params[1], before[1])
    cloud = _cloud(3)
    cloud.slope[:], cloud.reach[:] = (5.0, 0.1, 5.0), (0.05, 0.25, 0.05)  # the bound is .2 of the width
    assert densify_and_prune(cloud, 4, 100.0, RNG).tolist() == [0, 1, 2, 1]


def test_two_halves_transmit_as_much_light_as_the_one_did() -> None:
    cloud = _cloud(1)
    cloud.params[0, QUATERNION:OPACITY] = 1.0, 0.0, 0.0, 0.0
    before, alpha = cloud.params[0].copy(), float(opacity(cloud.params)[0])
    cloud.reach[:] = 0.1  # ten pixels: shrunk by 1.6
    densify_and_prune(cloud, 8, 100.0, RNG)
    assert len(cloud) == 2
    np.testing.assert_allclose((1.0 - opacity(cloud.params)) ** 2, 1.0 - alpha, rtol=1e-5)
    np.testing.assert_allclose(cloud.params[:, :3].mean(axis=0), before[:3], atol=1e-6)
    shrunk = before[SCALE:QUATERNION] - np.log(1.6)
    np.testing.assert_allclose(cloud.params[:, SCALE:QUATERNION], [shrunk, shrunk], atol=1e-5)


@pytest.mark.parametrize(("count", "most", "expected"), [(20, 100, 23), (20, 21, 21), (20, 20, 20)])
def test_fifteen_percent_are_split_and_never_more_than_there_is_room_for(count: int, most: int, expected: int) -> None:
    cloud = _cloud(count)
    origin = densify_and_prune(cloud, most, 100.0, RNG)
    assert len(cloud) == len(origin) == expected and not cloud.slope.any() and not cloud.looks.any()


def test_the_faint_the_unseen_and_the_broken_are_removed() -> None:
    cloud = _cloud(4)
    cloud.params[:3, OPACITY] = np.log(0.019 / 0.981), np.log(0.021 / 0.979), -9.0
    cloud.looks[3], cloud.slope[:] = 0.0, 0.0
    assert densify_and_prune(cloud, 8, 100.0, RNG).tolist() == [1]


# --- Gaussians as planes ----------------------------------------------------------------------------

LENS = Pinhole.from_fov(24, 24, 40.0)
POSE = look_at((0.5, -0.4, 2.0), (0, 0, 0))


def flat(count: int, tilt: np.ndarray) -> np.ndarray:
    """Parameters of flat Gaussians strewn over the plane through the origin with normal tilt[:, 2]."""
    rng = np.random.default_rng(0)
    p = np.zeros((count, BASE), np.float32)
    p[:, :3] = rng.uniform(-0.9, 0.9, (count, 2)) @ tilt[:, :2].T
    p[:, SCALE : SCALE + 2], p[:, SCALE + 2] = np.log(0.12), -7.0
    p[:, QUATERNION : QUATERNION + 4] = matrix_to_quaternion(tilt)
    p[:, OPACITY] = 2.0
    return p


@pytest.mark.parametrize("angle", [0.0, 0.6])
def test_the_depth_of_a_plane_is_where_the_rays_meet_it(angle: float) -> None:
    tilt, cams = so3_exp([0.0, angle, 0.0]), camera_rows([POSE], [LENS], BOX)
    params = flat(400, tilt)
    depth, opacity = plane_depth(binned(cams, params), params, cams[0], LENS)
    origin, rays = world_rays(LENS, POSE)
    exact = -(origin @ tilt[:, 2]) / (rays @ tilt[:, 2])
    solid = opacity > 0.9
    assert solid.mean() > 0.2
    assert np.abs(depth / exact - 1)[solid].max() < 1e-4  # blended middles are off by centimeters


def test_a_field_that_is_asked_for_surfaces_shows_their_planes() -> None:
    views = ring(5, size=32)
    fields = [tiny("splat"), tiny("splat", flatten=0.02)]
    for field in fields:
        field.fit(views, Budget(steps=40))
    thin = [np.ptp(field.cloud.params[:, SCALE : SCALE + 3], axis=1) for field in fields]
    assert np.median(thin[1]) > np.median(thin[0]) + 0.3 and thin[1].max() <= np.log(20.0) + 1e-5
    camera = (views[0].camera_to_world, views[0].intrinsics)
    snapshot = fields[1].snapshot()
    assert snapshot.planar and not fields[0].snapshot().planar
    (found,) = render_depth_maps(snapshot, [camera])
    np.testing.assert_array_equal(found.depth[found.seen], snapshot.render_surface(*camera).depth[found.seen])
