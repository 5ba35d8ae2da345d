"""What hand-held images add to a step: exposures, dissimilarity, and the gradient by the camera's pose, against the
oracle."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.camera import LENS as LENS_COLUMN
from edge_server.fields.common.kernels.camera import ORIGIN
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, OptimizerState
from edge_server.fields.splat.kernels.project import TILE
from edge_server.fields.splat.kernels.rasterize import LOSSES, MOMENTS, Targets
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat import torch_oracle
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, as_gaussians, binned, random_params

LENS = Pinhole(21, 18, 22.0, 24.0, 10.0, 9.5, (-0.12, 0.03, 0.01, -0.015))
CAM = camera_rows([look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))], [LENS], BOX)
BACK = np.array([0.2, 0.5, 0.9], np.float32)
RNG = np.random.default_rng(5)
IMAGE = RNG.integers(0, 256, (LENS.height, LENS.width, 3), dtype=np.uint8)
WEIGHT = np.where(RNG.random(IMAGE.shape[:2]) < 0.3, 0.0, RNG.random(IMAGE.shape[:2])).astype(np.float32)
GAIN, BIAS, FACTOR = (0.6, 1.0, 1.7), (0.1, -0.05, 0.02), 1.4
SHARE = 0.3  # of dissimilarity, far more than in use, so that its gradient is seen


def _targets(exposed: bool = True, share: float = 0.0) -> Targets:
    row = np.array([[*GAIN, *BIAS, FACTOR]], np.float32)
    return Targets(
        np.array([0, IMAGE[..., 0].size]),
        np.array([[LENS.width, LENS.height]]),
        IMAGE.reshape(-1, 3),
        WEIGHT.reshape(-1),
        np.zeros((0, 3), np.float32),
        BACK,
        row if exposed else row[:0],
        np.float32(share),
    )


def _step(params: np.ndarray, targets: Targets, pool: Pool | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Losses, the gradient by the parameters, and force and torque."""
    raster, n = binned(CAM, params, pool=pool), len(params)
    losses, rigid = raster.train(targets, 0), np.full(6, np.nan)
    flat = [np.zeros(n, np.float32) for _ in range(3)]
    moments = OptimizerState(np.zeros_like(params), np.zeros_like(params), np.zeros(n, np.int32), *flat)
    rule = AdamParameters(np.zeros(params.shape[1], np.float32), np.ones((4, 3), np.float32), np.float32(1e-8))
    assert raster.step(CAM, as_gaussians(params.copy()), moments, rule, rigid) == 0
    return losses, 10.0 * moments.m, rigid


def _rendered(params: Tensor, sh_degree: int = 0, motion: Tensor | None = None) -> Tensor:
    """motion: (6,), a shift and a rotation vector of the camera, world axes."""
    cam = torch.as_tensor(CAM[0], dtype=torch.float64)
    if motion is not None:
        zero = torch.zeros((), dtype=torch.float64)
        x, y, z = motion[3:]
        turn = torch.stack([torch.stack(row) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))])
        rotation = cam[:ORIGIN].reshape(3, 3) @ torch.linalg.matrix_exp(turn).T
        origin = cam[ORIGIN:LENS_COLUMN] + motion[:3]
        cam = torch.cat([rotation.reshape(-1), origin, cam[LENS_COLUMN:]])
    flat = torch_oracle.flatten(cam, params, sh_degree)
    return torch_oracle.composite(flat, LENS.width, LENS.height, torch.as_tensor(BACK, dtype=torch.float64))[0]


def _at_the_fields_exposure() -> tuple[Tensor, Tensor]:
    """The image (H, W, 3) and the pixels' weights (H, W)."""
    image = (torch.as_tensor(IMAGE / 255.0) - torch.tensor(BIAS).double()) / torch.tensor(GAIN).double()
    return image, torch.as_tensor(WEIGHT, dtype=torch.float64) * FACTOR


def _dissimilarity(rendered: Tensor, image: Tensor, weight: Tensor) -> Tensor:
    """The sum over channels and tiles of (1 - SSIM) / 2, times the weights of a tile's pixels."""
    total = torch.zeros((), dtype=torch.float64)
    for y in range(0, LENS.height, TILE):
        for x in range(0, LENS.width, TILE):
            r, t, w = (part[y : y + TILE, x : x + TILE] for part in (rendered, image, weight[..., None]))
            share = w / w.sum()
            mr, mt = (share * r).sum((0, 1)), (share * t).sum((0, 1))
            rr, tt, rt = (
                (share * a * b).sum((0, 1)) for a, b in ((r - mr, r - mr), (t - mt, t - mt), (r - mr, t - mt))
            )
            alike = (2 * mr * mt + 1e-4) / (mr**2 + mt**2 + 1e-4) * (2 * rt + 9e-4) / (rr + tt + 9e-4)
            total = total + w.sum() * (0.5 - 0.5 * alike).sum()
    return total


@pytest.mark.parametrize("share", [0.0, SHARE])
def test_gradients_with_exposure_and_dissimilarity_equal_the_oracle(share: float) -> None:
    params = random_params(seed=3)
    losses, gradient, rigid = _step(params, _targets(share=share))
    theirs = torch.as_tensor(params, dtype=torch.float64).requires_grad_(True)
    image, weight = _at_the_fields_exposure()
    rendered = _rendered(theirs)
    square = (weight[..., None] * (rendered - image).square()).sum()
    (square + share * _dissimilarity(rendered, image, weight)).backward()
    assert theirs.grad is not None and losses[:, 0].sum() == pytest.approx(square.item(), rel=1e-4)
    expected = theirs.grad.numpy()
    scale = np.abs(expected).max(axis=0, keepdims=True)
    np.testing.assert_allclose(gradient / scale, expected / scale, atol=3e-3)
    threaded = _step(params, _targets(share=share), Pool(3, 0))
    for mine, other in zip((losses, gradient, rigid), threaded, strict=True):
        np.testing.assert_array_equal(mine, other)


def test_moments_are_those_of_the_pixels() -> None:
    params = random_params(seed=3)
    losses, _, _ = _step(params, _targets())
    image, weight = _at_the_fields_exposure()
    r = _rendered(torch.as_tensor(params, dtype=torch.float64)).detach().numpy()
    t, w = image.numpy(), weight.numpy()[..., None]
    expected = np.stack([(w * part).sum(axis=(0, 1)) for part in (np.ones_like(r), r, r * r, t, r * t)], axis=1)
    np.testing.assert_allclose(losses[:, LOSSES:].sum(axis=0).reshape(3, MOMENTS), expected, rtol=1e-4)
    assert _step(params, _targets(exposed=False))[0].shape[1] == LOSSES


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_force_and_torque_are_the_gradient_by_the_cameras_pose(sh_degree: int) -> None:
    params = random_params(300, sh_degree=sh_degree, seed=3)
    _, _, rigid = _step(params, _targets(exposed=False))
    motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    rendered = _rendered(torch.as_tensor(params, dtype=torch.float64), sh_degree, motion)
    error = rendered - torch.as_tensor(IMAGE / 255.0)
    (torch.as_tensor(WEIGHT, dtype=torch.float64)[..., None] * error.square()).sum().backward()
    assert motion.grad is not None
    expected = motion.grad.numpy()
    np.testing.assert_allclose(-rigid / np.abs(expected).max(), expected / np.abs(expected).max(), atol=2e-3)
