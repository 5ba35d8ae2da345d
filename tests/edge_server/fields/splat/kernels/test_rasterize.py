"""The Gaussian kernels: projection, compositing and their gradients against torch and finite differences."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat import buffers
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, OptimizerState
from edge_server.fields.splat.kernels.project import BASE, DEPTH, OPACITY, QUATERNION, SCALE, TILE
from edge_server.fields.splat.kernels.rasterize import Targets, render_tiles
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat import torch_oracle
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, as_gaussians, binned, random_params

LENS = Pinhole(21, 18, 22.0, 24.0, 10.0, 9.5)
BENT = replace(LENS, distortion=(-0.12, 0.03, 0.01, -0.015))
BACK = np.array([0.2, 0.5, 0.9], np.float32)
POSE = look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))


def _camera(lens: Pinhole = LENS, eye: tuple[float, float, float] = (1.0, -2.5, 0.8)) -> np.ndarray:
    return camera_rows([look_at(eye, (0.05, 0.0, 0.1))], [lens], BOX)


def _render(params: np.ndarray, cam: np.ndarray) -> list[np.ndarray]:
    raster = binned(cam, params, differentiate=False, pool=Pool(1, 0))
    w, h = LENS.width, LENS.height
    out = [np.full((h, w, 3), 7, np.float32), np.full((h, w), 7, np.float32), np.full((h, w), 7, np.float32)]
    raster.pool.run(render_tiles, raster.first, BACK, *out)
    return out


def _oracle(params: torch.Tensor, cam: np.ndarray, sh_degree: int = 0) -> tuple[torch.Tensor, ...]:
    flat = torch_oracle.flatten(torch.as_tensor(cam[0], dtype=torch.float64), params, sh_degree)
    back = torch.as_tensor(BACK, dtype=torch.float64)
    return torch_oracle.composite(flat, LENS.width, LENS.height, back)


@pytest.mark.parametrize("lens", [LENS, BENT])
@pytest.mark.parametrize("sh_degree", [0, 1])
def test_pictures_equal_the_oracle(lens: Pinhole, sh_degree: int) -> None:
    params, cam = random_params(sh_degree=sh_degree), _camera(lens)
    expected = _oracle(torch.as_tensor(params, dtype=torch.float64), cam, sh_degree)
    for mine, theirs in zip(_render(params, cam), expected):
        reference = theirs.detach().numpy().clip(0.0, 1.0 if mine.ndim == 3 else None)
        np.testing.assert_allclose(mine, reference, atol=2e-4)


def test_a_ball_appears_where_the_lens_puts_it() -> None:
    """Against the project's own lens model, without the oracle."""
    params = random_params(1)
    params[0, :3], params[0, SCALE:QUATERNION], params[0, OPACITY] = (0.5, 0.2, -0.3), np.log(0.02), 9.0
    pose = POSE
    _, depth, opacity = _render(params, camera_rows([pose], [BENT], BOX))
    local = (params[0, :3] - pose[:3, 3]) @ pose[:3, :3]
    ys, xs = np.mgrid[0 : LENS.height, 0 : LENS.width] + 0.5
    found = np.array([(xs * opacity).sum(), (ys * opacity).sum()]) / opacity.sum()
    np.testing.assert_allclose(found, BENT.project(local), atol=0.1)
    assert depth[opacity > 0.3] == pytest.approx(local[2], abs=1e-3)


def _targets(image: np.ndarray, weight: np.ndarray | None = None, behind: np.ndarray | None = None) -> Targets:
    h, w = image.shape[:2]
    return Targets(
        np.array([0, h * w]),
        np.array([[w, h]]),
        image.reshape(h * w, -1),
        np.zeros(0, np.float32) if weight is None else weight.reshape(-1),
        np.zeros((0, 3), np.float32) if behind is None else behind.reshape(-1, 3),
        BACK,
    )


