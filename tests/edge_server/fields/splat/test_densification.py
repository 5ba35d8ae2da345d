"""Which Gaussians are split and which removed, in exact cases."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields.splat.densification import GaussianCloud, densify_and_prune, opacity
from edge_server.fields.splat.kernels.project import OPACITY, QUATERNION, SCALE
from tests.edge_server.fields.splat.kernels.small_cloud import random_params

RNG = np.random.default_rng(0)


def _cloud(count: int) -> GaussianCloud:
    """Gaussians that are seen, of equal gradient."""
    cloud = GaussianCloud.new(random_params(count))
    cloud.params[:, OPACITY] = 0.5
    cloud.slope[:], cloud.looks[:] = 1.0, 1.0
    return cloud


def test_the_largest_mean_gradient_is_split_first() -> None:
    """Not what was seen most often: both have the same sum, one of ten looks, one of a single one."""
    cloud = _cloud(2)
    cloud.looks[:] = 10.0, 1.0
    before = cloud.params.copy()
    assert densify_and_prune(cloud, 3, 100.0, RNG).tolist() == [0, 1, 1]
    np.testing.assert_array_equal(cloud.params[0], before[0])
    assert not np.array_equal(cloud.params[1], before[1])


def test_what_is_too_wide_is_split_whatever_its_gradient() -> None:
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
