"""Voxel rays: forward and gradients against torch's autograd in float64 and against finite differences."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from edge_server.fields.common.kernels.rays import Views, interval
from edge_server.fields.common.kernels.train import RaySampling
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.supervision import pack_views
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.voxel.kernels.rays import SEGMENT, SkipGrid, Voxels, march_ray, march_ray_backward, train_rays
from edge_server.fields.voxel.kernels.update import (
    MAX_CLEARANCE,
    MAX_DENSITY,
    AdamRule,
    DiffusionRule,
    adam_constants,
    diffuse,
    distance_transform,
    update_cell_density,
    upsample_grid,
    voxel_adam,
)
from edge_server.fields.voxel.snapshot import VoxelSnapshot, make_ray_scratch
from tests.edge_server.fields.scenes import ring

SIZE, CELLS = 9, 8
OUTLINE, ALPHA = 0.25, 0.3
BACK = np.array([0.3, 0.6, 0.1], np.float32)


class Ray(NamedTuple):
    """A ray in scene units, with the distances between which it is sampled."""

    origin: NDArray[np.float32]
    direction: NDArray[np.float32]
    enter: float
    leave: float


def _voxels(seed: int = 0, densest: float = 1.5) -> Voxels:
    rng = np.random.default_rng(seed)
    table = np.zeros((-(-(SIZE**3) // SEGMENT) * SEGMENT, 4), np.float32)
    table[: SIZE**3] = rng.random((SIZE**3, 4))
    table[:, 0] *= densest
    return Voxels(SIZE, table)


def _space(contracted: bool, occupied: NDArray[np.uint8] | None = None) -> SkipGrid:
    if occupied is None:
        occupied = np.ones(CELLS**3, np.uint8)
    clearance = np.full(CELLS**3, 77, np.uint8)
    distance_transform(occupied, CELLS, clearance)
    step = np.float32((4.0 if contracted else 2.0) / (SIZE - 1))
    return SkipGrid(clearance, CELLS, contracted, step, np.float32(0.1))


def _rays(count: int, contracted: bool) -> list[Ray]:
    rng = np.random.default_rng(5)
    rays = []
    for _ in range(count):
        origin, towards = rng.normal(size=3), rng.uniform(-0.6, 0.6, 3)
        origin *= 1.8 / np.linalg.norm(origin)
        direction = towards - origin
        direction /= np.linalg.norm(direction)
        leave = 9.0 if contracted else 3.2
        rays.append(Ray(origin.astype(np.float32), direction.astype(np.float32), 0.3, leave))
    return rays


def _sampled(space: SkipGrid, ray: Ray) -> tuple[NDArray, NDArray]:
    """Unit-cube places (N, 3) and distances (N,) of a ray's samples, one after the other, none left out but
    those in empty cells. float64."""
    t, places, ts = np.float64(np.float32(ray.enter)), [], []
    scale = 0.25 if space.contracted else 0.5
    while t < ray.leave:
        p, step = ray.origin.astype(np.float64) + t * ray.direction, float(space.step)
        m = np.abs(p).max()
        if space.contracted and m > 1.0:
            step, p = step * m * m, p * (2.0 - 1.0 / m) / m
        u = np.clip(p * scale + 0.5, 0.0, 0.9999999)
        i, j, k = (u * CELLS).astype(int)
        if space.clearance[i + CELLS * (j + CELLS * k)] == 0:
            places.append(u)
            ts.append(t)
        t += step
    return np.array(places).reshape(-1, 3), np.array(ts)


def _oracle(table: torch.Tensor, places: NDArray, ts: NDArray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Color (3,) over BACK, weighted distance and opacity of one ray, by torch's own interpolation."""
    grid = table[: SIZE**3].reshape(SIZE, SIZE, SIZE, 4).permute(3, 0, 1, 2)[None]
    at = torch.as_tensor(2.0 * places - 1.0)[None, None, None]
    values = torch.nn.functional.grid_sample(grid, at, align_corners=True, padding_mode="border")
    values = values[0, :, 0, 0].T
    depth = torch.cumsum(values[:, 0], dim=0)
    before = torch.exp(-torch.cat([torch.zeros(1, dtype=torch.float64), depth[:-1]]))
    weights = before * (1.0 - torch.exp(-values[:, 0]))
    left = torch.exp(-depth[-1]) if len(depth) else torch.ones((), dtype=torch.float64)
    color = (weights[:, None] * values[:, 1:]).sum(dim=0) + left * torch.as_tensor(BACK, dtype=torch.float64)
    return color, (weights * torch.as_tensor(ts)).sum(), 1.0 - left


