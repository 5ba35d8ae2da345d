"""FisherRF (Jiang et al. 2024): prefers the view with most information about Gaussians still uncertain.

With noise of variance 1 on every color of every pixel, the Fisher information about a parameter is the variance of its
gradient of the squared error over random images: it is estimated from that of some black and white ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.field_constants import BETA1
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, OptimizerState, age_corrections
from edge_server.fields.splat.kernels.rasterize import Target
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.registry import CaptureState
from edge_server.viewpoints.viewpoint_constants import PRIOR, RANDOM_IMAGES
from freshfield.geometry import Pinhole


def information(
    snapshot: SplatSnapshot,
    poses: Sequence[NDArray[np.float64]],
    lenses: Sequence[Pinhole],
    images: int = RANDOM_IMAGES,
) -> Iterator[NDArray[np.float32]]:
    """The diagonal of the Fisher information about N Gaussians of P parameters, float32 (N, P), for each camera in
    turn: the sum over pixels and colors of squared derivatives, as ``images`` random images estimate it."""
    params = snapshot.params.copy()  # a step clamps them
    count, width = params.shape
    raster, still = RasterBuffers(snapshot.pool), np.zeros(width, np.float32)
    rule = AdamParameters(still, age_corrections(), np.float32(1.0))
    for pose, lens in zip(poses, lenses):
        camera, size = camera_rows([pose], [lens], snapshot.box), (lens.height, lens.width, 3)
        raster.project_and_bin(camera, params)
        rng, gradients = np.random.default_rng(0), np.empty((images, count, width), np.float32)
        for gradient in gradients:
            image = rng.integers(2, size=size, dtype=np.uint8) * np.uint8(255)
            raster.train(Target(image, np.zeros((0, 0), np.float32), snapshot.background))
            sums = (np.zeros(count, np.float32) for _ in range(3))
            first, second = np.zeros((2, count, width), np.float32)
            raster.step(camera, params, OptimizerState(first, second, np.zeros(count, np.int32), *sums), rule)
            gradient[:] = first / (1.0 - BETA1)  # Adam's first moment after one step
        yield gradients.var(axis=0, ddof=1)


class FisherRF:
    """Expected gain of information, 1/2 log det(H_train + H_view + prior) - 1/2 log det(H_train + prior).

    On the diagonal this is a sum of 1/2 log(1 + H_view / (H_train + prior)). The paper takes the trace of the
    ratio instead, an upper bound that Gaussians never seen before dominate.
    """

    name = "fisher"

    def values(self, state: CaptureState) -> NDArray[np.float64]:
        snapshot = state.field().snapshot()
        if not isinstance(snapshot, SplatSnapshot):
            raise ViewpointError("fisher: it needs a field of Gaussians: splat")
        poses, lens = state.candidates.poses, state.candidates.lens
        known = np.zeros(snapshot.params.shape)
        for row in information(snapshot, [v.camera_to_world for v in state.views], [v.intrinsics for v in state.views]):
            known += row
        if len(known):  # without a view there is no Gaussian
            known += PRIOR * np.maximum(known.mean(axis=0), 1e-12)
        scale = (1.0 / known).astype(np.float32)
        values, asked = np.zeros(len(poses)), np.flatnonzero(state.open)
        rows = information(snapshot, list(poses[asked]), [lens] * len(asked))
        for k, row in zip(asked, rows):
            values[k] = 0.5 * float(np.log1p(row * scale).sum(dtype=np.float64))
        return values
