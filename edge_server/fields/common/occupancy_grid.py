"""An occupancy grid: which cells of space get samples, by the field's density and the cameras' views."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import field_constants as tuned
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.kernels.occupancy import CELLS_A_TASK, Cells, sample_density, threshold
from edge_server.fields.common.kernels.rays import COARSE, Space
from edge_server.fields.common.kernels.train import CHUNK
from edge_server.fields.common.kernels.visual_hull import count_points
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.view_store import ViewStore


def cell_centers(cells: int, contracted: bool) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Centers (N, 3) of all cells in scene units, contraction undone, and how much longer steps are there, (N,)."""
    half = 2.0 if contracted else 1.0
    side = (np.arange(cells) + 0.5) * (2.0 * half / cells) - half
    z, y, x = np.meshgrid(side, side, side, indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    far = np.maximum(np.abs(points).max(axis=1), 1.0)  # 1 where nothing is contracted
    spread = 1.0 / (2.0 - far)
    return (points * (spread / far)[:, None]).astype(np.float32), (spread**2).astype(np.float32)


class OccupancyGrid:
    """The grid's arrays, each of cells^3 elements, x fastest.

    density: float32, per scene unit. seen: uint16, how many cameras see each cell. occupied: uint8, whether
    it gets samples; coarse: the same of blocks of COARSE^3 cells. needed: cameras that must see a cell.
    """

    def __init__(self, cells: int, min_views: int, box: SceneBox | None) -> None:
        """A grid that knows nothing yet of the scene in ``box``: the first sample of a cell decides."""
        self.cells, self.min_views = cells, min_views
        self.contracted, self.near = (box.contracted, box.near_m / box.radius_m) if box else (False, 0.1)
        self.density = np.full(cells**3, tuned.EMPTY_DENSITY, np.float32)
        self.seen = np.zeros(cells**3, np.uint16)
        self.occupied = np.zeros(cells**3, np.uint8)
        self.coarse = np.zeros((cells // COARSE) ** 3, np.uint8)
        self.needed = 1
        self._centers, self._stretch = cell_centers(cells, self.contracted)

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
        rows = camera_rows([v.camera_to_world for v in store.views], [v.intrinsics for v in store.views], store.box)
        seen, marked = (np.zeros(self.seen.size, np.int32) for _ in range(2))
        for row, m in zip(rows, store.memory.values()):
            mask = np.zeros(m.view.image.shape[:2], np.uint8) if m.moved is None else m.moved.astype(np.uint8)
            pool.run(count_points, row[None], self._centers, mask, seen, marked)
        self.seen[:] = seen
        # Of cameras that see nothing in common, one is enough.
        self.needed = min(self.min_views, len(store.memory), max(int(seen.max()), 1))
        moving = (marked >= max(self.needed, 1)) & (2 * marked >= seen)
        np.maximum(self.density, np.float32(tuned.MOVING_DENSITY * tuned.EMPTY_DENSITY), out=self.density, where=moving)
        self.update_occupied()

    def refresh(self, pool: Pool, key: np.uint64, phase: int, model: tuple[Any, int, Net], acts: Any, x: Any) -> None:
        """Sample the density of every ``OCCUPANCY_PHASES``-th cell, from cell ``phase`` on. model: encoding, levels and
        network. acts, x: see ``sample_density``."""
        phases, fade = tuned.OCCUPANCY_PHASES, np.float32(tuned.OCCUPANCY_FADE)
        pool.run(sample_density, key, phase % phases, phases, fade, *model, self._cells(), acts, x)
        self.update_occupied()

    def _cells(self) -> Cells:
        return Cells(self.cells, self.seen, self.needed, self._stretch, self.density)

    def update_occupied(self) -> None:
        """Give samples to the cells with a density of ``EMPTY_DENSITY`` or more."""
        threshold(self._cells(), tuned.EMPTY_DENSITY, self.occupied, self.coarse)


assert CELLS_A_TASK <= CHUNK, "a task's samples must fit the scratch of a training chunk"
