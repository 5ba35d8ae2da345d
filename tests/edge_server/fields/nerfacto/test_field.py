"""What is the proposal-sampled field's own: sampling, appearances, and every ray's compositing against plain torch."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from msgspec import structs
from numpy.typing import NDArray

from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields import Budget
from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT
from edge_server.fields.common.kernels.rays import COARSE, Space
from edge_server.fields.common.kernels.render import BATCH, TILE, render_tiles
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW
from edge_server.fields.common.ray_snapshot import RaySnapshot
from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.nerfacto.field import NerfactoField
from edge_server.fields.nerfacto.kernels import proposal
from edge_server.fields.nerfacto.kernels.train import NERFACTO_WEIGHT_FLOOR, interlevel_loss, scatter_proposal
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small import SMALL, TINY, score
from tests.edge_server.fields.torch_model import encode, mlp, ray_weights, shade, to_torch

VIEWS = ring(6, size=24)


def test_samples_are_uniform_at_first_and_then_follow_the_proposal() -> None:
    field = NerfactoField(structs.replace(SMALL["nerfacto"], even=0.4, anneal=40))
    for step, share in ((0, 1.0), (10, 0.85), (40, 0.4), (400, 0.4)):
        field.step = step
        assert field._sampling().uniform_share == pytest.approx(share)


def test_appearances_take_up_what_differs_between_cameras() -> None:
    """A room's pictures with gains of 0.7 to 1.4; scored against the picture at the mean exposure."""
    still = synthetic_still("room", cameras=13, size=48)
    gains = np.exp(np.random.default_rng(2).permutation(np.linspace(-0.35, 0.35, 12)))
    lit = [(v, np.clip(v.image * gain + 0.5, 0, 255)) for v, gain in zip(still.training, gains)]
    views = [replace(v, image=image.astype(np.uint8)) for v, image in lit]
    scores, looks = [], None
    for appearance in (0, 4):
        field = NerfactoField(structs.replace(SMALL["nerfacto"], appearance=appearance))
        field.fit(views, Budget(steps=200))
        scores.append(score(field, still.held_out[0]))
        looks = field._cameras.appearances
    assert scores[1] > scores[0] + 1.0
    assert looks is not None and set(looks.known) == {v.camera for v in views}
    values = np.array([known[0] for known in looks.known.values()])
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=1e-9)


@pytest.fixture(scope="module")
def snapshot() -> Any:
    settings = structs.replace(TINY["nerfacto"], samples=16, anneal=20, sh_degree=1, threads=1)
    field = NerfactoField(settings, CallerPool())
    field.fit(VIEWS, Budget(steps=60))
    return field.snapshot()


