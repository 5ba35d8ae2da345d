"""Hard cases for the vector-matrix field: whatever comes, it stays finite, bounded and useful afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.kernels.adam import PARAMETER_LIMIT
from edge_server.fields.tensorf import TensorfField
from edge_server.fields.tensorf_settings import TensorfSettings
from freshfield.geometry import look_at
from tests.edge_server.fields.bounds import run_with_bounds_checks
from tests.edge_server.fields.scenes import mean_psnr, picture, ring

TINY = TensorfSettings(
    color_rank=8, resolution_start=12, resolution=32, upsample=(10, 25), hidden=16, rays=512,
    batch_samples=4096, samples=48, samples_ramp=100, cells=16, threads=2,
)  # fmt: skip
VIEWS = ring(9, size=24)


def _healthy(field: TensorfField, views: list[View] = VIEWS) -> None:
    state = field.state()
    for name in ("table", "net", "density", "behind"):
        assert np.isfinite(state[name]).all(), f"{name} is not finite"
    assert abs(state["table"]).max() <= PARAMETER_LIMIT
    for view in (views[0], views[-1]):
        out = field.render(view.camera_to_world, view.intrinsics)
        for part in (out.color, out.depth, out.opacity):
            assert np.isfinite(part).all()
        assert out.color.min() >= 0.0 and out.color.max() <= 1.0 and out.depth.min() >= 0.0
        assert out.opacity.min() >= -1e-6 and out.opacity.max() <= 1.0 + 1e-5


def _poison_table(field: TensorfField) -> None:
    field._encoding.table[::7] = np.nan


def _poison_net(field: TensorfField) -> None:
    field._net.params[3] = np.nan


def _poison_moments(field: TensorfField) -> None:
    field._table_m[::5] = np.inf
    field._net_v[::3] = np.nan


def _poison_gradient(field: TensorfField) -> None:
    field._table_g[::3] = np.nan
    field._dirty[:] = True


def _overflow(field: TensorfField) -> None:
    field._encoding.table[:] = 1e30


def _saturate(field: TensorfField) -> None:
    field._encoding.table[:] = PARAMETER_LIMIT
    field._net.params[:] = PARAMETER_LIMIT


@pytest.mark.parametrize("damage", [_poison_table, _poison_net, _poison_moments, _poison_gradient])
def test_damage_is_counted_and_healed(damage: Callable[[TensorfField], None]) -> None:
    field = TensorfField(TINY)
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
def test_density_that_overflows_stays_finite(damage: Callable[[TensorfField], None]) -> None:
    """Opaque everywhere: no gradient leads out of that, but a reset does, and nothing becomes NaN."""
    field = TensorfField(TINY)
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
    field, scores, sizes = TensorfField(TINY), [], []
    for update in range(1000):
        frame = frames[update % 12]
        field.fit([frame[k] for k in rng.choice(9, 6, replace=False)], Budget(steps=2))
        if update % 100 >= 88:
            scores.append(mean_psnr(field, frame[::4]))
            sizes.append(np.abs(field._encoding.table).mean())
    _healthy(field)
    first, last = np.mean(scores[12:36]), np.mean(scores[-24:])
    assert last > first - 1.0, f"drifted from {first:.1f} to {last:.1f} dB"
    assert last > 15.0
    assert np.mean(sizes[-12:]) < 3.0 * np.mean(sizes[12:24]), "parameters grow"
    assert len(field.rig.memory) == 9


def test_cameras_that_move_at_every_update() -> None:
    field = TensorfField(TINY)
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
from tests.stability.test_field_tensorf import TINY, VIEWS, TensorfField, Budget, replace, np
regular = {"smooth": 1e-3, "sparse": 1e-4, "contracted": False, "radius_m": 1.0}
cameras = {"exposure": True, "refine_m": 0.05, "refine_deg": 2.0}
for extra in ({}, {"harmonics": 4, **regular}, cameras, {"batch_samples": 8192, "rays": 9}):
    field = TensorfField(replace(TINY, **extra))
    field.fit(VIEWS, Budget(steps=50))
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics)
    field.points(50)
    assert np.isfinite(out.color).all()
moved = [replace(v, image=np.roll(v.image, 5, axis=1)) for v in VIEWS]
field.fit(moved, Budget(steps=20))
print("kept")
"""
    run_with_bounds_checks(code, tmp_path, request)
