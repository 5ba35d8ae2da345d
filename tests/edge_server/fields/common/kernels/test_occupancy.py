"""Cells of space: who sees them, how dense they are, which get samples; against plain numpy and torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from edge_server.fields import Budget
from edge_server.fields.common.kernels.occupancy import cell_centre, count_views, sample_density, threshold
from edge_server.fields.common.kernels.rays import COARSE
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW
from edge_server.fields.common.supervision import pack_cameras
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import NgpSettings
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.torch_model import encode, mlp, to_torch

CELLS = 8  # a task's worth of cells, so that its samples are all there afterwards
VIEWS = ring(5, size=24)
SETTINGS = NgpSettings(
    levels=4,
    log2_table=10,
    finest_resolution=32,
    hidden=16,
    rays=64,
    batch_samples=2048,
    samples=48,
    cells=16,
    samples_start=48,
    threads=1,
)


@pytest.fixture(scope="module")
def field() -> NgpField:
    made = NgpField(SETTINGS, CallerPool())
    made.fit(VIEWS, Budget(steps=10))
    return made


def _centres(cells: int, contracted: bool) -> tuple[NDArray, NDArray]:
    """Scene points (cells^3, 3), x fastest, of a grid's centres and by how much space is contracted there."""
    side = (np.arange(cells) + 0.5) / cells * 2.0 - 1.0
    k, j, i = np.meshgrid(side, side, side, indexing="ij")
    inside = np.stack([i, j, k], axis=-1).reshape(-1, 3) * (2.0 if contracted else 1.0)
    m = np.abs(inside).max(axis=-1)
    far = np.where(m > 1.0, 1.0 / (2.0 - np.minimum(m, 1.999)), 1.0)
    points = np.where(m[:, None] > 1.0, inside / m[:, None] * far[:, None], inside)
    return points, far**2


@pytest.mark.parametrize("contracted", [False, True])
def test_centres_of_cells_are_those_of_contracted_space(contracted: bool) -> None:
    points, stretch = _centres(CELLS, contracted)
    mine = np.array([cell_centre(k, CELLS, contracted) for k in range(CELLS**3)])
    np.testing.assert_allclose(mine[:, :3], points, rtol=1e-12)
    np.testing.assert_allclose(mine[:, 3], stretch, rtol=1e-12)