def _render(
    snapshot: RaySnapshot, pixels: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Places (N, 3), distances and lengths (2, N) of the samples that stay in the scratch; RGBDA (P, 5)."""
    view, n = VIEWS[2], len(pixels)
    x, line = (np.full((1, 3, BATCH), np.nan, np.float32) for _ in range(2))
    out = np.full((n, 3), np.nan, np.float32), np.full(n, np.nan, np.float32), np.full(n, np.nan, np.float32)
    lens, rotation = np.array(lens_row(view.intrinsics)), view.camera_to_world[:3, :3].copy()
    camera = lens, rotation, snapshot.box.normalise(view.camera_to_world[:3, 3])
    model = snapshot.encoding, snapshot.levels, snapshot.net
    scratch = np.empty((1, int(snapshot.net.widths.sum()), BATCH), np.float32), x, line
    degree = snapshot.settings.sh_degree
    CallerPool().run(render_tiles, camera, pixels, snapshot.space, model, degree, snapshot.background, scratch, out)
    here = np.isfinite(x[0, 0])
    return x[0][:, here].T, line[0, 0, here], line[0, 1, here], np.column_stack(out)


def test_a_ray_is_what_torch_makes_of_its_samples(snapshot: RaySnapshot) -> None:
    view, solid = VIEWS[2], []
    grid = to_torch(snapshot.encoding)
    params = torch.as_tensor(snapshot.net.params, dtype=torch.float64)
    for pixel in np.random.default_rng(0).uniform(0.0, 24.0, (40, 2)):
        places, t, delta, rendered = _render(snapshot, pixel[None])
        assert len(places) <= 2 * snapshot.settings.samples + 1 and (np.diff(t) > 0).all()
        way = (view.intrinsics.rays(pixel[None]) @ view.camera_to_world[:3, :3].T).repeat(len(places), axis=0)
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        at, d = torch.as_tensor(places, dtype=torch.float64), torch.as_tensor(way, dtype=torch.float64)
        raw = mlp(snapshot.net.widths.tolist(), params, encode(grid, snapshot.levels, at))
        sigma, color = shade(raw, snapshot.settings.sh_degree, d)
        weight, left = ray_weights(sigma[None], torch.as_tensor(delta, dtype=torch.float64)[None])
        back = torch.as_tensor(snapshot.background, dtype=torch.float64)
        expected = (weight[0, :, None] * color).sum(dim=0) + left[0] * back
        np.testing.assert_allclose(rendered[0, :3], expected.clamp(0.0, 1.0).numpy(), atol=2e-5)
        opacity = float(weight.sum())
        assert rendered[0, 4] == pytest.approx(opacity, abs=1e-5)
        away = float((weight[0] * torch.as_tensor(t)).sum()) / opacity if opacity > 1e-3 else 0.0
        assert rendered[0, 3] == pytest.approx(away, rel=1e-3, abs=1e-5)
        solid.append(opacity)
    assert np.ptp(solid) > 0.5, "the pixels must show full and empty space"
    # Rays do not depend on those beside them: more than one task holds, and more samples than there is room for.
    pixels = np.random.default_rng(1).uniform(0.0, 24.0, (TILE + 30, 2))
    assert TILE * snapshot.settings.samples >= 2 * BATCH
    alone = np.concatenate([_render(snapshot, p[None])[-1] for p in pixels])
    np.testing.assert_allclose(_render(snapshot, pixels)[-1], alone, atol=1e-6)


# --- the proposal ---------------------------------------------------------------------------------

F = np.float32
CELLS, BINS, ZERO = 8, 48, np.int64(0)
START_AT, TOWARDS = (F(-1.5), F(0.2), F(0.1)), tuple(np.array([0.96, -0.2, 0.19592], F))


def _space(contracted: bool, occupied: np.ndarray | None = None) -> Space:
    cells = np.ones(16**3, np.uint8) if occupied is None else occupied
    coarse = np.ones((16 // COARSE) ** 3, np.uint8)
    return Space(cells, coarse, np.zeros(0, F), 16, contracted, F(0.1), F(0.1))


def _encoding(values: np.ndarray) -> proposal.ProposalGrid:
    """Four vertices of a hash level, then the proposal's cells."""
    table = np.concatenate([np.full((SEGMENT, FEATURES), 50.0, F), values.astype(F).reshape(-1, FEATURES)])
    first = np.array([0, SEGMENT], np.int64)
    sampling = proposal.ProposalSampling(BINS, 16, F(0.1), F(1.5), F(0.04))
    return proposal.ProposalGrid(np.array([2], np.int32), first, np.array([True]), table, CELLS, sampling)


def _bins_of(space: Space, encoding: proposal.ProposalGrid, shift: float = 0.4, leave: float = 6.0, bins: int = BINS):
    cell, depth = np.full(bins + 5, -1, np.int32), np.full(bins + 5, np.nan, F)
    edges, at = np.empty((2, bins + 1), F), np.empty((2, bins), np.int32)
    ray = START_AT, TOWARDS, F(0.1), F(leave), F(shift)
    count, finite = proposal.make_bins(space, encoding, bins, *ray, 5, cell, depth, edges, at)
    return cell[5 : 5 + count], depth[5 : 5 + count], edges[:, :count].copy(), finite


def _unit(points: np.ndarray, contracted: bool) -> np.ndarray:
    m = np.abs(points).max(axis=-1, keepdims=True)
    inner = np.where(m > 1, (2 - 1 / np.maximum(m, 1)) / np.maximum(m, 1), 1.0) if contracted else 1.0
    return points * inner * (0.25 if contracted else 0.5) + 0.5


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("shift", [0.0, 0.99])
def test_bins_cover_the_ray_and_know_their_cells(contracted: bool, shift: float) -> None:
    values = np.random.default_rng(0).normal(-0.3, 0.3, CELLS**3)
    cell, depth, edges, finite = _bins_of(_space(contracted), _encoding(values), shift)
    assert finite and len(cell) >= BINS - 1
    assert edges[0, 0] == pytest.approx(0.1) and edges[1, -1] == pytest.approx(6.0, rel=1e-5)
    np.testing.assert_array_equal(edges[0, 1:], edges[1, :-1])
    middle = edges.mean(axis=0)[:, None] * np.array(TOWARDS) + np.array(START_AT)
    index = np.clip((_unit(middle, contracted) * CELLS).astype(int), 0, CELLS - 1)
    expected = index[:, 0] + CELLS * (index[:, 1] + CELLS * index[:, 2])
    assert (cell == expected).mean() > 0.95  # float32 may round a middle into the neighbor
    sigma = np.exp(
        np.clip(proposal.NERFACTO_RAW_GAIN * values.astype(F)[cell] + proposal.NERFACTO_RAW_START, RAW_LOW, RAW_HIGH)
    )
    np.testing.assert_allclose(depth, sigma * (edges[1] - edges[0]), rtol=1e-5)


def test_bins_end_where_it_is_dark_and_skip_what_is_empty() -> None:
    _, depth, _, _ = _bins_of(_space(False), _encoding(np.full(CELLS**3, 1.5)), leave=2.4)
    assert depth.sum() > proposal.NERFACTO_CUTOFF_DEPTH > depth[:-1].sum()
    occupied = np.ones((16, 16, 16), np.uint8)
    occupied[:, :, 6:10] = 0  # x in the middle
    _, _, edges, _ = _bins_of(_space(False, occupied.ravel()), _encoding(np.zeros(CELLS**3)), leave=2.4)
    x = edges.mean(axis=0) * TOWARDS[0] + START_AT[0]
    assert not ((x > -0.24) & (x < 0.24)).any() and (x < -0.26).any() and (x > 0.26).any()
    _, _, edges, _ = _bins_of(_space(False, np.zeros(4096, np.uint8)), _encoding(np.zeros(CELLS**3)))
    assert edges.shape[1] == 0


def _allocated(weight: np.ndarray, samples: int, even: float, shift: float):
    group, share = np.full(len(weight), -1, np.int32), np.full(len(weight), -1, np.int64)
    groups = proposal.allocate_samples(weight.astype(F), ZERO, len(weight), samples, F(even), F(shift), group, share)
    return group, share[:groups]


@pytest.mark.parametrize("seed", range(2))
def test_samples_are_dealt_by_weight_and_leave_no_bin_out(seed: int) -> None:
    weight = np.random.default_rng(seed).random(40) ** 6
    weight /= weight.sum() * 1.1
    samples, even = 24, 0.2
    left, right = np.r_[weight[0], weight[:-1]], np.r_[weight[1:], weight[-1]]
    wide = 0.5 * (np.maximum(left, weight) + np.maximum(weight, right))
    light = 1.0 - np.r_[0.0, np.cumsum(weight)[:-1]] + proposal.NERFACTO_DARK_SHARE
    earned = samples * ((1 - even) * wide / wide.sum() + even * light / light.sum())
    counts = np.zeros(40)
    for shift in np.linspace(0, 1, 64, endpoint=False):
        group, share = _allocated(weight, samples, even, shift)
        assert group[0] == 0 and group[-1] == len(share) - 1 and set(np.diff(group)) <= {0, 1}
        assert (share >= 1).all() and share.sum() <= 2 * samples + 1
        for g, n in enumerate(share):
            members = np.flatnonzero(group == g)
            if n > 1 or len(members) == 1:
                assert len(members) == 1
                counts[members] += n / 64
            else:
                assert earned[members].sum() <= 1.01 and (earned[members] < 1.0).all()
    heavy = earned >= 1
    np.testing.assert_allclose(counts[heavy], earned[heavy], atol=0.03)


@pytest.mark.parametrize("shift", [0.0, 0.999])
def test_samples_lie_in_their_groups_and_stand_for_all_of_them(shift: float) -> None:
    values = np.random.default_rng(2).normal(0.0, 0.5, CELLS**3)
    occupied = (np.random.default_rng(3).random(4096) < 0.7).astype(np.uint8)
    _, depth, edges, _ = _bins_of(_space(True, occupied), _encoding(values - 0.5))
    count = len(depth)
    weight = np.empty(count, F)
    proposal.bin_weights(depth, ZERO, count, weight)
    total = np.r_[0.0, np.cumsum(depth, dtype=float)]
    np.testing.assert_allclose(weight, np.exp(-total[:-1]) - np.exp(-total[1:]), atol=1e-6)
    group, share = _allocated(weight, 16, 0.2, shift)
    x, line = np.empty((3, 99), F), np.empty((3, 99), F)
    dealt = True, START_AT, TOWARDS, edges, group, ZERO, count, share, F(shift)
    n = proposal.place_samples(*dealt, np.int64(2), x, line)
    t, length, of = line[:, 2:n]
    assert n - 2 == share.sum() and (np.diff(t) > 0).all()
    assert length.sum() == pytest.approx((edges[1] - edges[0]).sum(), rel=1e-5)
    np.testing.assert_array_equal(np.bincount(of.astype(int)), share)
    for k in range(len(t)):
        members = group == of[k]
        assert ((edges[0, members] <= t[k]) & (t[k] <= edges[1, members])).any()
    points = t[:, None] * np.array(TOWARDS) + np.array(START_AT)
    np.testing.assert_allclose(x[:, 2:n].T, _unit(points, True), atol=1e-5)
    assert proposal.place_samples(*dealt, ZERO, x[:, :3].copy(), line) == 3


def _interlevel_case(seed: int):
    rng = np.random.default_rng(seed)
    values, count = rng.normal(0.0, 0.6, CELLS**3), 12
    values[7] = 30.0  # clamped: no gradient
    encoding = _encoding(values)
    cell = rng.choice(CELLS**3, count, replace=False).astype(np.int32)
    length = rng.random(count) * 0.4
    if seed % 2:
        cell[4], length[4] = 7, 1e-4
    raw = np.clip(proposal.NERFACTO_RAW_GAIN * values.astype(F)[cell] + proposal.NERFACTO_RAW_START, RAW_LOW, RAW_HIGH)
    depth = np.r_[0, 0, np.exp(raw) * length].astype(F)
    group = np.r_[9, 9, 0, 0, 1, 2, 2, 2, 3, 4, 5, 5, 6, 6].astype(np.int32)
    of = np.repeat(np.arange(7), [1, 4, 1, 3, 2, 1, 1]).astype(F)
    w = rng.dirichlet(np.full(len(of), 0.3)).astype(F)
    return encoding, cell, length, depth, group, of, w


def _interlevel_oracle(values: torch.Tensor, cell, length, group, of, w) -> tuple[torch.Tensor, torch.Tensor]:
    """Eq. 13 over groups of bins, in double precision; and all that the gradient is of."""
    raw = proposal.NERFACTO_RAW_GAIN * values[torch.as_tensor(cell, dtype=torch.long)] + proposal.NERFACTO_RAW_START
    depth = torch.as_tensor(length) * raw.clamp(RAW_LOW, RAW_HIGH).exp()
    pull = 0.02 * (raw - proposal.NERFACTO_RAW_START).clamp(min=0).square().sum()
    after = torch.exp(-depth.cumsum(0))
    weight = torch.cat([torch.ones(1, dtype=after.dtype), after[:-1]]) - after
    inside = torch.zeros(7, dtype=torch.float64).index_add(0, torch.as_tensor(of, dtype=torch.long), w)
    bound = torch.zeros(7, dtype=torch.float64).index_add(0, torch.as_tensor(group, dtype=torch.long), weight)
    loss = ((inside - bound).clamp(min=0).square() / (inside + NERFACTO_WEIGHT_FLOOR)).sum()
    return loss, 1.5 * loss + pull


@pytest.mark.parametrize("seed", range(2))
def test_interlevel_loss_and_gradient_equal_the_oracle(seed: int) -> None:
    encoding, cell, length, depth, group, of, w = _interlevel_case(seed)
    weight, grad = np.empty(14, F), np.full(14, 7.0, F)
    proposal.bin_weights(depth, 2, 12, weight)
    bins = np.r_[0, 0, cell].astype(np.int32), depth, weight, group, 2, 12
    loss = interlevel_loss(encoding, *bins, w, of, 0, len(of), np.empty((2, BINS), F), grad)
    values = torch.as_tensor(encoding.table[SEGMENT:].reshape(-1), dtype=torch.float64).requires_grad_(True)
    rest = cell, length, group[2:], of, torch.as_tensor(w, dtype=torch.float64)
    expected, total = _interlevel_oracle(values, *rest)
    total.backward()
    assert loss == pytest.approx(expected.item(), rel=1e-4) and loss > 1e-3
    assert values.grad is not None
    np.testing.assert_allclose(grad[2:], values.grad.numpy()[cell], rtol=2e-3, atol=3e-5)
    assert (grad[:2] == 7.0).all() and np.abs(grad[2:]).max() > 1e-3


def test_the_proposals_gradient_is_added_up_once() -> None:
    encoding, rng = _encoding(np.zeros(CELLS**3)), np.random.default_rng(4)
    cell = rng.integers(0, CELLS**3 // 3, (2, 50)).astype(np.int32)
    grad, counts = rng.normal(size=(2, 50)).astype(F), np.array([50, 20])
    gradient = np.zeros_like(encoding.table)
    dirty = np.zeros(len(encoding.table) // SEGMENT, np.bool_)
    scatter_proposal(np.zeros(1, np.int64), 0, encoding, cell, grad, counts, gradient, dirty)
    expected = np.zeros(CELLS**3)
    for c, n in enumerate(counts):
        np.add.at(expected, cell[c, :n], grad[c, :n])
    np.testing.assert_allclose(gradient[SEGMENT:].reshape(-1), expected, atol=1e-5)
    np.testing.assert_array_equal(dirty, (gradient.reshape(len(dirty), -1) != 0).any(axis=1))
    assert not dirty[0] and dirty.any()
