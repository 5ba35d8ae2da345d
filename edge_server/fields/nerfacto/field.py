"""Nerfacto for CPUs (Tancik et al. 2023): the hash grid of ``ngp``, with samples from a learned proposal.

``trained_field`` does the common part. This file adds samples from a proposal instead of a raster
(``kernels.proposal``), appearance embeddings (``appearance``), and rendering from the proposal.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT, Grid
from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.kernels.rays import Space, Views
from edge_server.fields.common.kernels.train import CHUNK, CHUNK_RAYS, RaySampling
from edge_server.fields.common.kernels.volume_rendering import Weights
from edge_server.fields.common.model_layout import init_net, make_grid
from edge_server.fields.common.ray_snapshot import Pixels, RaySnapshot
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.nerfacto.appearance import CameraAppearance
from edge_server.fields.nerfacto.kernels.proposal import ProposalGrid, ProposalSampling, scatter_proposal
from edge_server.fields.nerfacto.kernels.render import SAMPLE_BATCH, render_with_proposal
from edge_server.fields.nerfacto.kernels.train import ProposalGradients, ProposalScratch, train_with_proposal
from edge_server.fields.nerfacto.settings import NerfactoSettings
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import STATE_SHAPE


@dataclass(frozen=True)
class NerfactoSnapshot(RaySnapshot):
    """A snapshot that is rendered with samples from its proposal, at the mean appearance."""

    sampling: ProposalSampling

    def _run(self, camera: tuple[NDArray[np.float64], ...], out: Pixels) -> None:
        model = self.space, self.encoding, self.levels, self.net, self.settings.harmonics, self.background
        scratch = self._scratch(SAMPLE_BATCH, 3)
        self.pool.run(render_with_proposal, *camera, self.sampling, *model, *scratch, *out)


class NerfactoField(NgpField):
    """The hash grid of ``NgpField``, and a proposal. See ``fields.Field`` for the protocol."""

    name = NerfactoSettings.name
    shape: ClassVar[tuple[str, ...]] = (
        *(option for option in STATE_SHAPE if option != "samples"),
        "proposal_cells",
        "appearance",
    )
    _cameras: CameraAppearance

    def __init__(self, settings: NerfactoSettings | None = None, pool: Pool | None = None) -> None:
        super().__init__(settings or NerfactoSettings(), pool)

    def _grid(self) -> Grid:
        e = self._encoding
        return Grid(e.resolution, e.first, e.dense, e.table)

    def _make(self, rng: np.random.Generator) -> tuple[ProposalGrid, Net]:
        s = self.settings
        grid = make_grid(s, self.view_store.box, rng)
        per_segment = SEGMENT * FEATURES
        rows = -(-(s.proposal_cells**3) // per_segment) * SEGMENT
        table = np.concatenate([grid.table, np.zeros((rows, FEATURES), np.float32)])
        net = init_net(FEATURES * s.levels, s, rng, s.appearance)
        return ProposalGrid(grid.resolution, grid.first, grid.dense, table, s.proposal_cells), net

    def _tiny(self) -> NerfactoSettings:
        return replace(super()._tiny(), proposal_cells=8)

    def _forget_parameters(self) -> None:
        super()._forget_parameters()
        s, chunks, workers = self.settings, len(self._batch.samples), self.pool.threads
        self._cameras = CameraAppearance(s.exposure, s.refine_m, s.refine_deg, s.appearance, s.seed)
        most = CHUNK_RAYS * s.bins
        self._proposal_gradients = ProposalGradients(
            cell=np.zeros((chunks, most), np.int32),
            grad=np.zeros((chunks, most), np.float32),
            counts=np.zeros(chunks, np.int64),
            d_embeddings=np.zeros((chunks, 0, s.appearance), np.float32),
        )
        self._proposal_scratch = ProposalScratch(
            line=np.zeros((workers, 4, CHUNK), np.float32),
            depth=np.zeros((workers, most), np.float32),
            weight=np.zeros((workers, most), np.float32),
            group=np.zeros((workers, most), np.int32),
            first=np.zeros((workers, CHUNK_RAYS + 1), np.int64),
        )

    def _sampling(self) -> ProposalSampling:
        """Settings of the sampling at this step."""
        s = self.settings
        ramp = min(self.step / s.samples_ramp, 1.0) if s.samples_ramp else 1.0
        fresh = max(1.0 - self.step / s.anneal, 0.0) if s.anneal else 0.0
        even = s.even + (1.0 - s.even) * fresh if s.interlevel > 0 else 1.0
        return ProposalSampling(
            bins=s.bins,
            samples=round(s.samples_start + ramp * (s.samples - s.samples_start)),
            uniform_share=np.float32(even),
            interlevel=np.float32(s.interlevel),
            decay=np.float32(s.proposal_decay),
        )

    def _train(self, data: Views, ray_sampling: RaySampling, space: Space, weights: Weights) -> None:
        cameras, bins = self._cameras, self._proposal_gradients
        if bins.d_embeddings.shape[1:] != cameras.embeddings.shape:
            bins = self._proposal_gradients = bins._replace(
                d_embeddings=np.zeros((len(bins.counts), *cameras.embeddings.shape), np.float32)
            )
        self.pool.run(
            train_with_proposal,
            data,
            ray_sampling,
            self._sampling(),
            space,
            self._encoding,
            self._net,
            cameras.embeddings,
            weights,
            self._batch,
            bins,
            self._scratch,
            self._proposal_scratch,
        )
        cameras.gradient, cameras.rays = bins.d_embeddings, int(self._batch.rays.sum())

    def _gather(self, levels: int, scale: float) -> None:
        super()._gather(levels, scale)
        bins = self._proposal_gradients
        self.pool.run(scatter_proposal, self._encoding, bins.cell, bins.grad, bins.counts, self._table_g, self._dirty)

    def _live(self) -> NerfactoSnapshot:
        live = super()._live()
        known = {f.name: getattr(live, f.name) for f in fields(live)}
        return NerfactoSnapshot(**known, sampling=self._sampling())


make = NerfactoField
