"""Damage to parameters of fields with rays: they stay finite, bounded and useful; and bounds of kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.common.cameras import settings as refinement
from edge_server.fields.common.kernels.adam import PARAMETER_LIMIT
from tests.edge_server.fields.bounds import run_with_bounds_checks
from tests.edge_server.fields.scenes import mean_psnr, ring
from tests.edge_server.fields.small import healthy, tiny

KINDS = ("ngp", "tensorf", "nerfacto")  # with a network
VIEWS = ring(9, size=24)
pytestmark = pytest.mark.stability

_PLAIN = {"contracted": False, "radius_m": 1.0}
_POSES = {"refine_m": 0.05, "refine_deg": 2.0}
_FEW = {"batch_samples": 8192, "rays": 9}
# Of each kind, settings that together go through all of its kernels.
THROUGH_ALL: dict[str, tuple[dict[str, Any], ...]] = {
    "ngp": ({}, {"sh_degree": 1, **_PLAIN}, _FEW),
    "tensorf": ({"upsample": (4, 8)}, {"sh_degree": 1, **_PLAIN}, _POSES, _FEW),
    "nerfacto": (
        {"sh_degree": 1, **_PLAIN},
        {"appearance": 3, **_POSES},
        {**_FEW, "contracted": True, "radius_m": 0.5},
    ),
}


def go_through_all(kind: str) -> None:
    """Fits, renderings and an update with every one of the settings, also with masked pixels."""
    refinement.START = 4
    for extra in THROUGH_ALL[kind]:
        field = tiny(kind, **extra)
        field.fit(VIEWS[:5], Budget(steps=12))
        out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
        assert np.isfinite(out.color).all()
    field.fit([replace(v, image=np.roll(v.image, 5, axis=1)) for v in VIEWS], Budget(steps=9))
    masked = [replace(v, weight=(np.indices((24, 24)).sum(0) % 3 / 2).astype(np.float32)) for v in VIEWS]
    field.fit(masked, Budget(steps=9))
    packed = field.view_store._packed
    assert packed is not None and packed[1].drawn.size, "nothing is masked"


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
@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_counted_and_healed(kind: str, damage: Callable[[Any], None]) -> None:
    """What is not finite is left out, counted if it is a gradient, and gone 40 steps later."""
    field = tiny(kind)
    field.fit(VIEWS, Budget(steps=30))
    damage(field)
    field._snapshot = None
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all()
    report = field.fit(VIEWS, Budget(steps=40))
    counted = damage is not _poison_moments
    assert field.dropped == report.dropped and (report.dropped > 0) == counted
    assert field.fit(VIEWS, Budget(steps=100)).dropped == 0, "still not finite 40 steps later"
    healthy(field, VIEWS)
    assert mean_psnr(field, VIEWS) > 15.0


@pytest.mark.parametrize(("kind", "value"), product(KINDS, (1e30, PARAMETER_LIMIT)))
def test_density_that_overflows_stays_finite(kind: str, value: float) -> None:
    """Opaque everywhere: no gradient leads out of that, but a reset does, and nothing becomes NaN."""
    field = tiny(kind)
    field.fit(VIEWS, Budget(steps=30))
    field._encoding.table[:] = value
    if value == PARAMETER_LIMIT:
        field._net.params[:] = value
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
    code = f"from {__name__} import *\nfor kind in THROUGH_ALL:\n    go_through_all(kind)\nprint('kept')\n"
    run_with_bounds_checks(code, tmp_path, request)
