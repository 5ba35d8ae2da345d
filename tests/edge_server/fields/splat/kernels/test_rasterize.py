"""The Gaussian kernels: projection, compositing, losses and their gradients against torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.camera import LENS as LENS_COLUMN
from edge_server.fields.common.kernels.camera import ORIGIN
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat import buffers
from edge_server.fields.splat.kernels.project import BASE, OPACITY, QUATERNION, SCALE, TILE
from edge_server.fields.splat.kernels.rasterize import LOSSES, MOMENTS, render_tiles
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat import torch_oracle
from tests.edge_server.fields.splat.kernels.small_cloud import BACK, BOX, binned, random_params, stepped, targets_of

LENS = Pinhole(21, 18, 22.0, 24.0, 10.0, 9.5)
BENT = replace(LENS, distortion=(-0.12, 0.03, 0.01, -0.015))
RNG = np.random.default_rng(5)
IMAGE = RNG.integers(0, 256, (LENS.height, LENS.width, 4), dtype=np.uint8)
GAIN, BIAS, FACTOR = (0.6, 1.0, 1.7), (0.1, -0.05, 0.02), 1.4
SHARE = 0.3  # of dissimilarity, far more than in use, so that its gradient is seen
# Some of none, a whole tile of none, the others unequal.
WEIGHT = np.where(RNG.random(IMAGE.shape[:2]) < 0.3, 0.0, RNG.random(IMAGE.shape[:2])).astype(np.float32)
WEIGHT[:TILE, TILE : 2 * TILE] = 0.0


def _camera(lens: Pinhole = LENS) -> np.ndarray:
    return camera_rows([look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))], [lens], BOX)


def _render(params: np.ndarray, cam: np.ndarray) -> list[np.ndarray]:
    raster = binned(cam, params, differentiate=False, pool=Pool(1, 0))
    w, h = LENS.width, LENS.height
    out = [np.full((h, w, 3), 7, np.float32), np.full((h, w), 7, np.float32), np.full((h, w), 7, np.float32)]
    raster.pool.run(render_tiles, raster.first, BACK, *out)
    return out


def _double(array: np.ndarray) -> Tensor:
    return torch.as_tensor(array, dtype=torch.float64)


def _oracle(params: Tensor, cam: Tensor, sh_degree: int = 0, behind: np.ndarray = BACK) -> tuple[Tensor, ...]:
    """Color, depth and opacity."""
    flat = torch_oracle.flatten(cam, params, sh_degree)
    return torch_oracle.composite(flat, LENS.width, LENS.height, _double(behind))


def _same(found: np.ndarray, wanted: Tensor | None, atol: float) -> None:
    """Of each column, up to a part of its largest number."""
    assert wanted is not None
    largest = np.abs(wanted.numpy()).max(axis=0)
    np.testing.assert_allclose(found / largest, wanted.numpy() / largest, atol=atol)


@pytest.mark.parametrize(("lens", "sh_degree"), [(LENS, 0), (BENT, 1)])
def test_pictures_equal_the_oracle(lens: Pinhole, sh_degree: int) -> None:
    params, cam = random_params(sh_degree=sh_degree), _camera(lens)
    for mine, theirs in zip(_render(params, cam), _oracle(_double(params), _double(cam[0]), sh_degree)):
        reference = theirs.detach().numpy().clip(0.0, 1.0 if mine.ndim == 3 else None)
        np.testing.assert_allclose(mine, reference, atol=2e-4)


@pytest.mark.parametrize(
    ("lens", "sh_degree", "weighed", "over_plate"),
    [(LENS, 0, False, False), (BENT, 1, False, False), (BENT, 0, True, False), (BENT, 0, True, True)],
)
def test_gradients_equal_the_oracle(lens: Pinhole, sh_degree: int, weighed: bool, over_plate: bool) -> None:
    """Of transparent images, or over a color of its own in every pixel; any number of threads does the same."""
    params, cam = random_params(sh_degree=sh_degree, seed=3), _camera(lens)
    image, share = IMAGE[..., : 3 if over_plate else 4], np.ones(IMAGE.shape[:2])
    weight, behind, alpha = (WEIGHT if weighed else None), BACK, _double(IMAGE[..., 3:] / 255.0)
    targets = targets_of(image, weight)
    if weighed:
        share = share * WEIGHT
    if over_plate:
        plate, alpha = RNG.uniform(0, 255, image.shape).astype(np.float32), torch.ones(1)
        targets, behind = targets_of(image, weight, plate.reshape(-1, 3), BACK), plate / 255.0
        # Tiles without a Gaussian have nothing to learn, and no loss.
        y, x = np.mgrid[0 : lens.height, 0 : lens.width] // TILE
        share = share * (np.diff(binned(cam, params).lists.first[0]) > 0)[y * -(-lens.width // TILE) + x]
    losses, gradient, _ = stepped(cam, params, targets)
    theirs = _double(params).requires_grad_(True)
    color = _oracle(theirs, _double(cam[0]), sh_degree, behind)[0]
    error = color - _double(IMAGE[..., :3] / 255.0) * alpha - (1 - alpha) * _double(behind)
    loss = (_double(share)[..., None] * error.square()).sum()
    loss.backward()
    assert losses[:, 0].sum() == pytest.approx(loss.item(), rel=1e-4)
    _same(gradient, theirs.grad, 3e-3)
    np.testing.assert_array_equal(stepped(cam, params, targets, Pool(3, 0))[1], gradient)


# --- what hand-held images add: exposures, dissimilarity, and the gradient by the camera's pose -------


def _step(
    params: np.ndarray, exposed: bool = True, share: float = 0.0, pool: Pool | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Losses, the gradient by the parameters, and force and torque."""
    row = np.array([[*GAIN, *BIAS, FACTOR]], np.float32)[: int(exposed)]
    targets = targets_of(IMAGE[..., :3], WEIGHT, np.zeros((0, 3), np.float32), BACK, row, np.float32(share))
    return stepped(_camera(BENT), params, targets, pool)


