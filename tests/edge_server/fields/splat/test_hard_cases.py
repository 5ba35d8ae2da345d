"""Hard cases for the Gaussian field: whatever comes, it stays finite, bounded and useful afterwards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.kernels.project import OPACITY
from tests.edge_server.fields.bounds import run_with_bounds_checks
from tests.edge_server.fields.scenes import mean_psnr, ring
from tests.edge_server.fields.small import healthy
from tests.edge_server.fields.splat.small import TINY

pytestmark = pytest.mark.stability

VIEWS = ring(9, size=24)


def _parameter(column: int, value: float, every: int = 7) -> Callable[[StillField], None]:
    def damage(field: StillField) -> None:
        field.cloud.params[::every, column] = value

    return damage


def _moments(field: StillField) -> None:
    field.cloud.m[::5] = np.inf
    field.cloud.v[::3] = np.nan


@pytest.mark.parametrize(
    "damage",
    [
        _parameter(0, np.nan),
        _parameter(4, np.inf),
        _parameter(7, np.nan),
        _parameter(OPACITY, -np.inf),
        _parameter(12, np.nan),
        _parameter(12, 1e38),
        _parameter(3, 1e30),
        _parameter(3, -1e30),
        _parameter(1, 1e-41),
        _moments,
    ],
)
def test_damage_is_healed(damage: Callable[[StillField], None]) -> None:
    field = StillField(TINY)
    field.fit(VIEWS, Budget(steps=40))
    damage(field)
    field._snapshot = None
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all()
    field.fit(VIEWS, Budget(steps=120))
    healthy(field, VIEWS)
    assert mean_psnr(field, VIEWS) > 17.0
    assert field.fit(VIEWS, Budget(steps=40)).dropped == 0, "still not finite 120 steps later"


@pytest.mark.parametrize("raw", [-30.0, 30.0])
def test_everything_faded_or_opaque(raw: float) -> None:
    field = StillField(TINY)
    field.fit(VIEWS, Budget(steps=40))
    field.cloud.params[:, OPACITY] = raw
    field.fit(VIEWS, Budget(steps=200))
    healthy(field, VIEWS)
    assert mean_psnr(field, VIEWS) > 16.0


@pytest.mark.slow
def test_bounds_are_kept_in_every_kernel(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """A whole fit and rendering with numba's bounds checks, in a process of its own."""
    code = """
from dataclasses import replace
import numpy as np
from msgspec import structs
from edge_server.fields import Budget
from tests.edge_server.fields.splat.test_hard_cases import TINY, VIEWS, StillField
bent = [replace(v, intrinsics=replace(v.intrinsics, distortion=(-.1, .01, .002, .001))) for v in VIEWS]
for extra, views in (({}, VIEWS), ({"sh_degree": 1, "contracted": True}, bent),
                     ({"flatten": 0.1, "align": 0.05}, bent)):
    field = StillField(structs.replace(TINY, **extra))
    field.fit(views, Budget(steps=25))
    out = field.render(VIEWS[0].camera_to_world, replace(VIEWS[0].intrinsics, width=37, height=19))
    assert np.isfinite(out.color).all()
moved = [replace(v, image=np.roll(v.image, 5, axis=1)) for v in VIEWS]
field.fit(moved, Budget(steps=20))
print("kept")
"""
    run_with_bounds_checks(code, tmp_path, request)
