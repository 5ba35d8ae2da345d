"""Hard cases for the voxel field: whatever comes, it stays finite, bounded and useful afterwards."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge_server.fields.voxel.field import VoxelField
from edge_server.fields.voxel.kernels.update import MAX_DENSITY
from tests.edge_server.fields.bounds import run_with_bounds_checks
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.voxel.small import TINY
from tests.stability.damage import counts_and_heals, overflows_and_begins_anew

VIEWS = ring(9, size=24)


def _poison_table(field: VoxelField) -> None:
    field._voxels.table[::7] = np.nan


def _poison_moments(field: VoxelField) -> None:
    field._second_moment[::3] = np.nan


def _poison_gradient(field: VoxelField) -> None:
    field._gradient[0, ::3] = np.nan
    field._dirty[0] = 1


def _overflow(field: VoxelField) -> None:
    field._voxels.table[:] = 1e30


def _saturate(field: VoxelField) -> None:
    field._voxels.table[:] = MAX_DENSITY


@pytest.mark.parametrize("damage", [_poison_table, _poison_moments, _poison_gradient])
def test_damage_is_counted_and_healed(damage: Callable[[VoxelField], None]) -> None:
    counts_and_heals(VoxelField(TINY), VIEWS, damage, damage is not _poison_moments)


@pytest.mark.parametrize("damage", [_overflow, _saturate])
def test_density_that_overflows_stays_finite(damage: Callable[[VoxelField], None]) -> None:
    overflows_and_begins_anew(VoxelField(TINY), VIEWS, damage)


@pytest.mark.slow
def test_bounds_are_kept_in_every_kernel(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """A whole fit and rendering with numba's bounds checks, in a process of its own."""
    code = """
from dataclasses import replace
import numpy as np
from edge_server.fields import Budget
from tests.stability.test_field_voxel import TINY, VIEWS, VoxelField
for extra in ({}, {"contracted": True, "radius_m": 0.5}, {"parts": 7, "rays": 9, "background": "random"}):
    field = VoxelField(replace(TINY, **extra))
    field.fit(VIEWS, Budget(steps=20))
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
    field.points(50)
    assert np.isfinite(out.color).all()
moved = [replace(v, image=np.roll(v.image, 5, axis=1)) for v in VIEWS]
field.fit(moved, Budget(steps=20))
field = VoxelField(replace(TINY, age_tau_ms=100.0, mask_stale_ms=60.0, mask_grow_px_s=9.0))
for later in range(3):
    field.fit([replace(v, image=np.roll(v.image, 3 * later, axis=0), generated_ns=later * 10**8 + k * 10**7)
               for k, v in enumerate(VIEWS)], Budget(steps=10))
packed = field.view_store._packed[1]
assert (packed.weight > 0).any() and packed.drawn.size, "nothing is masked"
print("kept")
"""
    run_with_bounds_checks(code, tmp_path, request)
