"""Cells of space: who sees them, how dense they are, which get samples; against plain numpy and torch."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from edge_server.fields.common.kernels.occupancy import Cells, sample_density, threshold
from edge_server.fields.common.kernels.rays import COARSE
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW
from edge_server.fields.common.occupancy_grid import OccupancyGrid, cell_centers
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.supervision import CameraMemory
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.common.view_store import ViewStore
from tests.edge_server.fields.small import KERNEL_SETTINGS as SETTINGS
from tests.edge_server.fields.small import KERNEL_VIEWS as VIEWS
from tests.edge_server.fields.small import kernel_field
from tests.edge_server.fields.torch_model import encode, mlp, to_torch

CELLS = 8  # a task's worth of cells, so that its samples are all there afterwards


def _centers(cells: int, contracted: bool) -> tuple[NDArray, NDArray]:
    """Scene points (cells^3, 3), x fastest, of a grid's centers and by how much space is contracted there."""
    side = (np.arange(cells) + 0.5) / cells * 2.0 - 1.0
    k, j, i = np.meshgrid(side, side, side, indexing="ij")
    inside = np.stack([i, j, k], axis=-1).reshape(-1, 3) * (2.0 if contracted else 1.0)
    m = np.abs(inside).max(axis=-1)
    far = np.where(m > 1.0, 1.0 / (2.0 - np.minimum(m, 1.999)), 1.0)
    points = np.where(m[:, None] > 1.0, inside / m[:, None] * far[:, None], inside)
    return points, far**2


def test_cells_where_most_cameras_see_motion_are_occupied() -> None:
    """At least two cameras, and half of those that see the cell: the visual hull of what moved."""
    lens = replace(VIEWS[0].intrinsics, distortion=(-0.12, 0.03, 0.01, -0.015))
    views = [replace(view, intrinsics=lens) for view in VIEWS]
    box, moved = scene_box(views), np.zeros((24, 24), bool)
    moved[8:16, 8:16] = True
    grid = OccupancyGrid(16, 2, box)
    memory = {v.camera: CameraMemory(v, moved if k < 3 else None) for k, v in enumerate(views)}
    grid.density[:] = 0.0
    grid.recount_views(CallerPool(), cast(ViewStore, SimpleNamespace(box=box, views=views, memory=memory)))
    points, _ = _centers(16, box.contracted)
    seen, marked = np.zeros(len(points), int), np.zeros(len(points), int)
    for k, view in enumerate(views):
        local = (points * box.radius_m + box.center_m - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]
        u, v = view.intrinsics.project(np.where(local[:, 2:] > box.near_m, local, 1.0)).T
        inside = (local[:, 2] > box.near_m) & (u >= 0) & (u < 24) & (v >= 0) & (v < 24)
        seen += inside
        marked += inside & (k < 3) & (u >= 8) & (u < 16) & (v >= 8) & (v < 16)
    assert (grid.seen == seen).mean() > 0.99  # rounding decides at edges
    expected = np.where((marked >= 2) & (2 * marked >= seen), 0.75, 0.0)
    assert (expected > 0).sum() > 20 and (grid.density == expected).mean() > 0.99
    assert (grid.occupied[grid.density > 0] == 1).all()


@pytest.mark.parametrize(("contracted", "phase"), [(False, 0), (True, 2)])
def test_density_of_cells_is_the_oracles(contracted: bool, phase: int) -> None:
    field = kernel_field()
    phases, fade, few = 3, 0.75, 2
    rng = np.random.default_rng(3)
    seen = rng.integers(0, 5, CELLS**3).astype(np.uint16)
    before = rng.random(CELLS**3).astype(np.float32) * 3.0
    density, acts, x = before.copy(), field._scratch.acts, np.full_like(field._batch.x, np.nan)
    cells = Cells(CELLS, seen, few, cell_centers(CELLS, contracted)[1], density)
    model = field._encoding, SETTINGS.levels, field._net
    CallerPool().run(sample_density, np.uint64(11), phase, phases, np.float32(fade), *model, cells, acts, x)
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
    sigma = raw[:, 0].clamp(RAW_LOW, RAW_HIGH).exp().numpy() * _centers(CELLS, contracted)[1][looked]
    expected = np.maximum(before[looked] * fade, sigma)
    assert 0.05 < np.mean(expected == sigma) < 0.95, "both the old and the new density must win somewhere"
    np.testing.assert_allclose(density[looked], expected, rtol=2e-4)


@pytest.mark.parametrize(("bound", "kept"), [(0.1, "all that reach it"), (40.0, "never none")])
def test_cells_that_reach_the_bound_are_occupied(bound: float, kept: str) -> None:
    cells = 4 * COARSE
    rng = np.random.default_rng(5)
    density = rng.gamma(0.3, 2.0, cells**3).astype(np.float32)
    density.reshape(cells, cells, cells)[: cells // 2] = 0.0
    seen = rng.integers(0, 4, cells**3).astype(np.uint16)
    occupied, coarse = np.full(cells**3, 7, np.uint8), np.full((cells // COARSE) ** 3, 7, np.uint8)
    threshold(Cells(cells, seen, 2, np.ones_like(density), density), bound, occupied, coarse)
    known = seen >= 2
    mean = np.minimum(density[known].astype(np.float64), 10.0 * bound).mean()
    expected = known & (density >= min(bound, 0.7 * mean))
    assert (bound < 0.7 * mean) == (kept == "all that reach it") and 0 < expected.sum() < known.sum()
    np.testing.assert_array_equal(occupied, expected)
    blocks = expected.reshape((cells // COARSE, COARSE) * 3).any(axis=(1, 3, 5))
    np.testing.assert_array_equal(coarse, blocks.ravel())
