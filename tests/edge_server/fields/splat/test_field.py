"""What only the field of still Gaussians does; ``test_every_representation`` has the rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from edge_server.fields import Budget
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.plane_sweep import NOT_SEEN, SEES, UNMARKED, score_cells
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.supervision import pack_cameras
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.kernels.project import OPACITY
from edge_server.fields.splat.seeding import seed_gaussians
from tests.edge_server.fields.bounds import run_with_bounds_checks
from tests.edge_server.fields.scenes import mean_psnr, picture, ring
from tests.edge_server.fields.small import HELD, SEEN, VIEWS, healthy, score
from tests.edge_server.fields.splat.small import SMALL, TINY


def test_nothing_begins_at_pixels_without_weight() -> None:
    box, pool, rng = scene_box(SEEN), CallerPool(), np.random.default_rng
    weight = [np.full(v.image.shape[:2], k % 2, np.float32) for k, v in enumerate(SEEN)]
    found = []
    for other in (False, True):  # views of weight 0 may show anything
        views = [replace(v, image=255 - v.image) if other and k % 2 == 0 else v for k, v in enumerate(SEEN)]
        share = np.concatenate([w.ravel() for w in weight])
        found.append(seed_gaussians(SMALL, pool, box, views, None, share, 300, rng(1)))
    assert len(found[0]) > 100
    np.testing.assert_array_equal(found[0], found[1])
    assert len(seed_gaussians(SMALL, pool, box, SEEN, None, np.zeros_like(share), 300, rng(1))) == 0


@pytest.mark.parametrize("contracted", [False, True])
def test_where_something_moved_only_cells_that_most_cameras_see_move_are_scored(contracted: bool) -> None:
    box, pool, cells = replace(scene_box(SEEN), contracted=contracted), CallerPool(), 12
    cams = camera_rows([v.camera_to_world for v in SEEN], [v.intrinsics for v in SEEN], box)
    data, rng = pack_cameras(SEEN, box), np.random.default_rng(3)
    pixels = np.concatenate([v.image.reshape(-1, 3) for v in SEEN])
    says = rng.choice([0, SEES, SEES + UNMARKED], len(pixels) + 1, p=[0.1, 0.7, 0.2]).astype(np.int32)
    for k in range(0, len(SEEN), 2):  # most of them mark nothing
        says[data.first[k] : data.first[k + 1]] = SEES + UNMARKED
    says[-1] = 0
    data = data._replace(weight=(says[:-1] > 0).astype(np.float32))

    def scores(says: np.ndarray) -> np.ndarray:
        found = np.zeros(cells**3, np.float32)
        none, tolerance = np.zeros(0, np.float32), np.float32(0.3)
        pool.run(score_cells, cams, data, pixels, says, none, tolerance, contracted, cells, 2, found)
        return found

    everywhere, where_marked = scores(np.zeros(0, np.int32)), scores(says)
    side = (np.arange(cells) + 0.5) * (4.0 if contracted else 2.0) / cells - (2.0 if contracted else 1.0)
    z, y, x = np.meshgrid(side, side, side, indexing="ij")
    places = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    far = np.abs(places).max(axis=1, keepdims=True)
    if contracted:
        places = np.where(far > 1.0, places / ((2.0 - far) * far), places)
    seen, unmarked = np.zeros(len(places), int), np.zeros(len(places), int)
    for k, view in enumerate(SEEN):
        away = places * box.radius_m + box.center_m - view.camera_to_world[:3, 3]
        local = away @ view.camera_to_world[:3, :3]
        ahead = local[:, 2] > max(0.01 * box.radius_m, box.near_m)
        u, v = np.where(ahead[:, None], view.intrinsics.project(np.where(ahead[:, None], local, 1.0)), -1.0).T
        inside = (u >= 0) & (v >= 0) & (u < view.intrinsics.width) & (v < view.intrinsics.height)
        pixel = np.where(inside, v.astype(int) * view.intrinsics.width + u.astype(int), 0)
        told = np.where(inside, says[data.first[k] : data.first[k + 1]][pixel], 0)
        seen, unmarked = seen + told % UNMARKED, unmarked + told // UNMARKED
    expected = np.where(2 * unmarked > seen, NOT_SEEN, everywhere)
    assert 0.02 < (expected > NOT_SEEN).mean() < 0.8 * (everywhere > NOT_SEEN).mean()
    # Rounding puts the middle of a cell now and then into the next pixel.
    assert (where_marked == expected).mean() > 0.99


def test_the_number_of_gaussians_grows_to_the_cap_and_no_further() -> None:
    field = StillField(SMALL)
    counts = []
    for _ in range(12):
        field.fit(SEEN, Budget(steps=20))
        counts.append(len(field.cloud))
    assert counts[0] < counts[-1] == max(counts) <= SMALL.gaussians and counts[-1] > 1400


def test_view_dependent_colors_learn() -> None:
    field = StillField(structs.replace(SMALL, sh_degree=1))
    field.fit(SEEN, Budget(steps=200))
    assert score(field) > 18.0


def test_a_lens_with_distortion_needs_no_undistortion() -> None:
    bent = replace(HELD.intrinsics, distortion=(-0.15, 0.02, 0.003, -0.002))
    views = [replace(v, intrinsics=bent, image=picture(bent, v.camera_to_world)) for v in VIEWS]
    field = StillField(SMALL)
    field.fit(views[:6] + views[7:], Budget(steps=250))
    assert score(field, views[6]) > 20.0
    assert score(field, HELD) > 19.0, "a pinhole camera sees the same scene"


TINY_VIEWS = ring(9, size=24)


def _parameter(column: int, value: float, every: int = 7) -> Callable[[StillField], None]:
    def damage(field: StillField) -> None:
        field.cloud.params[::every, column] = value

    return damage


def _moments(field: StillField) -> None:
    field.cloud.m[::5] = np.inf
    field.cloud.v[::3] = np.nan


@pytest.mark.stability
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
    field.fit(TINY_VIEWS, Budget(steps=40))
    damage(field)
    field._snapshot = None
    out = field.render(TINY_VIEWS[0].camera_to_world, TINY_VIEWS[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all()
    field.fit(TINY_VIEWS, Budget(steps=120))
    healthy(field, TINY_VIEWS)
    assert mean_psnr(field, TINY_VIEWS) > 17.0
    assert field.fit(TINY_VIEWS, Budget(steps=40)).dropped == 0, "still not finite 120 steps later"


@pytest.mark.stability
@pytest.mark.parametrize("raw", [-30.0, 30.0])
def test_everything_faded_or_opaque(raw: float) -> None:
    field = StillField(TINY)
    field.fit(TINY_VIEWS, Budget(steps=40))
    field.cloud.params[:, OPACITY] = raw
    field.fit(TINY_VIEWS, Budget(steps=200))
    healthy(field, TINY_VIEWS)
    assert mean_psnr(field, TINY_VIEWS) > 16.0


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
                     ({"flatten": 0.1, "align": 0.05}, bent)):
    field = StillField(structs.replace(TINY, **extra))
    field.fit(views, Budget(steps=25))
    out = field.render(TINY_VIEWS[0].camera_to_world, replace(TINY_VIEWS[0].intrinsics, width=37, height=19))
    assert np.isfinite(out.color).all()
moved = [replace(v, image=np.roll(v.image, 5, axis=1)) for v in TINY_VIEWS]
field.fit(moved, Budget(steps=20))
print("kept")
"""
    run_with_bounds_checks(code, tmp_path, request)
