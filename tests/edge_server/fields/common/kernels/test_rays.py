"""Pixel to ray, ray to samples, and the cells that get some: against ``freshfield.geometry``, numpy and torch."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from numba import njit
from numpy.typing import NDArray

from edge_server.fields.common.kernels.occupancy import Cells, sample_density, threshold
from edge_server.fields.common.kernels.rays import COARSE, NEVER, Space, interval, march, pixel_direction, unit_cube
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW
from edge_server.fields.common.occupancy_grid import OccupancyGrid, cell_centers
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.supervision import CameraMemory, lens_row
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.common.view_store import ViewStore
from edge_server.fields.field_constants import HORIZON
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.small import KERNEL_SETTINGS as SETTINGS
from tests.edge_server.fields.small import KERNEL_VIEWS as VIEWS
from tests.edge_server.fields.small import kernel_field
from tests.edge_server.fields.torch_model import encode, mlp, to_torch

_direction = njit(lambda lens, rotation, u, v: pixel_direction(lens, rotation, u, v))
_interval = njit(lambda space, o, d: interval(space, o, d))
_unit_cube = njit(lambda contracted, x, y, z: unit_cube(contracted, x, y, z))

CELLS = 16


def _space(contracted: bool, filled: float) -> Space:
    rng = np.random.default_rng(5)
    occupied = (rng.random(CELLS**3) < filled).astype(np.uint8)
    blocks = occupied.reshape([4, 4, 4, 4, 4, 4]).max(axis=(1, 3, 5)).reshape(-1)
    density = np.full(CELLS**3, 1.5, np.float32)
    return Space(occupied, blocks, density, CELLS, contracted, np.float32(2 * 3**0.5 / 32), np.float32(0.1))


def _march(space: Space, o, d, jitter: float = 0.0, room=slice(0, 500), opaque=NEVER):
    """Places (3, N), distances and lengths (N,) of the samples in ``room``, where the march ended, and its depth."""
    x, ts, dts = np.zeros((3, 500), np.float32), np.zeros(500, np.float32), np.zeros(500, np.float32)
    o, d = (tuple(map(np.float32, v)) for v in (o, d))
    enter, leave = map(np.float32, _interval(space, o, d))
    first = np.float32(enter + np.float32(jitter) * space.step)
    n, t, depth = march(space, o, d, first, leave, x, ts, dts, room.start, room.stop, opaque)
    assert (x[:, : room.start] == 0).all() and (n < room.stop or t < leave)
    return x[:, room.start : n], ts[room.start : n], dts[room.start : n], depth


@pytest.mark.parametrize("distortion", [(0, 0, 0, 0), (0.06, -0.08, -0.001, 0.0002), (-0.3, 0.03, 0.01, 0.005)])
def test_directions_are_those_of_the_pinhole_camera(distortion: tuple) -> None:
    camera = Pinhole(40, 30, 35.0, 36.0, 19.0, 16.0, distortion)
    pose = look_at((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    expected = camera.rays() @ pose[:3, :3].T
    lens, rotation = np.array(lens_row(camera)), np.ascontiguousarray(pose[:3, :3])
    for u, v in ((0, 0), (39, 29), (11, 23)):
        got = _direction(lens, rotation, u + 0.5, v + 0.5)
        np.testing.assert_allclose(got, expected[v, u], atol=2e-7)


def _march_oracle(space: Space, o: torch.Tensor, d: torch.Tensor, jitter: float):
    """A ray's distances, lengths, unit-cube points and which of them lie in occupied cells, without skipping."""
    step, half = float(space.step), HORIZON if space.contracted else 1.0
    safe = torch.where(d.abs() < 1e-9, torch.full_like(d, 1e-9), d)
    a, b = (-half - o) / safe, (half - o) / safe
    t, leave = torch.minimum(a, b).amax().clamp(min=float(space.near)) + jitter * step, torch.maximum(a, b).amin()
    ts, deltas = [], []
    while t < leave:
        size = (o + t * d).abs().amax().clamp(min=1.0) if space.contracted else torch.tensor(1.0)
        ts.append(t)
        deltas.append(step * size.square())
        t = t + deltas[-1]
    ts, deltas = (torch.stack(values) if values else torch.zeros(0) for values in (ts, deltas))
    p = o + ts[:, None] * d
    if space.contracted:
        m = p.abs().amax(-1, keepdim=True).clamp(min=1.0)
        p = p * (2.0 - 1.0 / m) / m * 0.5
    u = (p * 0.5 + 0.5).clamp(0.0, 0.9999999)
    cell = (u * CELLS).long()
    occupied = torch.as_tensor(space.occupied).view(CELLS, CELLS, CELLS)
    return ts, deltas, u, occupied[cell[:, 2], cell[:, 1], cell[:, 0]] > 0


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("filled", [1.0, 0.02])
def test_samples_equal_the_oracle(contracted: bool, filled: float) -> None:
    space = _space(contracted, filled)
    rng = np.random.default_rng(6)
    from_inside = missing = 0
    for k in range(30):
        o = rng.normal(size=3) * 1.5
        d = rng.uniform(-0.6, 0.6, 3) - o if k < 20 else rng.normal(size=3)
        d /= np.linalg.norm(d)
        x, ts, dts, _ = _march(space, o, d, 0.3)
        t, delta, u, inside = _march_oracle(space, *(torch.as_tensor(a, dtype=torch.float32) for a in (o, d)), 0.3)
        # Both add up distances in float32, in another order: borders of cells may fall either way.
        got, wanted = set(np.round(ts, 3)), set(np.round(t[inside].numpy(), 3))
        assert len(got ^ wanted) <= max(2, 0.1 * len(wanted))
        same = np.isin(np.round(ts, 3), list(wanted))
        rows = [int((t - ts[k]).abs().argmin()) for k in np.flatnonzero(same)]
        np.testing.assert_allclose(x[:, same].T, u[rows].numpy(), atol=2e-4)
        np.testing.assert_allclose(dts[same], delta[rows].numpy(), rtol=2e-3)
        from_inside += np.abs(o).max() < 1.0  # begins at the near plane
        missing += not len(t)
    assert from_inside and (missing or contracted)


