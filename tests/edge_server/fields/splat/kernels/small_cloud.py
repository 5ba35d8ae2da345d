"""Random Gaussians in a small box, and what cameras see of them, for the tests of the kernels."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import CallerPool, Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, QUATERNION, SCALE, Gaussians

BOX = SceneBox((0.0, 0.0, 0.0), 1.0, 0.05, False, 3.0, 0.05)


def random_params(count: int = 12, sh_degree: int = 0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    params = rng.normal(size=(count, BASE + 9 * sh_degree)).astype(np.float32)
    params[:, :3] *= 0.5
    params[:, SCALE:QUATERNION] = np.log(rng.uniform(0.08, 0.4, (count, 3)))
    params[:, OPACITY] = rng.uniform(-1.0, 2.0, count)
    params[:, COLOR:BASE] = rng.random((count, 3))
    params[:, BASE:] *= 0.2
    return params


def as_gaussians(params: np.ndarray) -> Gaussians:
    """What the kernels read."""
    return Gaussians(params, (params.shape[1] - BASE) // 9)


def binned(cams: np.ndarray, params: np.ndarray, differentiate: bool = True, pool: Pool | None = None) -> RasterBuffers:
    """Buffers after ``project_and_bin``."""
    raster = RasterBuffers(pool or CallerPool())
    raster.project_and_bin(cams, as_gaussians(params), differentiate)
    return raster