def _traced(space: SkipGrid, voxels: Voxels, ray: Ray):
    memory = make_ray_scratch(1)
    found = march_ray(
        space,
        voxels,
        *ray.origin,
        *ray.direction,
        np.float32(ray.enter),
        np.float32(ray.leave),
        memory.row[0],
        memory.line[0],
    )
    return memory, found


@pytest.mark.parametrize("contracted", [False, True])
def test_color_distance_and_gradient_equal_the_oracle(contracted: bool) -> None:
    voxels, space = _voxels(densest=0.4), _space(contracted)
    target, checked = np.array([0.2, 0.9, 0.4], np.float32), 0
    for ray in _rays(40, contracted):
        memory, (n, transmittance, red, green, blue, far) = _traced(space, voxels, ray)
        places, ts = _sampled(space, ray)
        if n != len(places) or transmittance < 2e-3:
            continue  # the raster's end falls on the box's side, or the ray ends early
        checked += 1
        table = torch.tensor(voxels.table, dtype=torch.float64, requires_grad=True)
        color, distance, solid = _oracle(table, places, ts)
        mine = np.array([red, green, blue]) + transmittance * BACK
        np.testing.assert_allclose(mine, color.detach().numpy(), atol=2e-6)
        assert far == pytest.approx(float(distance.detach()), rel=1e-5, abs=1e-6)
        error = torch.sum((color - torch.as_tensor(target, dtype=torch.float64)) ** 2)
        (error + OUTLINE * (solid - ALPHA) ** 2).backward()
        gradient, dirty = np.zeros_like(voxels.table), np.zeros(len(voxels.table) // SEGMENT, np.uint8)
        d = (2.0 * (mine - target)).astype(np.float32)
        d_depth_total = np.float32(2.0 * OUTLINE * (1.0 - transmittance - ALPHA) * transmittance)
        march_ray_backward(
            memory.row[0], memory.line[0], n, SIZE, *d, np.float32(d @ mine), d_depth_total, gradient, dirty
        )
        assert table.grad is not None
        np.testing.assert_allclose(gradient, table.grad.numpy(), atol=3e-6)
        touched = (gradient.reshape(-1, 4 * SEGMENT) != 0).any(axis=1)
        assert (dirty.astype(bool) >= touched).all() and dirty.sum() < dirty.size
    assert checked > 20


def test_gradients_are_those_of_finite_differences() -> None:
    """The loss of one ray as the kernel itself computes it, each touched parameter moved both ways."""
    voxels, space, ray = _voxels(3, densest=0.5), _space(False), _rays(3, False)[1]
    target = np.array([0.9, 0.1, 0.5], np.float32)

    def loss() -> float:
        _, (_, transmittance, *color, _) = _traced(space, voxels, ray)
        return float(((np.array(color, np.float64) + transmittance * BACK - target) ** 2).sum())

    memory, (n, transmittance, red, green, blue, _) = _traced(space, voxels, ray)
    mine = np.array([red, green, blue]) + transmittance * BACK
    d = (2.0 * (mine - target)).astype(np.float32)
    gradient, dirty = np.zeros_like(voxels.table), np.zeros(len(voxels.table) // SEGMENT, np.uint8)
    march_ray_backward(memory.row[0], memory.line[0], n, SIZE, *d, np.float32(d @ mine), np.float32(0), gradient, dirty)
    largest = np.argsort(-np.abs(gradient), axis=0)[:15]  # of each channel
    for k in (4 * largest + np.arange(4)).ravel():
        flat = voxels.table.reshape(-1)
        kept, h = flat[k], np.float32(2e-2)
        flat[k] = kept + h
        up = loss()
        flat[k] = kept - h
        down = loss()
        flat[k] = kept
        assert (up - down) / (2 * h) == pytest.approx(gradient.reshape(-1)[k], rel=0.02, abs=2e-5)


def test_empty_cells_are_stepped_over_on_the_same_raster() -> None:
    """Empty cells are skipped many at a time, samples beyond them stay where they would have been."""
    rng, voxels = np.random.default_rng(2), _voxels(densest=0.05)
    occupied = (rng.random(CELLS**3) < 0.2).astype(np.uint8)
    occupied.reshape(CELLS, CELLS, CELLS)[:4, :4, :] = 0
    space, seen = _space(False, occupied), 0
    for ray in _rays(60, False):
        memory, (n, *_) = _traced(space, voxels, ray)
        _, ts = _sampled(space, ray)
        mine = memory.line[0, :n, 8]
        # A place that float32 puts on the other side of a cell's face may be missing or more.
        assert abs(n - len(ts)) <= 1
        if n == len(ts):
            np.testing.assert_allclose(mine, ts, atol=2e-5)
            seen += n
    assert seen > 30


@pytest.mark.parametrize("contracted", [False, True])
def test_pictures_are_those_of_the_oracle(contracted: bool) -> None:
    """Color, depth and opacity of a distorted camera's pixels, whichever worker renders them."""
    lower = np.repeat(np.array([1, 0], np.uint8), CELLS**3 // 2)
    voxels, space, view = _voxels(6, densest=0.4), _space(contracted, lower), ring(5, size=12)[2]
    camera = replace(view.intrinsics, distortion=(-0.1, 0.02, 0.003, -0.002))
    pose, box = view.camera_to_world, scene_box([view], contracted=contracted)
    snapshot = VoxelSnapshot(box, voxels, space, BACK, (), CallerPool(), 0)
    rendered = snapshot.render(pose, camera)
    v, u = np.mgrid[0:12, 0:12] + 0.5
    directions = (camera.rays(np.stack([u, v], axis=-1)) @ pose[:3, :3].T).astype(np.float64)
    directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)
    origin, checked, missed = box.normalise(pose[:3, 3]).astype(np.float32), 0, 0
    table = torch.tensor(voxels.table, dtype=torch.float64)
    for at in np.ndindex(12, 12):
        enter, leave = interval(space, *origin, *directions[at])
        ray = Ray(origin, directions[at], float(enter + 0.5 * space.step), float(leave))
        places, ts = _sampled(space, ray)
        _, (n, transmittance, *_) = _traced(space, voxels, ray)
        if n != len(places) or transmittance < 2e-3:
            continue  # the raster's end falls on the box's side, or the ray ends early
        color, distance, solid = (x.numpy() for x in _oracle(table, places, ts))
        np.testing.assert_allclose(rendered.color[at], color, atol=1e-5)
        assert rendered.opacity[at] == pytest.approx(float(solid), abs=1e-5)
        away_m = float(distance / solid) * box.radius_m if solid > 1e-3 else 0.0
        assert rendered.depth[at] == pytest.approx(away_m, rel=1e-4)
        checked, missed = checked + (n > 0), missed + (n == 0)
    assert checked > 50 and missed > 5


def test_a_ray_ends_where_it_is_opaque() -> None:
    voxels, space, ray = _voxels(), _space(False), _rays(1, False)[0]
    voxels.table[:, 0] = 12.0
    _, (n, transmittance, *_) = _traced(space, voxels, ray)
    assert n == 1 and transmittance < 1e-5
    voxels.table[:, 0] = 1.0
    _, (n, transmittance, *_) = _traced(space, voxels, ray)
    assert n == 7 and transmittance == pytest.approx(np.exp(-7.0), rel=1e-5)


def _training(parts: int, rays: int, outline: float = 0.0, alpha: int | None = None, densest: float = 1.5):
    views = ring(5, size=16)
    if alpha is not None:
        flat = np.full((16, 16, 1), alpha, np.uint8)
        views = [replace(v, image=np.concatenate([v.image, flat], axis=2)) for v in views]
    data: Views = pack_views(views, scene_box(views, contracted=False), {})
    voxels = _voxels(densest=densest)
    gradient = np.zeros((parts, *voxels.table.shape), np.float32)
    dirty = np.zeros((parts, len(voxels.table) // SEGMENT), np.uint8)
    samples, dropped, loss = np.zeros(parts, np.int64), np.zeros(parts, np.int64), np.zeros(parts)
    recipe = RaySampling(np.uint64(77), rays, 1, 1, np.float32(0.0), BACK, False)
    pool = CallerPool()
    pool.run(
        train_rays,
        data,
        recipe,
        _space(False),
        voxels,
        rays,
        np.float32(outline),
        make_ray_scratch(1),
        gradient,
        dirty,
        samples,
        dropped,
        loss,
    )
    return gradient, dirty, samples, dropped, loss


def test_a_step_adds_up_its_rays_whatever_the_number_of_parts() -> None:
    one, _, samples_1, _, loss_1 = _training(1, 640)
    many, dirty, samples_7, dropped, loss_7 = _training(7, 640)
    assert samples_1.sum() == samples_7.sum() > 640 and dropped.sum() == 0
    assert loss_1.sum() == pytest.approx(loss_7.sum(), rel=1e-9)
    np.testing.assert_allclose(one[0], many.sum(axis=0), atol=1e-4)
    assert all(part.any() for part in many) and all(flags.any() for flags in dirty)


def test_an_outline_makes_empty_pixels_emptier_and_full_ones_fuller() -> None:
    for alpha, sign in ((0, 1.0), (255, -1.0)):
        without, *_ = _training(1, 640, 0.0, alpha, densest=0.1)
        with_it, *_ = _training(1, 640, 1.0, alpha, densest=0.1)
        change = with_it[0, :, 0] - without[0, :, 0]
        assert (sign * change).max() > 0.1 and (sign * change).min() > -1e-5
        np.testing.assert_array_equal(with_it[..., 1:], without[..., 1:])


def test_adam_equals_torch_without_its_first_moment() -> None:
    """Several steps against torch's Adam with betas (0, beta2), projected; vertices without flag stay."""
    rng, parts, count = np.random.default_rng(4), 3, 6 * SEGMENT
    table = rng.random((count, 4)).astype(np.float32)
    second, gradient = np.zeros_like(table), np.zeros((parts, count, 4), np.float32)
    dirty, dropped = np.zeros((parts, count // SEGMENT), np.uint8), np.zeros(1, np.int64)
    theirs = torch.tensor(table[: 4 * SEGMENT], dtype=torch.float64, requires_grad=True)
    adam = torch.optim.Adam([theirs], lr=0.05, betas=(0.0, 0.95), eps=5e-3)
    kept, pool = table[4 * SEGMENT :].copy(), CallerPool()
    for step in range(1, 8):
        gradient[:, : 4 * SEGMENT] = rng.normal(size=(parts, 4 * SEGMENT, 4))
        dirty[:, :4] = 1
        theirs.grad = torch.tensor(gradient.sum(axis=0)[: 4 * SEGMENT], dtype=torch.float64)
        adam.step()
        with torch.no_grad():
            theirs.clamp_(min=0.0)
            theirs.clamp_(max=torch.tensor([MAX_DENSITY, 1.0, 1.0, 1.0], dtype=torch.float64))
        constants = adam_constants((0.05, 0.05), (0, 0), (0, 0), (MAX_DENSITY, 1))
        rule = AdamRule(constants, np.float32(0.95), np.float32(5e-3), np.float32(1.0 / (1.0 - 0.95**step)))
        pool.run(voxel_adam, table, second, gradient, dirty, rule, dropped)
        np.testing.assert_allclose(table[: 4 * SEGMENT], theirs.detach().numpy(), atol=1e-5)
    np.testing.assert_array_equal(table[4 * SEGMENT :], kept)
    assert not gradient.any() and not dirty.any() and dropped[0] == 0


def test_adam_grows_pulls_projects_and_drops_what_is_not_finite() -> None:
    table = np.full((SEGMENT, 4), 0.5, np.float32)
    second, gradient = np.zeros_like(table), np.zeros((1, SEGMENT, 4), np.float32)
    gradient[0, 0] = (1e30, np.nan, np.inf, 0.0)  # limited; dropped twice; not touched
    gradient[0, 1] = (1e-20, 1.0, -1e3, 0.0)  # touched, nothing else
    dirty, dropped = np.ones((1, 1), np.uint8), np.zeros(1, np.int64)
    constants = adam_constants((0.01, 2.0), (20.0, 0.0), (0.1, 0.0), (MAX_DENSITY, 1.0))
    rule = AdamRule(constants, np.float32(0.0), np.float32(1e-6), np.float32(1.0))
    CallerPool().run(voxel_adam, table, second, gradient, dirty, rule, dropped)
    np.testing.assert_allclose(table[0], [0.5 - 0.11 * 1.1, 0.5, 0.5, 0.5], rtol=1e-5)
    np.testing.assert_allclose(table[1], [0.5 - 0.011, 0.0, 1.0, 0.5], rtol=1e-5)
    np.testing.assert_array_equal(table[2:], 0.5)
    assert dropped[0] == 2 and np.isfinite(second).all()


def _grid(size: int, seed: int) -> Voxels:
    table = np.zeros((-(-(size**3) // SEGMENT) * SEGMENT, 4), np.float32)
    table[: size**3] = np.random.default_rng(seed).random((size**3, 4))
    return Voxels(size, table)


def _diffused(
    voxels: Voxels, clearance: NDArray[np.uint8], cells: int, rule: DiffusionRule, phases: int = 4
) -> NDArray[np.float32]:
    """The grid (size, size, size, 4) after all phases: z, y, x."""
    size = voxels.size
    own = Voxels(size, voxels.table.copy())
    for phase in range(phases):
        CallerPool().run(diffuse, phase, phases, own, clearance, cells, rule)
    np.testing.assert_array_equal(own.table[size**3 :], voxels.table[size**3 :])
    return own.table[: size**3].reshape(size, size, size, 4)


def _diffused_by_numpy(
    voxels: Voxels, clearance: NDArray[np.uint8], cells: int, rule: DiffusionRule, phases: int
) -> NDArray[np.float64]:
    size = voxels.size
    grid = voxels.table[: size**3].reshape(size, size, size, 4).astype(np.float64)
    empty = clearance.reshape(cells, cells, cells) != 0
    for z in (z for phase in range(phases) for z in range(1 + phase, size - 1, phases)):
        for y in range(1, size - 1):
            new = grid[z, y].copy()
            for x in range(1, size - 1):
                near = grid[z, y, x - 1], grid[z, y, x + 1], grid[z, y - 1, x], grid[z, y + 1, x]
                around = np.stack([*near, grid[z - 1, y, x], grid[z + 1, y, x]])
                way = np.clip(around - grid[z, y, x], -rule.edge, rule.edge).sum(axis=0)
                if not empty[tuple(int(c / (size - 1) * cells + 1e-9) for c in (z, y, x))]:
                    new[x] = np.clip(grid[z, y, x] + rule.share * way, 0.0, [MAX_DENSITY, 1.0, 1.0, 1.0])
            grid[z, y] = new
    return grid


@pytest.mark.parametrize(
    ("size", "cells", "empty", "phases"),
    [(9, 8, 0.0, 4), (9, 8, 0.3, 2), (10, 8, 0.3, 4), (9, 4, 0.5, 4), (9, 12, 0.5, 4), (4, 16, 0.3, 3), (9, 8, 1.0, 4)],
)
def test_diffusion_is_that_of_numpy_and_leaves_empty_cells_alone(
    size: int, cells: int, empty: float, phases: int
) -> None:
    voxels = _grid(size, 2)
    clearance = (np.random.default_rng(9).random(cells**3) < empty).astype(np.uint8)
    rule = DiffusionRule(np.float32([0.3, 0.05, 0.1, 1e9]), np.float32(1 / 6))
    got = _diffused(voxels, clearance, cells, rule, phases)
    np.testing.assert_allclose(got, _diffused_by_numpy(voxels, clearance, cells, rule, phases), atol=2e-6)
    assert (got != voxels.table[: size**3].reshape(got.shape)).any() == (empty < 1.0)


def test_diffusion_keeps_what_is_even_and_what_is_steep() -> None:
    """A ramp has no curvature. A step many times ``edge`` high moves by ``edge`` at most."""
    ramp, clearance = _voxels(), np.zeros(CELLS**3, np.uint8)
    x = np.arange(SIZE**3) % SIZE
    ramp.table[: SIZE**3] = 0.1 * x[:, None]
    rule = DiffusionRule(np.full(4, 0.2, np.float32), np.float32(1 / 6))
    kept = ramp.table[: SIZE**3].reshape(SIZE, SIZE, SIZE, 4)
    np.testing.assert_allclose(_diffused(ramp, clearance, CELLS, rule), kept, atol=1e-6)
    step = Voxels(SIZE, ramp.table.copy())
    step.table[: SIZE**3] = np.where(x[:, None] < 4, 0.0, 1.0)
    rule = DiffusionRule(np.full(4, 0.02, np.float32), np.float32(1 / 6))
    moved = np.abs(_diffused(step, clearance, CELLS, rule) - step.table[: SIZE**3].reshape(kept.shape))
    assert 0.0 < moved.max() <= 0.02


def test_what_is_not_finite_does_not_spread_by_diffusion() -> None:
    voxels, clearance = _voxels(), np.zeros(CELLS**3, np.uint8)
    middle = 4 + SIZE * (4 + SIZE * 4)
    voxels.table[middle] = (np.nan, np.inf, -np.inf, np.nan)
    rule = DiffusionRule(np.float32([0.1, 0.025, 0.025, 0.025]), np.float32(1 / 6))
    got = _diffused(voxels, clearance, CELLS, rule).reshape(-1, 4)
    assert np.isfinite(np.delete(got, middle, axis=0)).all()
    assert got[middle, 1] == 1.0 and got[middle, 2] == 0.0


def test_a_finer_grid_has_the_same_values_between_its_vertices() -> None:
    coarse, size = _voxels(), 2 * SIZE - 1
    fine = np.zeros((size**3, 4), np.float32)
    CallerPool().run(upsample_grid, coarse.table, SIZE, fine, size)
    old, new = coarse.table[: SIZE**3].reshape(SIZE, SIZE, SIZE, 4), fine.reshape(size, size, size, 4)
    np.testing.assert_allclose(new[::2, ::2, ::2], old, atol=1e-6)
    np.testing.assert_allclose(new[1::2, ::2, ::2], (old[1:] + old[:-1]) / 2, atol=1e-6)
    np.testing.assert_allclose(new[::2, ::2, 1::2], (old[:, :, 1:] + old[:, :, :-1]) / 2, atol=1e-6)


def test_the_densest_vertex_that_reaches_into_a_cell_is_found() -> None:
    voxels, phases = _voxels(), 3
    voxels.table[7, 0] = np.nan
    grid = voxels.table[: SIZE**3, 0].reshape(SIZE, SIZE, SIZE)
    density = np.full(CELLS**3, 2.0, np.float32)
    seen = np.full(CELLS**3, 2, np.uint16)
    seen[100] = 1
    for phase in range(phases):
        CallerPool().run(
            update_cell_density, phase, phases, np.float32(0.5), voxels, np.float32(3.0), CELLS, seen, 2, density
        )
    cells = density.reshape(CELLS, CELLS, CELLS)
    assert density[100] == 0.0 and cells[0, 0, 7] == 3000.0  # not a number: looked at again, not left out
    for k, j, i in ((1, 1, 1), (4, 0, 6), (7, 7, 7), (3, 5, 2)):
        corner = grid[k : k + 2, j : j + 2, i : i + 2].max() * 3.0
        assert cells[k, j, i] >= max(1.0, corner) - 1e-6
        assert cells[k, j, i] <= max(1.0, grid[k : k + 3, j : j + 3, i : i + 3].max() * 3.0) + 1e-6


@pytest.mark.parametrize("share", [0.0, 0.002, 0.1, 1.0])
def test_distances_to_occupied_cells_are_those_of_brute_force(share: float) -> None:
    n = 12
    occupied = (np.random.default_rng(8).random(n**3) < share).astype(np.uint8)
    clearance = np.zeros(n**3, np.uint8)
    distance_transform(occupied, n, clearance)
    at = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    full = at[occupied > 0]
    expected = np.full(n**3, MAX_CLEARANCE)
    if len(full):
        expected = np.abs(at[:, None] - full[None]).max(axis=-1).min(axis=1)
    np.testing.assert_array_equal(clearance, expected)