@pytest.mark.parametrize("contracted", [False, True])
def test_views_of_a_cell_are_those_whose_picture_it_is_in(field: NgpField, contracted: bool) -> None:
    box = field.view_store.box
    assert box is not None
    near, cells = 1.1, 16  # of scene units: the nearest cells of each camera are too near
    views = pack_cameras(VIEWS, box)
    points, _ = _centres(cells, contracted)
    mask = np.random.default_rng(1).random((2, 24, 24)) < 0.4
    first = np.array([-1, 0, -1, 24 * 24, -1], np.int64)
    seen, marked = np.full(cells**3, 9, np.uint16), np.full(cells**3, 9, np.uint16)
    CallerPool().run(count_views, cells, contracted, near, views, first, mask.astype(np.uint8).ravel(), seen, marked)
    expected, flagged, clear = np.zeros(cells**3, int), np.zeros(cells**3, int), np.ones(cells**3, bool)
    for v, view in enumerate(VIEWS):
        pose = view.camera_to_world
        there = (points - box.normalise(pose[:3, 3])) @ pose[:3, :3]
        depth = there[:, 2]
        camera = view.intrinsics
        with np.errstate(divide="ignore", invalid="ignore"):
            column = camera.fx * there[:, 0] / there[:, 2] + camera.cx
            row = camera.fy * there[:, 1] / there[:, 2] + camera.cy
        inside = (depth > near) & (column >= 0) & (column < 24) & (row >= 0) & (row < 24)
        expected += inside
        if first[v] >= 0:
            at = np.flatnonzero(inside)
            flagged[at] += mask[first[v] // (24 * 24), row[at].astype(int), column[at].astype(int)]
        # Where rounding decides (a pixel's edge, the near plane), neither answer is wrong.
        edge = np.minimum(np.abs(column - np.round(column)), np.abs(row - np.round(row))) < 1e-6
        clear &= ~edge & (np.abs(depth - near) > 1e-6)
    assert clear.mean() > 0.9 and len(set(expected[clear])) > 3 and 0 < flagged.sum() < expected.sum()
    np.testing.assert_array_equal(seen[clear], expected[clear])
    np.testing.assert_array_equal(marked[clear], flagged[clear])


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("phase", [0, 2])
def test_density_of_cells_is_the_oracles(field: NgpField, contracted: bool, phase: int) -> None:
    phases, fade, few = 3, 0.75, 2
    rng = np.random.default_rng(3)
    seen = rng.integers(0, 5, CELLS**3).astype(np.uint16)
    before = rng.random(CELLS**3).astype(np.float32) * 3.0
    density, acts, x = before.copy(), field._scratch.acts, np.full_like(field._batch.x, np.nan)
    CallerPool().run(
        sample_density,
        np.uint64(11),
        phase,
        phases,
        np.float32(fade),
        field._encoding,
        SETTINGS.levels,
        field._net,
        CELLS,
        contracted,
        seen,
        few,
        density,
        acts,
        x,
    )
    here = np.arange(phase, CELLS**3, phases)
    np.testing.assert_array_equal(np.delete(density, here), np.delete(before, here))
    np.testing.assert_array_equal(density[here[seen[here] < few]], 0.0)
    looked = here[seen[here] >= few]
    places = x[0, :, : len(looked)].T.astype(np.float64)
    cell = (places * CELLS).astype(int)
    np.testing.assert_array_equal(cell @ [1, CELLS, CELLS**2], looked)
    apart = places * CELLS - cell
    assert apart.min() < 0.1 and apart.max() > 0.9 and abs(apart.mean() - 0.5) < 0.1
    grid = to_torch(field._encoding, dtype=torch.float64)
    params = torch.as_tensor(field._net.params, dtype=torch.float64)
    raw = mlp(field._net.widths.tolist(), params, encode(grid, SETTINGS.levels, torch.as_tensor(places)))
    sigma = raw[:, 0].clamp(RAW_LOW, RAW_HIGH).exp().numpy() * _centres(CELLS, contracted)[1][looked]
    expected = np.maximum(before[looked] * fade, sigma)
    assert 0.05 < np.mean(expected == sigma) < 0.95, "both the old and the new density must win somewhere"
    np.testing.assert_allclose(density[looked], expected, rtol=2e-4)


def test_a_density_that_is_not_finite_is_looked_at_again(field: NgpField) -> None:
    poisoned = field._net._replace(params=np.full_like(field._net.params, np.nan))
    density = np.zeros(CELLS**3, np.float32)
    CallerPool().run(
        sample_density,
        np.uint64(1),
        0,
        1,
        np.float32(0.5),
        field._encoding,
        SETTINGS.levels,
        poisoned,
        CELLS,
        False,
        np.ones(CELLS**3, np.uint16),
        1,
        density,
        field._scratch.acts,
        field._batch.x.copy(),
    )
    assert np.isfinite(density).all() and density.min() > 1.0


@pytest.mark.parametrize(("bound", "kept"), [(0.1, "all that reach it"), (40.0, "never none")])
def test_cells_that_reach_the_bound_are_occupied(bound: float, kept: str) -> None:
    cells = 4 * COARSE
    rng = np.random.default_rng(5)
    density = rng.gamma(0.3, 2.0, cells**3).astype(np.float32)
    density.reshape(cells, cells, cells)[: cells // 2] = 0.0
    seen = rng.integers(0, 4, cells**3).astype(np.uint16)
    occupied, coarse = np.full(cells**3, 7, np.uint8), np.full((cells // COARSE) ** 3, 7, np.uint8)
    threshold(density, seen, 2, bound, cells, occupied, coarse)
    known = seen >= 2
    mean = np.minimum(density[known].astype(np.float64), 10.0 * bound).mean()
    expected = known & (density >= min(bound, 0.7 * mean))
    assert (bound < 0.7 * mean) == (kept == "all that reach it") and 0 < expected.sum() < known.sum()
    np.testing.assert_array_equal(occupied, expected)
    blocks = expected.reshape((cells // COARSE, COARSE) * 3).any(axis=(1, 3, 5))
    np.testing.assert_array_equal(coarse, blocks.ravel())
