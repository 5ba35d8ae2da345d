"""Hard cases that every field with rays has in common: whatever comes, it stays finite and useful afterwards.

What is particular to one (damage to its parameters, its limits) is in its own ``test_field_*``, as is splat.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.nerfacto import NerfactoField
from edge_server.fields.ngp import NgpField
from edge_server.fields.tensorf import TensorfField
from edge_server.fields.voxel import VoxelField
from freshfield.geometry import look_at
from tests.edge_server.fields.scenes import mean_psnr
from tests.stability import test_field_nerfacto, test_field_ngp, test_field_tensorf, test_field_voxel
from tests.stability.test_field_ngp import VIEWS


class Case(NamedTuple):
    """One representation, small, and what has to hold of it after anything."""

    kind: Any
    tiny: Any
    healthy: Callable[[Any, list[View]], None]


CASES = {
    "ngp": Case(NgpField, test_field_ngp.TINY, test_field_ngp._healthy),
    "tensorf": Case(TensorfField, test_field_tensorf.TINY, test_field_tensorf._healthy),
    "voxel": Case(VoxelField, test_field_voxel.TINY, test_field_voxel._healthy),
    "nerfacto": Case(NerfactoField, test_field_nerfacto.TINY, test_field_nerfacto._healthy),
}
every = pytest.mark.parametrize("case", CASES.values(), ids=CASES)


@every
def test_nothing_at_all(case: Case) -> None:
    field = case.kind(case.tiny)
    assert field.fit([], Budget(steps=3)).steps == 0
    points, colors = field.points(10)
    assert points.shape == (0, 3) and colors.shape == (0, 3)
    case.healthy(field, VIEWS)


@every
def test_one_view(case: Case) -> None:
    field = case.kind(case.tiny)
    field.fit(VIEWS[:1], Budget(steps=60))
    case.healthy(field, VIEWS)
    assert mean_psnr(field, VIEWS[:1]) > 15.0


@every
def test_one_pixel(case: Case) -> None:
    camera = replace(VIEWS[0].intrinsics, width=1, height=1, cx=0.5, cy=0.5)
    view = replace(VIEWS[0], image=np.full((1, 1, 3), 99, np.uint8), intrinsics=camera)
    field = case.kind(case.tiny)
    field.fit([view], Budget(steps=10))
    case.healthy(field, [view])


@pytest.mark.parametrize("value", [0, 255, 77])
@pytest.mark.parametrize("channels", [3, 4])
@every
def test_constant_black_and_saturated_pictures(case: Case, value: int, channels: int) -> None:
    views = [replace(v, image=np.full((24, 24, channels), value, np.uint8)) for v in VIEWS]
    field = case.kind(case.tiny)
    field.fit(views, Budget(steps=60))
    case.healthy(field, VIEWS)
    out = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics).color
    alpha = value / 255.0 if channels == 4 else 1.0
    expected = value / 255.0 * alpha + (1.0 - alpha) * field.rig.background().mean()
    assert abs(out.mean() - expected) < 0.1


@every
def test_all_poses_identical(case: Case) -> None:
    pose = VIEWS[0].camera_to_world
    views = [replace(v, camera_to_world=pose, image=VIEWS[0].image) for v in VIEWS]
    field = case.kind(case.tiny)
    field.fit(views, Budget(steps=60))
    case.healthy(field, VIEWS)


@every
def test_rays_that_miss_the_box(case: Case) -> None:
    field = case.kind(replace(case.tiny, centre_m=(50.0, 0.0, 0.0), radius_m=0.5, contracted=False))
    report = field.fit(VIEWS, Budget(steps=20))
    assert report.steps == 20 and report.rays > 0 and report.samples == 0
    case.healthy(field, VIEWS)
    away = look_at((0, 0, 3.0), (0, 0, 9.0), up=(0, 1, 0))
    trained = case.kind(case.tiny)
    trained.fit(VIEWS, Budget(steps=20))
    out = trained.render(away, VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all()


@every
def test_views_that_contradict_each_other(case: Case) -> None:
    rng = np.random.default_rng(0)
    views = [replace(v, image=rng.integers(0, 256, (24, 24, 3), dtype=np.uint8)) for v in VIEWS]
    field = case.kind(case.tiny)
    for _ in range(5):
        field.fit(views, Budget(steps=20))
    case.healthy(field, VIEWS)
    field.fit(VIEWS, Budget(steps=150))  # and it recovers
    assert mean_psnr(field, VIEWS) > 16.0