def _at_the_fields_exposure() -> tuple[Tensor, Tensor]:
    """The image (H, W, 3) and the pixels' weights (H, W)."""
    image = (_double(IMAGE[..., :3] / 255.0) - torch.tensor(BIAS).double()) / torch.tensor(GAIN).double()
    return image, _double(WEIGHT) * FACTOR


def _dissimilarity(rendered: Tensor, image: Tensor, weight: Tensor) -> Tensor:
    """The sum over channels and tiles of (1 - SSIM) / 2, times the weights of a tile's pixels."""
    total = torch.zeros((), dtype=torch.float64)
    for y in range(0, LENS.height, TILE):
        for x in range(0, LENS.width, TILE):
            r, t, w = (part[y : y + TILE, x : x + TILE] for part in (rendered, image, weight[..., None]))
            if not w.any():
                continue
            share = w / w.sum()
            mr, mt = (share * r).sum((0, 1)), (share * t).sum((0, 1))
            r, t = r - mr, t - mt
            rr, tt, rt = ((share * a * b).sum((0, 1)) for a, b in ((r, r), (t, t), (r, t)))
            alike = (2 * mr * mt + 1e-4) / (mr**2 + mt**2 + 1e-4) * (2 * rt + 9e-4) / (rr + tt + 9e-4)
            total = total + w.sum() * (0.5 - 0.5 * alike).sum()
    return total