def test_a_ray_ends_where_the_room_does_or_the_known_density_makes_it_opaque() -> None:
    way, space = (np.array([-3.0, 0.1, 0.1]), np.array([1.0, 0.0, 0.0])), _space(False, 1.0)
    assert _march(_space(False, 0.0), *way)[1].size == 0, "empty space is skipped"
    whole = _march(space, *way)[1]
    np.testing.assert_array_equal(_march(space, *way, room=slice(4, 9))[1], whole[:5])
    _, seen, _, depth = _march(space, *way, opaque=np.float32(1.0))
    np.testing.assert_array_equal(seen, whole[: int(np.ceil(1.0 / (1.5 * space.step)))])
    assert depth > 1.0 and len(seen) < len(whole)


FEW_CELLS = 8  # a task's worth of cells, so that its samples are all there afterwards


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
    seen = rng.integers(0, 5, FEW_CELLS**3).astype(np.uint16)
    before = rng.random(FEW_CELLS**3).astype(np.float32) * 3.0
    density, acts, x = before.copy(), field._scratch.acts, np.full_like(field._batch.x, np.nan)
    cells = Cells(FEW_CELLS, seen, few, cell_centers(FEW_CELLS, contracted)[1], density)
    model = field._encoding, SETTINGS.levels, field._net
    CallerPool().run(sample_density, np.uint64(11), phase, phases, np.float32(fade), *model, cells, acts, x)
    here = np.arange(phase, FEW_CELLS**3, phases)
    np.testing.assert_array_equal(np.delete(density, here), np.delete(before, here))
    np.testing.assert_array_equal(density[here[seen[here] < few]], 0.0)
    looked = here[seen[here] >= few]
    places = x[0, :, : len(looked)].T.astype(np.float64)
    cell = (places * FEW_CELLS).astype(int)
    np.testing.assert_array_equal(cell @ [1, FEW_CELLS, FEW_CELLS**2], looked)
    apart = places * FEW_CELLS - cell
    assert apart.min() < 0.1 and apart.max() > 0.9 and abs(apart.mean() - 0.5) < 0.1
    grid = to_torch(field._encoding)
    params = torch.as_tensor(field._net.params, dtype=torch.float64)
    raw = mlp(field._net.widths.tolist(), params, encode(grid, SETTINGS.levels, torch.as_tensor(places)))
    sigma = raw[:, 0].clamp(RAW_LOW, RAW_HIGH).exp().numpy() * _centers(FEW_CELLS, contracted)[1][looked]
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


def test_every_point_lies_in_the_unit_cube_and_far_ones_are_contracted() -> None:
    """Mip-NeRF 360's contraction by the largest coordinate: p where |p| <= 1, (2 - 1/|p|) p/|p| beyond."""
    for point in np.random.default_rng(0).normal(size=(60, 3)) * np.geomspace(0.1, 1e6, 60)[:, None]:
        far = np.abs(point).max()
        contracted = point if far <= 1 else (2 - 1 / far) * point / far
        at = tuple(map(np.float32, point))
        np.testing.assert_allclose(_unit_cube(True, *at), np.clip(contracted / 4 + 0.5, 0, 1), atol=1e-6)
        np.testing.assert_allclose(_unit_cube(False, *at), np.clip(point / 2 + 0.5, 0, 1), atol=1e-6)
        assert max(*_unit_cube(True, *at), *_unit_cube(False, *at)) < 1.0
