"""What only the field of still Gaussians does; ``test_every_representation`` has the rest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.kernels.project import OPACITY
from edge_server.fields.splat.seeding import seed_gaussians
from tests.edge_server.fields.bounds import run_with_bounds_checks
from tests.edge_server.fields.scenes import mean_psnr, ring
from tests.edge_server.fields.small import SEEN, healthy
from tests.edge_server.fields.splat.small import SMALL, TINY


def test_nothing_begins_at_pixels_without_weight() -> None:
    box, pool, rng = scene_box(SEEN), CallerPool(), np.random.default_rng
    weight = [np.full(v.image.shape[:2], k % 2, np.float32) for k, v in enumerate(SEEN)]
    share = np.concatenate([w.ravel() for w in weight])
    others = [replace(v, image=255 - v.image) if k % 2 == 0 else v for k, v in enumerate(SEEN)]  # of weight 0
    one, two = (seed_gaussians(SMALL, pool, box, views, None, share, 300, rng(1)) for views in (SEEN, others))
    assert len(one) > 100
    np.testing.assert_array_equal(one, two)
    assert len(seed_gaussians(SMALL, pool, box, SEEN, None, np.zeros_like(share), 300, rng(1))) == 0


def test_the_number_of_gaussians_grows_to_the_cap_and_no_further() -> None:
    field = StillField(SMALL)
    counts = []
    for _ in range(12):
        field.fit(SEEN, Budget(steps=20))
        counts.append(len(field.cloud))
    assert counts[0] < counts[-1] == max(counts) <= SMALL.gaussians and counts[-1] > 1400


TINY_VIEWS = ring(9, size=24)


@pytest.mark.stability
@pytest.mark.parametrize(
    ("array", "column", "value"),
    [("params", 0, np.nan), ("params", 3, 1e30), ("params", OPACITY, -np.inf), ("params", 12, 1e38), ("v", 0, np.nan)],
)
def test_damage_is_healed(array: str, column: int, value: float) -> None:
    """Of every seventh Gaussian."""
    field = StillField(TINY)
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
from msgspec import structs
from edge_server.fields import Budget
from tests.edge_server.fields.splat.test_field import TINY, TINY_VIEWS, StillField
bent = [replace(v, intrinsics=replace(v.intrinsics, distortion=(-.1, .01, .002, .001))) for v in TINY_VIEWS]
for extra, views in (({}, TINY_VIEWS), ({"sh_degree": 1, "contracted": True}, bent),
                     ({"flatten": 0.1}, bent)):
    field = StillField(structs.replace(TINY, **extra))
    field.fit(views, Budget(steps=25))
    out = field.render(TINY_VIEWS[0].camera_to_world, replace(TINY_VIEWS[0].intrinsics, width=37, height=19))
    assert np.isfinite(out.color).all()
moved = [replace(v, image=np.roll(v.image, 5, axis=1)) for v in TINY_VIEWS]
field.fit(moved, Budget(steps=20))
print("kept")
"""
    run_with_bounds_checks(code, tmp_path, request)