def test_gradients_with_exposure_and_dissimilarity_equal_the_oracle() -> None:
    params = random_params(seed=3)
    losses, gradient, rigid = _step(params, share=SHARE)
    theirs, (image, weight) = _double(params).requires_grad_(True), _at_the_fields_exposure()
    rendered = _oracle(theirs, _double(_camera(BENT)[0]))[0]
    square = (weight[..., None] * (rendered - image).square()).sum()
    (square + SHARE * _dissimilarity(rendered, image, weight)).backward()
    assert losses[:, 0].sum() == pytest.approx(square.item(), rel=1e-4)
    _same(gradient, theirs.grad, 3e-3)
    for mine, other in zip((losses, gradient, rigid), _step(params, share=SHARE, pool=Pool(3, 0)), strict=True):
        np.testing.assert_array_equal(mine, other)


def test_moments_are_those_of_the_pixels() -> None:
    params = random_params(seed=3)
    losses, _, _ = _step(params)
    image, weight = _at_the_fields_exposure()
    r = _oracle(_double(params), _double(_camera(BENT)[0]))[0].detach().numpy()
    t, w = image.numpy(), weight.numpy()[..., None]
    expected = np.stack([(w * part).sum(axis=(0, 1)) for part in (np.ones_like(r), r, r * r, t, r * t)], axis=1)
    np.testing.assert_allclose(losses[:, LOSSES:].sum(axis=0).reshape(3, MOMENTS), expected, rtol=1e-4)
    assert _step(params, exposed=False)[0].shape[1] == LOSSES


def test_force_and_torque_are_the_gradient_by_the_cameras_pose() -> None:
    """Of more Gaussians than a block holds, whose own gradient is right, too."""
    params = random_params(140, sh_degree=1, seed=3)
    params[::3, OPACITY] = 8.0  # as opaque as they can be: those have no gradient of their opacity, and hide others
    _, gradient, rigid = _step(params, exposed=False)
    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)  # shift and rotation vector, world axes
    cam, theirs = _double(_camera(BENT)[0]), _double(params).requires_grad_(True)
    zero = torch.zeros((), dtype=torch.float64)
    x, y, z = motion[3:]
    turn = torch.stack([torch.stack(row) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))])
    rotation = cam[:ORIGIN].reshape(3, 3) @ torch.linalg.matrix_exp(turn).T
    cam = torch.cat([rotation.reshape(-1), cam[ORIGIN:LENS_COLUMN] + motion[:3], cam[LENS_COLUMN:]])
    error = _oracle(theirs, cam, 1)[0] - _double(IMAGE[..., :3] / 255.0)
    (_double(WEIGHT)[..., None] * error.square()).sum().backward()
    _same(-rigid[:, None], motion.grad[:, None], 2e-3)
    _same(gradient, theirs.grad, 2e-3)


# --- hard cases, and the lists of tiles -------------------------------------------------------------


def _gradient(params: np.ndarray) -> np.ndarray:
    return stepped(_camera(), params, targets_of(IMAGE[..., :3]))[1]


def test_a_quaternion_without_direction_is_no_rotation() -> None:
    cam, params = _camera(), random_params(2)
    params[:, QUATERNION:OPACITY] = 0.0
    plain = params.copy()
    plain[:, QUATERNION] = 1.0
    np.testing.assert_array_equal(_render(params, cam)[0], _render(plain, cam)[0])
    gradient = _gradient(params)
    assert np.isfinite(gradient).all() and not gradient[:, QUATERNION:OPACITY].any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, 1e-40])
def test_no_parameter_poisons_a_rendering(value: float) -> None:
    for column in range(BASE):
        params = random_params(6)
        params[2, column] = value
        assert all(np.isfinite(part).all() for part in _render(params, _camera())), f"column {column}"


def test_behind_the_camera_and_none_at_all() -> None:
    params = random_params(5)
    params[:, :3] = (5.0, -12.0, 3.0)  # behind it
    for cloud in (params, params[:0]):
        color, _, opacity = _render(cloud, _camera())
        assert (color == BACK).all() and not opacity.any()


def test_a_huge_one_far_to_the_side_does_not_fold_back() -> None:
    """The lens's polynomial turns around beyond the field of view; what stands there must not appear."""
    params, pose = random_params(1), look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))
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
