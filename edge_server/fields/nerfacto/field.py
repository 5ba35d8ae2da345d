"""Nerfacto for CPUs (Tancik et al. 2023): the hash grid of ``ngp``, with samples from a learned proposal.

``trained_field`` does the common part. This file adds samples from a proposal instead of a raster
(``kernels.proposal``); it alone offers appearance embeddings (``common.cameras.appearance``).
"""

from __future__ import annotations

import msgspec
import numpy as np

from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT
from edge_server.fields.common.kernels.train import CHUNK_RAYS
from edge_server.fields.nerfacto.kernels.proposal import ProposalGrid, ProposalSampling
from edge_server.fields.nerfacto.kernels.train import ProposalBins, scatter_proposal
from edge_server.fields.nerfacto.settings import NerfactoSettings
from edge_server.fields.ngp.field import NgpField


class NerfactoField(NgpField):
    """The hash grid of ``NgpField``, and a proposal. See ``fields.Field`` for the protocol."""

    Settings = NerfactoSettings
    shape = (*NgpField.shape, "proposal_cells", "appearance")

    _bins: ProposalBins

    def _make(self, rng: np.random.Generator) -> tuple[ProposalGrid, int]:
        s, grid = self.settings, self._grid(rng)
        per_segment = SEGMENT * FEATURES
        rows = -(-(s.proposal_cells**3) // per_segment) * SEGMENT
        table = np.concatenate([grid.table, np.zeros((rows, FEATURES), np.float32)])
        return ProposalGrid(*grid[:-1], table, s.proposal_cells, self._sampling()), FEATURES * s.levels

    def _tiny(self) -> NerfactoSettings:
        return msgspec.structs.replace(super()._tiny(), proposal_cells=8)

    def _forget_parameters(self) -> None:
        super()._forget_parameters()
        s, chunks, workers = self.settings, len(self._batch.samples), self.pool.threads
        most = CHUNK_RAYS * s.bins
        self._bins = ProposalBins(
            cell=np.zeros((chunks, most), np.int32),
            grad=np.zeros((chunks, most), np.float32),
            counts=np.zeros(chunks, np.int64),
            depth=np.zeros((workers, most), np.float32),
            weight=np.zeros((workers, most), np.float32),
            group=np.zeros((workers, most), np.int32),
            first=np.zeros((workers, CHUNK_RAYS + 1), np.int64),
            slope=np.zeros((workers, 2, s.bins), np.float32),
        )

    def _grow(self) -> None:
        self._encoding = self._encoding._replace(sampling=self._sampling())

    def _sampling(self) -> ProposalSampling:
        """Settings of the sampling at this step."""
        s = self.settings
        ramp = min(self.step / s.samples_ramp, 1.0)
        fresh = max(1.0 - self.step / s.anneal, 0.0)
        even = s.even + (1.0 - s.even) * fresh if s.interlevel > 0 else 1.0
        return ProposalSampling(
            bins=s.bins,
            samples=round(s.samples_start + ramp * (s.samples - s.samples_start)),
            uniform_share=np.float32(even),
            interlevel=np.float32(s.interlevel),
            decay=np.float32(s.proposal_decay),
        )

    def _gather(self, levels: int) -> None:
        super()._gather(levels)
        bins = self._bins
        self.pool.run(scatter_proposal, self._encoding, bins.cell, bins.grad, bins.counts, self._table_g, self._dirty)


make = NerfactoField
