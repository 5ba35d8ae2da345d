"""The Gaussian kernels: projection, compositing, losses and gradients against torch, Adam's steps against numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.camera import LENS as LENS_COLUMN
from edge_server.fields.common.kernels.camera import ORIGIN
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat import buffers
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, OptimizerState, clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, BLOCK, COLOR, OPACITY, QUATERNION, SCALE, TILE
from edge_server.fields.splat.kernels.rasterize import LOSSES, MOMENTS, render_tiles
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat import torch_oracle
from tests.edge_server.fields.splat.kernels import small_cloud
from tests.edge_server.fields.splat.kernels.small_cloud import BACK, BOX, binned, random_params

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
    raster.pool.run(render_tiles, raster.raster, BACK, *out)
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
    target = small_cloud.target_of(image, weight)
    if weighed:
        share = share * WEIGHT
    if over_plate:
        plate, alpha = RNG.uniform(0, 255, image.shape).astype(np.float32), torch.ones(1)
        target, behind = small_cloud.target_of(image, weight, behind=plate), plate / 255.0
        # Tiles without a Gaussian have nothing to learn, and no loss.
        y, x = np.mgrid[0 : lens.height, 0 : lens.width] // TILE
        share = share * (np.diff(binned(cam, params).lists.first) > 0)[y * -(-lens.width // TILE) + x]
    losses, gradient, _ = small_cloud.stepped(cam, params, target)
    theirs = _double(params).requires_grad_(True)
    color = _oracle(theirs, _double(cam[0]), sh_degree, behind)[0]
    error = color - _double(IMAGE[..., :3] / 255.0) * alpha - (1 - alpha) * _double(behind)
    loss = (_double(share)[..., None] * error.square()).sum()
    loss.backward()
    assert losses[:, 0].sum() == pytest.approx(loss.item(), rel=1e-4)
    _same(gradient, theirs.grad, 3e-3)
    np.testing.assert_array_equal(small_cloud.stepped(cam, params, target, Pool(3, 0))[1], gradient)


# --- what hand-held images add: exposures, dissimilarity, and the gradient by the camera's pose -------


def _step(
    params: np.ndarray, exposed: bool = True, share: float = 0.0, pool: Pool | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Losses, the gradient by the parameters, and force and torque."""
    exposure = np.array([*GAIN, *BIAS, FACTOR] if exposed else [], np.float32)
    target = small_cloud.target_of(IMAGE[..., :3], WEIGHT, exposure=exposure, dissimilarity=np.float32(share))
    return small_cloud.stepped(_camera(BENT), params, target, pool)


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


def test_a_quaternion_without_direction_is_no_rotation() -> None:
    cam, params = _camera(), random_params(2)
    params[:, QUATERNION:OPACITY] = 0.0
    plain = params.copy()
    plain[:, QUATERNION] = 1.0
    np.testing.assert_array_equal(_render(params, cam)[0], _render(plain, cam)[0])
    gradient = small_cloud.stepped(cam, params, small_cloud.target_of(IMAGE[..., :3]))[1]
    assert np.isfinite(gradient).all() and not gradient[:, QUATERNION:OPACITY].any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, 1e-40])
def test_no_parameter_poisons_a_rendering(value: float) -> None:
    for column in range(BASE):
        params = random_params(6)
        params[2, column] = value
        assert all(np.isfinite(part).all() for part in _render(params, _camera())), f"column {column}"


def test_behind_the_camera_beside_the_lens_and_none_at_all() -> None:
    """The lens's polynomial turns around beyond the field of view; what stands there must not appear."""
    params, pose = random_params(5), look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))
    params[:, :3] = (5.0, -12.0, 3.0)  # behind it
    beside = random_params(1)
    beside[0, :3] = pose[:3, 3] + pose[:3, :3] @ np.array([6.0, 0.0, 0.4])
    beside[0, SCALE:QUATERNION], beside[0, OPACITY] = np.log(0.05), 8.0
    bent = camera_rows([pose], [replace(LENS, distortion=(-0.25, 0.0, 0.0, 0.0))], BOX)
    for cloud, cam in ((params, _camera()), (params[:0], _camera()), (beside, bent)):
        color, _, opacity = _render(cloud, cam)
        assert (color == BACK).all() and not opacity.any()


