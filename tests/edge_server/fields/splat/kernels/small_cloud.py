"""Random Gaussians in a small box, what cameras see of them, and a step, for the tests of the kernels."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import CallerPool, Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, OptimizerState
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, QUATERNION, SCALE
from edge_server.fields.splat.kernels.rasterize import Target

BOX = SceneBox((0.0, 0.0, 0.0), 1.0, 0.05, False, 3.0, 0.05)
BACK = np.array([0.2, 0.5, 0.9], np.float32)


def random_params(count: int = 12, sh_degree: int = 0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    params = rng.normal(size=(count, BASE + 9 * sh_degree)).astype(np.float32)
    params[:, :3] *= 0.5
    params[:, SCALE:QUATERNION] = np.log(rng.uniform(0.08, 0.4, (count, 3)))
    params[:, OPACITY] = rng.uniform(-1.0, 2.0, count)
    params[:, COLOR:BASE] = rng.random((count, 3))
    params[:, BASE:] *= 0.2
    return params


def binned(
    camera: np.ndarray, params: np.ndarray, differentiate: bool = True, pool: Pool | None = None
) -> RasterBuffers:
    """Buffers after ``project_and_bin``."""
    raster = RasterBuffers(pool or CallerPool())
    raster.project_and_bin(camera, params, differentiate)
    return raster


def target_of(image: NDArray[np.uint8], weight: NDArray[np.float32] | None = None, **rest: Any) -> Target:
    """rest: what is behind it, exposure, share of dissimilarity."""
    weight = np.zeros((0, 0), np.float32) if weight is None else weight
    return Target(np.ascontiguousarray(image), weight, BACK, **rest)


def stepped(
    camera: np.ndarray, params: np.ndarray, target: Target, pool: Pool | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Losses, their gradient by the parameters, and force and torque; the parameters stay."""
    raster, n = binned(camera, params, pool=pool), len(params)
    losses, rigid = raster.train(target), np.full(6, np.nan)
    flat = [np.zeros(n, np.float32) for _ in range(3)]
    moments = OptimizerState(np.zeros_like(params), np.zeros_like(params), np.zeros(n, np.int32), *flat)
    rule = AdamParameters(np.zeros(params.shape[1], np.float32), np.ones((4, 3), np.float32), np.float32(1e-8))
    assert losses[:, 1].sum() == 0
    assert raster.step(camera, params.copy(), moments, rule, rigid) == 0
    return losses, 10.0 * moments.m, rigid  # Adam's first moment, after one step from 0
