"""Instant-NGP style radiance field on CPUs: hash grid, small network, numba kernels (thesis 3.1, 4.4.4).

``trained_field`` does the common part; this file adds the hash grid.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_server.fields import Field
from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT, Grid, scatter, smooth_grid
from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.model_layout import init_net, make_grid
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.trained_field import DIRTY, TINY, TrainedField
from edge_server.fields.common.training_schedule import active_levels, smoothing
from edge_server.fields.ngp.settings import STATE_SHAPE, NgpSettings

assert SEGMENT * FEATURES == DIRTY, "scatter and adam must use the same segments"


class NgpField(TrainedField):
    """A multiresolution hash grid and a small network. See ``fields.Field`` for the protocol."""

    name = NgpSettings.name
    shape = STATE_SHAPE
    settings: NgpSettings

    def __init__(self, settings: NgpSettings | None = None, pool: Pool | None = None) -> None:
        super().__init__(settings or NgpSettings(), pool)

    @property
    def _grid(self) -> Grid:
        grid: Grid = self._encoding
        return grid

    def _make(self, rng: np.random.Generator) -> tuple[Grid, Net]:
        return make_grid(self.settings, self.view_store.box, rng), init_net(
            FEATURES * self.settings.levels, self.settings, rng
        )

    def _tiny(self) -> NgpSettings:
        return replace(self.settings, **TINY, log2_table=10)

    def _levels(self) -> int:
        return active_levels(self.settings, self.step)

    def _gather(self, levels: int, scale: float) -> None:
        batch = self._batch
        self.pool.run(scatter, self._grid, levels, batch.x, batch.d_features, batch.columns, self._table_g, self._dirty)
        if weight := smoothing(self.settings, self.step):
            self.pool.run(smooth_grid, self._grid, levels, np.float32(weight / scale), self._table_g, self._dirty)


def make(settings: NgpSettings) -> Field:
    """A field on the CPU, or with ``device: cuda`` on the GPU. Raises ValueError for ``cuda`` if torch finds
    no such device, or for an option that only the CPU kernels implement."""
    if settings.device == "cuda":
        from edge_server.fields.ngp.torch_field import NgpTorchField  # torch is imported only here

        return NgpTorchField(settings, "cuda")
    return NgpField(settings)