def _gradient(
    params: np.ndarray,
    cam: np.ndarray,
    image: np.ndarray,
    weight: np.ndarray | None = None,
    behind: np.ndarray | None = None,
    pool: Pool | None = None,
) -> tuple[float, np.ndarray]:
    """Loss and its gradient: ten times Adam's first moment after one step from 0."""
    raster, n = binned(cam, params, pool=pool), len(params)
    losses = raster.train(_targets(image, weight, behind), 0)
    assert losses[:, 1].sum() == 0
    flat = [np.zeros(n, np.float32) for _ in range(3)]
    moments = OptimizerState(np.zeros_like(params), np.zeros_like(params), np.zeros(n, np.int32), *flat)
    rule = AdamParameters(np.zeros(params.shape[1], np.float32), np.ones((4, 3), np.float32), np.float32(1e-8))
    assert raster.step(cam, as_gaussians(params.copy()), moments, rule) == 0
    return float(losses[:, 0].sum()), 10.0 * moments.m


def _target(channels: int = 3) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (LENS.height, LENS.width, channels), dtype=np.uint8)


def _weights() -> np.ndarray:
    """Some of none, a whole tile of none, the others unequal."""
    rng = np.random.default_rng(6)
    weight = rng.random((LENS.height, LENS.width)).astype(np.float32)
    weight[rng.random(weight.shape) < 0.3] = 0.0
    weight[:TILE, TILE : 2 * TILE] = 0.0
    return weight


@pytest.mark.parametrize(
    ("lens", "sh_degree", "weighed", "over_plate"),
    [(LENS, 0, False, False), (BENT, 1, False, False), (BENT, 0, True, False), (BENT, 0, True, True)],
)
def test_gradients_equal_the_oracle(lens: Pinhole, sh_degree: int, weighed: bool, over_plate: bool) -> None:
    """Of transparent images, or over a color of its own in every pixel; any number of threads does the same."""
    params, cam, target = random_params(sh_degree=sh_degree, seed=3), _camera(lens), _target(3 if over_plate else 4)
    weight = _weights() if weighed else None
    plate = np.random.default_rng(9).uniform(0, 255, target.shape).astype(np.float32) if over_plate else None
    value, gradient = _gradient(params, cam, target, weight, plate)
    theirs = torch.as_tensor(params, dtype=torch.float64).requires_grad_(True)
    flat = torch_oracle.flatten(torch.as_tensor(cam[0], dtype=torch.float64), theirs, sh_degree)
    back = torch.as_tensor(BACK if plate is None else plate / 255.0, dtype=torch.float64)
    color, _, _ = torch_oracle.composite(flat, lens.width, lens.height, back)
    alpha = torch.as_tensor(target[..., 3:] / 255.0) if plate is None else 1.0
    share = np.ones(target.shape[:2]) if weight is None else weight.astype(np.float64)
    if over_plate:  # tiles without a Gaussian have nothing to learn, and no loss
        y, x = np.mgrid[0 : lens.height, 0 : lens.width] // TILE
        share = share * (np.diff(binned(cam, params).lists.first[0]) > 0)[y * -(-lens.width // TILE) + x]
    error = color - torch.as_tensor(target[..., :3] / 255.0) * alpha - (1 - alpha) * back
    loss = (torch.as_tensor(share)[..., None] * error.square()).sum()
    loss.backward()
    assert theirs.grad is not None and value == pytest.approx(loss.item(), rel=1e-4)
    expected = theirs.grad.numpy()
    scale = np.abs(expected).max(axis=0, keepdims=True)
    np.testing.assert_allclose(gradient / scale, expected / scale, atol=3e-3)
    np.testing.assert_array_equal(_gradient(params, cam, target, weight, plate, Pool(3, 0))[1], gradient)


def test_opacity_nought_and_one() -> None:
    cam = _camera()
    params = random_params(3)
    params[:, OPACITY] = -50.0
    color, depth, opacity = _render(params, cam)
    assert (color == BACK).all()
    assert (depth == 0).all() and (opacity == 0).all()
    _, gradient = _gradient(params, cam, _target())
    assert (gradient == 0).all()
    params[:, OPACITY] = 50.0
    _, _, opacity = _render(params, cam)
    assert 0.99 <= opacity.max() <= 1.0
    _, gradient = _gradient(params, cam, _target())
    assert np.isfinite(gradient).all() and (gradient[:, OPACITY] == 0).all()


def test_a_quaternion_without_direction_is_no_rotation() -> None:
    cam, params = _camera(), random_params(2)
    params[:, QUATERNION:OPACITY] = 0.0
    plain = params.copy()
    plain[:, QUATERNION] = 1.0
    np.testing.assert_array_equal(_render(params, cam)[0], _render(plain, cam)[0])
    _, gradient = _gradient(params, cam, _target())
    assert np.isfinite(gradient).all() and (gradient[:, QUATERNION:OPACITY] == 0).all()


@pytest.mark.parametrize("log_scales", [(-30.0, -30.0, -30.0), (3.0, -12.0, -12.0), (-12.0, 4.0, 4.0)])
def test_covariances_near_singular_stay_finite(log_scales: tuple[float, float, float]) -> None:
    cam, params = _camera(), random_params(4)
    params[:, SCALE:QUATERNION] = log_scales
    for part in _render(params, cam):
        assert np.isfinite(part).all()
    _, gradient = _gradient(params, cam, _target())
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, 1e-40])
def test_no_parameter_poisons_a_rendering(value: float) -> None:
    cam = _camera()
    for column in range(BASE):
        params = random_params(6)
        params[2, column] = value
        for part in _render(params, cam):
            assert np.isfinite(part).all(), f"column {column}"


