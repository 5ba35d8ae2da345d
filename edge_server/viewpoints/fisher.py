"""FisherRF (Jiang et al. 2024): prefers the view with most information about Gaussians still uncertain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.kernels.fisher_information import MOMENTS, fisher_information
from edge_server.viewpoints.registry import CaptureState
from edge_server.viewpoints.settings import CAMERAS_A_RUN, PRIOR
from freshfield.geometry import Pinhole


def information(
    snapshot: SplatSnapshot, poses: Sequence[NDArray[np.float64]], lenses: Sequence[Pinhole]
) -> Iterator[NDArray[np.float32]]:
    """The diagonal of the Fisher information about N Gaussians of P parameters, float32 (N, P), for each
    camera in turn: the sum over pixels and colors of squared derivatives, for noise of variance 1.

    Raises ViewpointError for view-dependent colors.
    """
    gaussians = snapshot.gaussians
    if gaussians.sh_degree > 0:
        raise ViewpointError("Fisher information is known for splats with sh_degree: 0 only")
    raster = RasterBuffers(snapshot.pool)
    moments = np.zeros((snapshot.pool.threads, len(gaussians.params), MOMENTS))
    for first in range(0, len(poses), CAMERAS_A_RUN):
        some = slice(first, first + CAMERAS_A_RUN)
        cams = camera_rows(poses[some], lenses[some], snapshot.box)
        raster.project_and_bin(cams, gaussians)
        found = np.empty((len(cams), *gaussians.params.shape), np.float32)
        snapshot.pool.run(
            fisher_information,
            cams,
            gaussians,
            raster.columns,
            raster.rows,
            raster.projected,
            raster.lists,
            raster.sums,
            snapshot.background,
            raster.memory,
            raster.saved,
            moments,
            found,
        )
        yield from found


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
        known = np.zeros(snapshot.gaussians.params.shape)
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
