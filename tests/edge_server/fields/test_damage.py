"""Damage to parameters of fields with rays: they stay finite, bounded and useful; and bounds of kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.common.cameras import settings as refinement
from edge_server.fields.common.kernels.adam import PARAMETER_LIMIT
from tests.edge_server.fields.scenes import mean_psnr, ring
from tests.edge_server.fields.small import healthy, run_with_bounds_checks, tiny

VIEWS = ring(9, size=24)
pytestmark = pytest.mark.stability
every_network = pytest.mark.parametrize("kind", ["ngp", "tensorf", "nerfacto"])

# Kinds and settings that together go through all kernels.
THROUGH_ALL: list[tuple[str, dict[str, Any]]] = [
    ("ngp", {"batch_samples": 8192, "rays": 9}),
    ("tensorf", {"upsample": (4, 8), "refine_m": 0.05, "refine_deg": 2.0}),
    ("tensorf", {"sh_degree": 1, "contracted": False, "radius_m": 1.0}),
    ("nerfacto", {"sh_degree": 1, "contracted": False, "radius_m": 1.0}),
    ("nerfacto", {"appearance": 3, "contracted": True, "radius_m": 0.5, "refine_m": 0.05, "refine_deg": 2.0}),
]


def go_through_all() -> None:
    """Fits, renderings and an update with every one of the settings, also with masked pixels."""
    refinement.START = 4
    masked = [replace(v, weight=(np.indices((24, 24)).sum(0) % 3 / 2).astype(np.float32)) for v in VIEWS]
    rolled = [replace(v, image=np.roll(v.image, 5, axis=1)) for v in VIEWS]
    for kind, extra in THROUGH_ALL:
        field = tiny(kind, **extra)
        for views in (VIEWS[:5], rolled, masked):
            field.fit(views, Budget(steps=10))
        assert np.isfinite(field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics).color).all()


def _poison_table(field: Any) -> None:
    field._encoding.table[::7] = np.nan  # of nerfacto, the proposal's too


def _poison_net(field: Any) -> None:
    field._net.params[3] = np.nan


def _poison_moments(field: Any) -> None:
    field._table_m[::5] = np.inf
    field._net_v[::3] = np.nan


def _poison_gradient(field: Any) -> None:
    field._table_g[::3] = np.nan
    field._dirty[:] = True


@pytest.mark.parametrize("damage", [_poison_table, _poison_net, _poison_moments, _poison_gradient])
@every_network
def test_damage_is_counted_and_healed(kind: str, damage: Callable[[Any], None]) -> None:
    """What is not finite is left out, counted if it is a gradient, and gone 40 steps later."""
    field = tiny(kind)
    field.fit(VIEWS, Budget(steps=30))
    damage(field)
    field._snapshot = None
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all()
    report = field.fit(VIEWS, Budget(steps=40))
    assert field.dropped == report.dropped and (report.dropped > 0) == (damage is not _poison_moments)
    assert field.fit(VIEWS, Budget(steps=100)).dropped == 0, "still not finite 40 steps later"
    healthy(field, VIEWS)
    assert mean_psnr(field, VIEWS) > 15.0


@pytest.mark.parametrize("value", [1e30, PARAMETER_LIMIT])
@every_network
def test_density_that_overflows_stays_finite(kind: str, value: float) -> None:
    """Opaque everywhere: no gradient leads out of that, but a reset does, and nothing becomes NaN."""
    field = tiny(kind)
    field.fit(VIEWS, Budget(steps=30))
    field._encoding.table[:] = value
    field._net.params[:] = PARAMETER_LIMIT
    field.fit(VIEWS, Budget(steps=20))
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all() and out.color.max() <= 1.0
    assert all(np.isfinite(a).all() for a in field.state().values() if a.dtype.kind == "f")
    field.reset()
    field.fit(VIEWS, Budget(steps=60))
    healthy(field, VIEWS)


@pytest.mark.slow
def test_bounds_are_kept_in_every_kernel(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """Whole fits and renderings with numba's bounds checks, in one process: most kernels are shared."""
    run_with_bounds_checks(f"from {__name__} import *\ngo_through_all()", tmp_path, request)
