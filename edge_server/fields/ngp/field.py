"""Instant-NGP style radiance field on CPUs: hash grid, small network, numba kernels (thesis 3.1, 4.4.4).

``trained_field`` does the common part; this file adds the hash grid.
"""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import numpy as np

from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT, scatter
from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.model_layout import init_net, make_grid
from edge_server.fields.common.trained_field import DIRTY, TINY, TrainedField
from edge_server.fields.common.training_schedule import active_levels
from edge_server.fields.ngp.settings import STATE_SHAPE, NgpSettings

assert SEGMENT * FEATURES == DIRTY, "scatter and adam must use the same segments"


class NgpField(TrainedField):
    """A multiresolution hash grid and a small network. See ``fields.Field`` for the protocol."""

    Settings: ClassVar[type] = NgpSettings
    shape: ClassVar[tuple[str, ...]] = STATE_SHAPE

    def _make(self, rng: np.random.Generator) -> tuple[Any, Net]:
        inputs = FEATURES * self.settings.levels
        return make_grid(self.settings, self.view_store.box, rng), init_net(inputs, self.settings, rng)

    def _tiny(self) -> Any:
        return msgspec.structs.replace(self.settings, **TINY, log2_table=10)

    def _levels(self) -> int:
        return active_levels(self.settings, self.step)

    def _gather(self, levels: int) -> None:
        batch, to = self._batch, (self._table_g, self._dirty)
        self.pool.run(scatter, self._encoding, levels, batch.x, batch.d_features, batch.columns, *to)


make = NgpField
