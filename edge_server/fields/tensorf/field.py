"""Vector-matrix factors on CPUs (TensoRF; Chen et al. 2022): planes, lines, small network, numba kernels.

``trained_field`` does the common part. This file adds density without a network, and planes and lines that
get finer during training (section 4.4 of the paper).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.trained_field import DIRTY, TrainedField
from edge_server.fields.field_constants import FIRST_DENSITY, TENSORF_FINEST
from edge_server.fields.tensorf.kernels.vector_matrix import CHANNELS, MODES, ROWS, Planes, scatter_planes
from edge_server.fields.tensorf.settings import TensorfSettings

assert ROWS * CHANNELS == DIRTY, "scatter_planes and adam must use the same segments"


class TensorfField(TrainedField):
    """Planes, lines and a small network for color. See ``fields.Field`` for the protocol."""

    Settings = TensorfSettings
    shape = (*TrainedField.shape, "density_rank", "color_rank", "resolution_start", "resolution", "upsample")
    settings: TensorfSettings

    def _make(self, rng: np.random.Generator) -> tuple[Planes, int]:
        s = self.settings
        size = size_at(s, self.view_store.box, 0)
        density, color = MODES * s.density_rank // CHANNELS, MODES * s.color_rank // CHANNELS
        rows = _rows(size)
        table = np.zeros((density + color, rows, CHANNELS), np.float32)
        table[:, : size * (size + 1)] = rng.normal(0.0, s.first, (density + color, size * (size + 1), CHANNELS))
        planes = Planes(
            size, density, density + color, rows, np.float32(np.log(FIRST_DENSITY)), table.reshape(-1, CHANNELS)
        )
        return planes, CHANNELS * color

    def _feature_rows(self) -> int:
        return int(self._net.widths[0]) + 1  # and one for density

    def _grow(self) -> None:
        size = size_at(self.settings, self.view_store.box, self.step)
        planes: Planes = self._encoding
        if size == planes.size:
            return
        old = (planes.table, self._table_m, self._table_v)
        tables = [upsample_table(table, planes.groups, planes.size, size) for table in old]
        self._encoding = planes._replace(size=size, rows=_rows(size), table=tables[0])
        self._take_table(tables[0])
        self._table_m, self._table_v = tables[1:]

    def _gather(self, levels: int) -> None:
        batch, planes = self._batch, self._encoding
        self.pool.run(scatter_planes, planes, batch.x, batch.d_features, batch.columns, self._table_g, self._dirty)


def size_at(settings: TensorfSettings, box: SceneBox | None, step: int) -> int:
    """Vertices a side at a step, growing geometrically."""
    first, last = settings.resolution_start, settings.resolution
    if last is None:
        last = int(np.clip(box.pixels_across if box is not None else first, first, max(TENSORF_FINEST, first)))
    done = sum(step >= at for at in settings.upsample)
    stages = max(len(settings.upsample), 1)
    return round(first * (last / first) ** (done / stages)) if settings.upsample else last


def upsample_table(table: NDArray[np.float32], groups: int, size: int, new: int) -> NDArray[np.float32]:
    """The table of a ``Planes`` of ``size`` vertices a side, interpolated to ``new`` vertices a side."""
    old = table.reshape(groups, -1, CHANNELS)
    planes = old[:, : size * size].reshape(groups, size, size, CHANNELS)
    lines = old[:, size * size : size * (size + 1)]
    at = np.arange(new) * ((size - 1) / (new - 1))
    low = np.minimum(at.astype(np.int64), size - 2)
    share = (at - low).astype(np.float32)

    def between(values: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
        weight = share.reshape(-1, *[1] * (values.ndim - 1 - axis))
        a, b = np.take(values, low, axis), np.take(values, low + 1, axis)
        mixed: NDArray[np.float32] = a * (1 - weight) + b * weight
        return mixed

    out = np.zeros((groups, _rows(new), CHANNELS), np.float32)
    out[:, : new * new] = between(between(planes, 1), 2).reshape(groups, new * new, CHANNELS)
    out[:, new * new : new * (new + 1)] = between(lines, 1)
    return out.reshape(-1, CHANNELS)


def _rows(size: int) -> int:
    """Rows of a group, rounded up so that no segment belongs to two groups."""
    return -(-size * (size + 1) // ROWS) * ROWS


make = TensorfField
