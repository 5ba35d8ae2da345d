"""An occupancy grid: which cells of space get samples, by the field's density and the cameras' views."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.kernels.occupancy import CELLS_A_TASK, count_views, sample_density, threshold
from edge_server.fields.common.kernels.rays import COARSE, Space
from edge_server.fields.common.kernels.train import CHUNK
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.supervision import pack_cameras
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.view_store import ViewStore

EVERY = 8  # steps between refreshes
PHASES = 4  # refreshes until every cell has been sampled
FADE = 0.75  # share of a cell's density that is left at each sample
EMPTY = 0.5  # density per scene unit that counts as empty: a step of it dims by a hundredth or two


class OccupancyGrid:
    """The grid's arrays, each of cells^3 elements, x fastest.

    density: float32, per scene unit. seen: uint16, how many cameras see each cell. occupied: uint8, whether
    it gets samples; coarse: the same of blocks of COARSE^3 cells. needed: cameras that must see a cell.
    """

    def __init__(self, cells: int, min_views: int, box: SceneBox | None) -> None:
        """A grid that knows nothing yet of the scene in ``box``: the first sample of a cell decides."""
        self.cells, self.min_views = cells, min_views
        self.contracted, self.near = (box.contracted, box.near_m / box.radius_m) if box else (False, 0.1)
        self.density = np.full(cells**3, EMPTY, np.float32)
        self.seen = np.zeros(cells**3, np.uint16)
        self.occupied = np.zeros(cells**3, np.uint8)
        self.coarse = np.zeros((cells // COARSE) ** 3, np.uint8)
        self.needed = 1

    def space(self, step: float) -> Space:
        """The grid as kernels read it, without copies."""
        return Space(
            self.occupied,
            self.coarse,
            self.density,
            self.cells,
            self.contracted,
            np.float32(step),
            np.float32(self.near),
        )

    def recount_views(self, pool: Pool, store: ViewStore) -> None:
        """Count anew which cells the known cameras see, and occupy those where something moved.

        Something moved where most cameras that see a cell see it change: the visual hull of the changed
        pixels. Otherwise a moving body could not appear where space was known to be empty.
        """
        assert store.box is not None
        views = pack_cameras(store.views, store.box)
        masks = [m.moved for m in store.memory.values()]
        mask_first = np.full(len(masks), -1, np.int64)
        parts, length = [np.zeros(0, np.uint8)], 0
        for k, mask in enumerate(masks):
            if mask is not None:
                mask_first[k] = length
                parts.append(mask.reshape(-1).astype(np.uint8))
                length += mask.size
        marked = np.zeros_like(self.seen)
        pool.run(
            count_views,
            self.cells,
            self.contracted,
            self.near,
            views,
            mask_first,
            np.concatenate(parts),
            self.seen,
            marked,
        )
        self.needed = min(self.min_views, len(store.memory))
        if length:
            moving = (marked >= max(self.needed, 1)) & (2 * marked >= self.seen)
            np.maximum(self.density, np.float32(1.5 * EMPTY), out=self.density, where=moving)
        self.update_occupied()

    def refresh(
        self,
        pool: Pool,
        key: np.uint64,
        phase: int,
        encoding: Any,
        levels: int,
        net: Net,
        acts: NDArray[np.float32],
        x: NDArray[np.float32],
    ) -> None:
        """Sample the density of every ``PHASES``-th cell, from cell ``phase`` on."""
        pool.run(
            sample_density,
            key,
            phase % PHASES,
            PHASES,
            np.float32(FADE),
            encoding,
            levels,
            net,
            self.cells,
            self.contracted,
            self.seen,
            self.needed,
            self.density,
            acts,
            x,
        )
        self.update_occupied()

    def update_occupied(self) -> None:
        """Give samples to the cells with a density of ``EMPTY`` or more."""
        threshold(self.density, self.seen, self.needed, EMPTY, self.cells, self.occupied, self.coarse)


assert CELLS_A_TASK <= CHUNK, "a task's samples must fit the scratch of a training chunk"
