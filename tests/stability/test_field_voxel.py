"""Hard cases for the voxel field: whatever comes, it stays finite, bounded and useful afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.kernels.voxel_update import DENSEST
from edge_server.fields.voxel import VoxelField
from edge_server.fields.voxel_settings import VoxelSettings
from freshfield.geometry import look_at
from tests.edge_server.fields.bounds import run_with_bounds_checks
from tests.edge_server.fields.scenes import mean_psnr, picture, ring

TINY = VoxelSettings(sizes=(12, 20, 32), refine_at=(10, 25), rays=512, cells=16, threads=2)
VIEWS = ring(9, size=24)


def _healthy(field: VoxelField, views: list[View] = VIEWS) -> None:
    state = field.state()
    for name in ("table", "density", "behind"):
        assert np.isfinite(state[name]).all(), f"{name} is not finite"
    assert state["table"].min() >= 0.0 and state["table"][:, 0].max() <= DENSEST
    assert state["table"][:, 1:].max() <= 1.0
    for view in (views[0], views[-1]):
        out = field.render(view.camera_to_world, view.intrinsics)
        for part in (out.color, out.depth, out.opacity):
            assert np.isfinite(part).all()
        assert out.color.min() >= 0.0 and out.color.max() <= 1.0 and out.depth.min() >= 0.0
        assert out.opacity.min() >= -1e-6 and out.opacity.max() <= 1.0 + 1e-5


def _poison_table(field: VoxelField) -> None:
    field._voxels.table[::7] = np.nan


def _poison_moments(field: VoxelField) -> None:
    field._v[::3] = np.nan


def _poison_gradient(field: VoxelField) -> None:
    field._gradient[0, ::3] = np.nan
    field._dirty[0] = 1


def _overflow(field: VoxelField) -> None:
    field._voxels.table[:] = 1e30


def _saturate(field: VoxelField) -> None:
    field._voxels.table[:] = DENSEST


@pytest.mark.parametrize("damage", [_poison_table, _poison_moments, _poison_gradient])
def test_damage_is_counted_and_healed(damage: Callable[[VoxelField], None]) -> None:
    field = VoxelField(TINY)
    field.fit(VIEWS, Budget(steps=30))
    damage(field)
    field._snapshot = None
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all()
    report = field.fit(VIEWS, Budget(steps=40))
    assert field.dropped == report.dropped and (report.dropped > 0) == (damage is not _poison_moments)
    assert field.fit(VIEWS, Budget(steps=200)).dropped == 0, "still not finite 40 steps later"
    _healthy(field)
    assert mean_psnr(field, VIEWS) > 15.0


@pytest.mark.parametrize("damage", [_overflow, _saturate])
def test_density_that_overflows_stays_finite(damage: Callable[[VoxelField], None]) -> None:
    """Opaque everywhere: no gradient leads out of that, but a reset does, and nothing becomes NaN."""
    field = VoxelField(TINY)
    field.fit(VIEWS, Budget(steps=30))
    damage(field)
    field.fit(VIEWS, Budget(steps=20))
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all() and out.color.max() <= 1.0
    assert all(np.isfinite(a).all() for a in field.state().values() if a.dtype.kind == "f")
    field.reset()
    field.fit(VIEWS, Budget(steps=200))
    _healthy(field)
    assert mean_psnr(field, VIEWS) > 15.0


def test_a_thousand_updates_do_not_drift_or_grow() -> None:
    """A moving ball, a new selection of views each time, warm starts only."""
    rng = np.random.default_rng(1)
    still = ring(9, size=24)
    places = [np.array([0.3 * np.sin(a), 0.3 * np.cos(a), 0.5]) for a in np.linspace(0, 2 * np.pi, 12)]
    frames = [[replace(v, image=picture(v.intrinsics, v.camera_to_world, p)) for v in still] for p in places]
    field, scores, sizes = VoxelField(TINY), [], []
    for update in range(1000):
        frame = frames[update % 12]
        field.fit([frame[k] for k in rng.choice(9, 6, replace=False)], Budget(steps=2))
        if update % 100 >= 88:
            scores.append(mean_psnr(field, frame[::4]))
            sizes.append(np.abs(field._voxels.table).mean())
    _healthy(field)
    first, last = np.mean(scores[12:36]), np.mean(scores[-24:])
    assert last > first - 1.0, f"drifted from {first:.1f} to {last:.1f} dB"
    assert last > 15.0
    assert np.mean(sizes[-12:]) < 3.0 * np.mean(sizes[12:24]), "parameters grow"
    assert len(field.rig.memory) == 9


def test_cameras_that_move_at_every_update() -> None:
    field = VoxelField(TINY)
    for update in range(30):
        views = []
        for view in VIEWS[:4]:
            eye = view.camera_to_world[:3, 3] + 0.05 * update * np.array([0.0, 0.0, 1.0])
            pose = look_at(eye, (0.0, 0.0, 0.4))
            views.append(replace(view, camera_to_world=pose, image=picture(view.intrinsics, pose)))
        field.fit(views, Budget(steps=5))
    _healthy(field, views)
    assert mean_psnr(field, views) > 15.0


@pytest.mark.slow
def test_bounds_are_kept_in_every_kernel(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """A whole fit and rendering with numba's bounds checks, in a process of its own."""
    code = """
from tests.stability.test_field_voxel import TINY, VIEWS, VoxelField, Budget, replace, np
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
assert (field.rig._packed[1].weight > 0).any() and field.rig._packed[1].drawn.size, "nothing is masked"
print("kept")
"""
    run_with_bounds_checks(code, tmp_path, request)