@pytest.mark.parametrize("longest", [0.08, 3.0])
def test_a_tile_lists_the_gaussians_that_have_a_pixel_in_it_and_hardly_another(longest: float) -> None:
    """Needles in every direction, also such that the first 64 tiles of their box are not all of them."""
    lens = Pinhole(150, 110, 160.0, 160.0, 74.0, 57.0)
    params = random_params(300, seed=6)
    params[:, SCALE:QUATERNION] = np.log([0.01, 0.02, longest])
    raster = binned(_camera(lens), params)
    lists, columns = raster.lists, raster.columns
    total = columns * raster.rows
    listed = np.zeros((len(params), total), bool)
    for t in range(total):
        listed[lists.owner[lists.pair[lists.first[t] : lists.first[t + 1]]], t] = True
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    tile = (y // TILE).astype(int) * columns + (x // TILE).astype(int)
    touched, over_64 = np.zeros_like(listed), np.zeros(len(params), bool)
    for i in np.flatnonzero(raster.tiles[: len(params), 1] > 0):
        mx, my, a, b, c, alpha = raster.projected[i, :6].astype(np.float64)
        power = -0.5 * (a * (x - mx) ** 2 + c * (y - my) ** 2) - b * (x - mx) * (y - my)
        touched[i, np.unique(tile[alpha * np.exp(power) >= 1.0 / 255.0])] = True
        x0, x1, y0, y1 = raster.tiles[i, :4]
        over_64[i] = (x1 - x0) * (y1 - y0) > 64
    assert touched.sum() > 1000 and not (touched & ~listed).any()
    assert over_64.any() == (longest > 1.0)
    beside = listed & ~touched
    assert beside[~over_64].sum() < 0.03 * touched.sum()


def test_gaussians_beyond_what_memory_is_for_are_left_out_and_nothing_else(monkeypatch) -> None:
    params = random_params(600, seed=6)
    params[:, SCALE:QUATERNION] = np.log(0.3)
    total = -(-LENS.width // TILE) * -(-LENS.height // TILE)
    whole = binned(_camera(), params).lists.own_count[:600].astype(np.int64)
    monkeypatch.setattr(buffers, "MAX_PAIRS", 2500)
    for threads in (1, 3):
        raster = binned(_camera(), params, pool=Pool(threads, 0))
        lists, made = raster.lists, 0
        room, listed = lists.pair.size, int(lists.first[total])
        assert lists.needed[0] == whole.sum() > room >= listed == lists.own_count[:600].sum() > 2000
        for i, pairs in enumerate(whole):
            fits = made + pairs <= room
            assert lists.own_count[i] == (pairs if fits else 0)
            made += pairs * fits
        assert (np.sort(lists.pair[:listed]) == np.arange(listed)).all()


# --- the optimizer step ---------------------------------------------------------------------------

COUNT = 2 * BLOCK + 44  # two full blocks and a part of one
STEP_LENS = Pinhole(48, 40, 50.0, 50.0, 24.0, 20.0, (-0.05, 0.01, 0.002, -0.001))
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-8


def _raster(params: NDArray[np.float32]) -> tuple[RasterBuffers, NDArray[np.float32]]:
    camera = _camera(STEP_LENS)
    raster = binned(camera, params)
    raster.lists.own_count[:COUNT:10] = raster.lists.own_count[BLOCK : 2 * BLOCK] = 0  # they are not seen
    rng = np.random.default_rng(4)
    raster.sums[...] = rng.normal(size=raster.sums.shape) * 0.01
    return raster, camera


def _moments(width: int, filled: bool) -> OptimizerState:
    rng = np.random.default_rng(7)
    m, v = rng.normal(size=(COUNT, width)) * 0.1, rng.uniform(0.0, 0.1, (COUNT, width))
    age = rng.integers(0, 6, COUNT) if filled else np.zeros(COUNT)
    flat = [np.zeros(COUNT, np.float32) for _ in range(3)]
    share = 1.0 if filled else 0.0
    return OptimizerState((share * m).astype(np.float32), (share * v).astype(np.float32), age.astype(np.int32), *flat)


def _adam_parameters(width: int, rate: float) -> AdamParameters:
    rates = rate * (1.0 + np.arange(width)) / width
    corrections = np.array([[9.0, 9.0, 9.0], [3.0, 2.5, 1.0], [2.0, 1.8, 0.9], [1.5, 1.2, 0.8]])
    return AdamParameters(rates.astype(np.float32), corrections.astype(np.float32), np.float32(EPSILON))


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_a_step_is_adams(sh_degree: int) -> None:
    params = random_params(COUNT, sh_degree, 3)
    raster, camera = _raster(params)
    width = params.shape[1]
    moments = _moments(width, filled=False)
    raster.step(camera, params.copy(), moments, _adam_parameters(width, 0.0))
    g = (moments.m / np.float32(1.0 - BETA1)).astype(np.float64)  # from Adam's first moment after one step from 0
    seen = raster.lists.own_count[:COUNT] > 0
    assert 0 < (~seen).sum() < COUNT // 2 and (np.abs(g[seen]).max(axis=1) > 0).all()
    moments, after = _moments(width, filled=True), params.copy()
    before = OptimizerState(*(np.array(array, np.float64) for array in moments))
    rule = _adam_parameters(width, 1e-3)
    assert raster.step(camera, after, moments, rule) == 0

    m = BETA1 * before.m + (1.0 - BETA1) * g
    v = BETA2 * before.v + (1.0 - BETA2) * g * g
    first, second, calm = rule.corrections[np.minimum(before.age + 1, 3).astype(int)].T.astype(np.float64)
    rate = rule.rates * calm[:, None] * np.ones((COUNT, width))
    rate[:, :3] *= np.maximum(np.abs(params[:, :3]).max(axis=1), 1.0)[:, None]
    moved = rate * m * first[:, None] / (np.sqrt(v * second[:, None]) + EPSILON)
    np.testing.assert_allclose(moments.m[seen], m[seen], rtol=2e-5, atol=1e-7)
    np.testing.assert_allclose(moments.v[seen], v[seen], rtol=2e-5, atol=1e-9)
    np.testing.assert_allclose((params - after)[seen], moved[seen], rtol=1e-3, atol=2e-6)
    np.testing.assert_array_equal(moments.age[seen], before.age[seen] + 1)
    for array, was in ((after, params), (moments.m, before.m), (moments.v, before.v), (moments.age, before.age)):
        np.testing.assert_array_equal(array[~seen], was[~seen].astype(array.dtype))


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_what_is_not_finite_is_dropped_and_counted(broken: float) -> None:
    """A sum of a color reaches that color alone: neither the number nor its moment moves."""
    params = random_params(COUNT, seed=3)
    raster, camera = _raster(params)
    victim = int(np.flatnonzero(raster.lists.own_count[:COUNT] > 0)[40])
    rule, sound, hurt = _adam_parameters(BASE, 1e-3), params.copy(), params.copy()
    raster.step(camera, sound, _moments(BASE, filled=True), rule)
    raster.sums[raster.lists.own_first[victim], 7] = broken
    moments = _moments(BASE, filled=True)
    was = moments.m[victim, COLOR + 1]
    assert raster.step(camera, hurt, moments, rule) == 1
    sound[victim, COLOR + 1] = params[victim, COLOR + 1]
    np.testing.assert_array_equal(hurt, sound)
    assert moments.m[victim, COLOR + 1] == was and np.isfinite(moments.v).all()


def test_parameters_are_kept_within_their_bounds() -> None:
    """In numbers: what lies within stays as it is to the last bit."""
    params = random_params(5, seed=3)
    params[:, OPACITY] = 8.0, -8.5, 50.0, -50.0, np.nan
    params[1, :3], params[2, SCALE:QUATERNION] = (500.0, -500.0, 1.0), 3.0
    params[3, SCALE:QUATERNION] = -1.0, -9.0, -1.0
    params[2, QUATERNION:OPACITY], params[3, COLOR] = 0.0, 7.0
    before = params.copy()
    clamp_gaussians(params)
    np.testing.assert_array_equal(params[0], before[0])
    np.testing.assert_array_equal(params[:, OPACITY], np.float32([8.0, -8.5, 9.0, -9.0, -9.0]))
    np.testing.assert_array_equal(params[1, :3], np.float32([100.0, -100.0, 1.0]))
    far = max(1.0, np.abs(before[2, :3]).max())
    np.testing.assert_allclose(params[2, SCALE:QUATERNION], np.log(0.5 * far), rtol=1e-5)
    assert np.ptp(params[3, SCALE:QUATERNION]) == pytest.approx(np.log(20.0), abs=1e-5)
    np.testing.assert_array_equal(params[2, QUATERNION:OPACITY], [1.0, 0.0, 0.0, 0.0])
    assert params[3, COLOR] == 1.5
