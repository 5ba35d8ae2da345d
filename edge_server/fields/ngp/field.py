"""Instant-NGP style radiance field on CPUs: hash grid, small network, numba kernels (thesis 3.1, 4.4.4).

``trained_field`` does the common part; this file adds the hash grid (Mueller et al. 2022).
"""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import numpy as np

from edge_server.fields.common.kernels.hash_grid import FEATURES, SEGMENT, Grid, scatter
from edge_server.fields.common.trained_field import DIRTY, TINY, TrainedField
from edge_server.fields.field_constants import NGP_FINEST, NGP_FINEST_AT_FIRST, NGP_FIRST_TABLE
from edge_server.fields.ngp.settings import NgpSettings

assert SEGMENT * FEATURES == DIRTY, "scatter and adam must use the same segments"


class NgpField(TrainedField):
    """A multiresolution hash grid and a small network. See ``fields.Field`` for the protocol."""

    Settings: ClassVar[type] = NgpSettings
    shape = (*TrainedField.shape, "levels", "log2_table", "base_resolution", "finest_resolution")

    def _make(self, rng: np.random.Generator) -> tuple[Any, int]:
        return self._grid(rng), FEATURES * self.settings.levels

    def _grid(self, rng: np.random.Generator) -> Grid:
        """Levels growing geometrically from base to finest resolution, as set or about one cell a pixel: finer ones
        would only learn noise. Tables near zero."""
        s, box, finest = self.settings, self.view_store.box, self.settings.finest_resolution
        if finest is None:
            pixels = box.pixels_across if box is not None else float(NGP_FINEST_AT_FIRST)
            finest = int(np.clip(pixels, s.base_resolution, NGP_FINEST))
        share = np.arange(s.levels) / max(s.levels - 1, 1)
        resolution = np.round(s.base_resolution * (finest / s.base_resolution) ** share).astype(np.int32)
        most = 1 << s.log2_table
        vertices = (resolution.astype(np.int64) + 1) ** 3
        dense = vertices <= most
        sizes = np.where(dense, (vertices + SEGMENT - 1) // SEGMENT * SEGMENT, most)
        first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        table = rng.uniform(-NGP_FIRST_TABLE, NGP_FIRST_TABLE, size=(int(first[-1]), FEATURES)).astype(np.float32)
        return Grid(resolution, first, dense, table)

    def _tiny(self) -> Any:
        return msgspec.structs.replace(self.settings, **TINY, log2_table=10)

    def _levels(self) -> int:
        return min(self.settings.levels, self.settings.levels_start + self.step // self.settings.levels_every)

    def _gather(self, levels: int) -> None:
        batch, to = self._batch, (self._table_g, self._dirty)
        self.pool.run(scatter, self._encoding, levels, batch.x, batch.d_features, batch.columns, *to)


make = NgpField