def test_behind_the_camera_and_none_at_all() -> None:
    params = random_params(5)
    params[:, :3] = (5.0, -12.0, 3.0)  # behind it
    for cloud in (params, params[:0]):
        color, _, opacity = _render(cloud, _camera())
        assert (color == BACK).all()
        assert (opacity == 0).all()


def test_a_huge_one_far_to_the_side_does_not_fold_back() -> None:
    """The lens's polynomial turns around beyond the field of view; what stands there must not appear."""
    params = random_params(1)
    eye = np.array([1.0, -2.5, 0.8])
    pose = look_at(eye, (0.05, 0.0, 0.1))
    params[0, :3] = pose[:3, 3] + pose[:3, :3] @ np.array([6.0, 0.0, 0.4])
    params[0, SCALE:QUATERNION], params[0, OPACITY] = np.log(0.05), 8.0
    bent = replace(LENS, distortion=(-0.25, 0.0, 0.0, 0.0))
    _, _, opacity = _render(params, camera_rows([pose], [bent], BOX))
    assert (opacity == 0).all()


@pytest.mark.parametrize("longest", [0.08, 3.0])
def test_a_tile_lists_the_gaussians_that_have_a_pixel_in_it_and_hardly_another(longest: float) -> None:
    """Needles in every direction, also such that the first 64 tiles of their box are not all of them."""
    lens = Pinhole(150, 110, 160.0, 160.0, 74.0, 57.0)
    params = random_params(300, seed=6)
    params[:, SCALE:QUATERNION] = np.log([0.01, 0.02, longest])
    raster = binned(_camera(lens), params)
    lists, columns = raster.lists, int(raster.columns[0])
    total = columns * int(raster.rows[0])
    listed = np.zeros((len(params), total), bool)
    for t in range(total):
        listed[lists.owner[0, lists.pair[0, lists.first[0, t] : lists.first[0, t + 1]]], t] = True
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    tile = (y // TILE).astype(int) * columns + (x // TILE).astype(int)
    touched, over_64 = np.zeros_like(listed), np.zeros(len(params), bool)
    for i in np.flatnonzero(raster.tiles[0, : len(params), 1] > 0):
        mx, my, a, b, c, alpha = raster.projected[0, i, :6].astype(np.float64)
        power = -0.5 * (a * (x - mx) ** 2 + c * (y - my) ** 2) - b * (x - mx) * (y - my)
        touched[i, np.unique(tile[alpha * np.exp(power) >= 1.0 / 255.0])] = True
        x0, x1, y0, y1 = raster.tiles[0, i, :4]
        over_64[i] = (x1 - x0) * (y1 - y0) > 64
    assert touched.sum() > 1000 and not (touched & ~listed).any()
    assert over_64.any() == (longest > 1.0)
    beside = listed & ~touched
    assert beside[~over_64].sum() < 0.03 * touched.sum()


@pytest.mark.parametrize("count", [0, 1, 300])
@pytest.mark.parametrize("longest", [0.08, 3.0])
def test_lists_go_front_to_back_and_do_not_depend_on_how_many_bands_there_are(longest: float, count: int) -> None:
    """Bands without a row among them, and every pair dealt to one tile, those of a Gaussian side by side. Two
    cameras, the picture of one smaller than a tile."""
    lenses = (Pinhole(150, 50, 160.0, 160.0, 74.0, 27.0), Pinhole(5, 3, 6.0, 6.0, 2.0, 1.0))
    params = random_params(300, seed=6)[:count].copy()
    params[:, SCALE:QUATERNION] = np.log([0.01, 0.02, longest])
    total = [-(-lens.width // TILE) * -(-lens.height // TILE) for lens in lenses]
    found = []
    for threads in (1, 2, 3, 5, 9):
        cams = np.concatenate([_camera(lens) for lens in lenses])
        raster = binned(cams, params, pool=Pool(threads, 0))
        lists, made = raster.lists, []
        for b, tiles in enumerate(total):
            first, pairs = lists.first[b, : tiles + 1], int(lists.needed[b])
            own_first, own_count = lists.own_first[b, :count], lists.own_count[b, :count]
            assert first[0] == 0 and first[-1] == pairs == own_count.sum()
            assert np.diff(first).max() == lists.longest[b].max()
            assert (np.sort(lists.pair[b, :pairs]) == np.arange(pairs)).all()
            assert (lists.owner[b, :pairs] == np.repeat(np.arange(count), own_count)).all()
            assert (own_first[own_count > 0] == (np.cumsum(own_count) - own_count)[own_count > 0]).all()
            for a, z in pairwise(first):
                owners = lists.owner[b, lists.pair[b, a:z]]
                assert (np.diff(raster.projected[b, owners, DEPTH]) > -1e-4).all() and len(set(owners)) == z - a
            made += [first.copy(), lists.pair[b, :pairs].copy()]
        found.append(made)
    assert count < 300 or (found[0][0][-1] > 400 and found[0][2][-1] > 0)
    for other in found[1:]:
        assert all((a == b).all() for a, b in zip(found[0], other))


def test_gaussians_beyond_what_memory_is_for_are_left_out_and_nothing_else(monkeypatch) -> None:
    params = random_params(600, seed=6)
    params[:, SCALE:QUATERNION] = np.log(0.3)
    total = -(-LENS.width // TILE) * -(-LENS.height // TILE)
    whole = binned(_camera(), params).lists.own_count[0, :600].astype(np.int64)
    monkeypatch.setattr(buffers, "MAX_PAIRS", 2500)
    for threads in (1, 3):
        raster = binned(_camera(), params, pool=Pool(threads, 0))
        lists, made = raster.lists, 0
        room, listed = lists.pair.shape[1], int(lists.first[0, total])
        assert lists.needed[0] == whole.sum() > room >= listed == lists.own_count[0, :600].sum() > 2000
        for i, pairs in enumerate(whole):
            fits = made + pairs <= room
            assert lists.own_count[0, i] == (pairs if fits else 0)
            made += pairs * fits
        assert (np.sort(lists.pair[0, :listed]) == np.arange(listed)).all()


def test_which_gaussians_reach_a_masked_pixels_tile() -> None:
    params, mask = random_params(80, seed=3), np.zeros((LENS.height, LENS.width), bool)
    params[:, SCALE:QUATERNION] = np.log(0.02)
    mask[11, 3] = True  # of the fourth tile
    raster = binned(_camera(), params)
    lists = raster.lists
    listed = set(lists.owner[0, lists.pair[0, lists.first[0, 3] : lists.first[0, 4]]])
    found = set(np.flatnonzero(raster.reaching(0, 80, mask)))
    assert len(listed) > 2 and listed <= found and len(found) <= len(listed) + 4
    assert not raster.reaching(0, 80, np.zeros_like(mask)).any() and len(found) < 80
