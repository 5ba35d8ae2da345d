"""What only the field of still Gaussians does; ``test_every_representation`` has the rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.densification import GaussianCloud, densify_and_prune, opacity
from edge_server.fields.splat.kernels.project import OPACITY, QUATERNION, SCALE
from edge_server.fields.splat.seeding import seed_gaussians
from tests.edge_server.fields.scenes import mean_psnr, ring
from tests.edge_server.fields.small import SEEN, SMALL, healthy, run_with_bounds_checks, small, tiny
from tests.edge_server.fields.splat.kernels.small_cloud import random_params


def test_nothing_begins_at_pixels_without_weight() -> None:
    box, pool, rng = scene_box(SEEN), CallerPool(), np.random.default_rng
    weight = [np.full(v.image.shape[:2], k % 2, np.float32) for k, v in enumerate(SEEN)]
    share = np.concatenate([w.ravel() for w in weight])
    others = [replace(v, image=255 - v.image) if k % 2 == 0 else v for k, v in enumerate(SEEN)]  # of weight 0
    one, two = (seed_gaussians(SMALL["splat"], pool, box, views, None, share, 300, rng(1)) for views in (SEEN, others))
    assert len(one) > 100
    np.testing.assert_array_equal(one, two)
    assert len(seed_gaussians(SMALL["splat"], pool, box, SEEN, None, np.zeros_like(share), 300, rng(1))) == 0


def test_the_number_of_gaussians_grows_to_the_cap_and_no_further() -> None:
    field = small("splat")
    counts = []
    for _ in range(12):
        field.fit(SEEN, Budget(steps=20))
        counts.append(len(field.cloud))
    assert counts[0] < counts[-1] == max(counts) <= SMALL["splat"].gaussians and counts[-1] > 1400


TINY_VIEWS = ring(9, size=24)


@pytest.mark.stability
@pytest.mark.parametrize(
    ("array", "column", "value"),
    [("params", 0, np.nan), ("params", 3, 1e30), ("params", OPACITY, -np.inf), ("params", 12, 1e38), ("v", 0, np.nan)],
)
def test_damage_is_healed(array: str, column: int, value: float) -> None:
    """Of every seventh Gaussian."""
    field = tiny("splat")
    field.fit(TINY_VIEWS, Budget(steps=40))
    getattr(field.cloud, array)[::7, column] = value
    field._snapshot = None
    out = field.render(TINY_VIEWS[0].camera_to_world, TINY_VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all()
    field.fit(TINY_VIEWS, Budget(steps=120))
    healthy(field, TINY_VIEWS)
    assert mean_psnr(field, TINY_VIEWS) > 17.0
    assert field.fit(TINY_VIEWS, Budget(steps=40)).dropped == 0, "still not finite 120 steps later"


@pytest.mark.stability
@pytest.mark.slow
def test_bounds_are_kept_in_every_kernel(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """A whole fit and rendering with numba's bounds checks, in a process of its own."""
    code = """
from dataclasses import replace
import numpy as np
from edge_server.fields import Budget
from tests.edge_server.fields.splat.test_field import TINY_VIEWS, tiny
bent = [replace(v, intrinsics=replace(v.intrinsics, distortion=(-.1, .01, .002, .001))) for v in TINY_VIEWS]
for extra, views in (({}, TINY_VIEWS), ({"sh_degree": 1, "contracted": True}, bent),
                     ({"flatten": 0.1}, bent)):
    field = tiny("splat", **extra)
    field.fit(views, Budget(steps=25))
    out = field.render(TINY_VIEWS[0].camera_to_world, replace(TINY_VIEWS[0].intrinsics, width=37, height=19))
    assert np.isfinite(out.color).all()
moved = [replace(v, image=np.roll(v.image, 5, axis=1)) for v in TINY_VIEWS]
field.fit(moved, Budget(steps=20))
"""
    run_with_bounds_checks(code, tmp_path, request)


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
