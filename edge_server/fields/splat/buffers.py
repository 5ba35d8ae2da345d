"""Working memory of the Gaussian field's kernels: buffers that grow with the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import SIZE
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.kernels.bin_tiles import TileLists, bin_tiles
from edge_server.fields.splat.kernels.composite import PIXELS, SAVED, STRIPS, SUMS
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, OptimizerState, adam_step
from edge_server.fields.splat.kernels.project import BLOCK, FOOTPRINT, PROJECTED, TILE, project
from edge_server.fields.splat.kernels.rasterize import LOSSES, MOMENTS, ROWS, Raster, Target, train_tiles
from edge_server.fields.splat.splat_constants import MAX_PAIRS


class RasterBuffers:
    """Projected Gaussians and tile lists of one camera, and the memory in which workers rasterize."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.projected = np.zeros((0, PROJECTED), np.float32)
        self.tiles = np.zeros((0, FOOTPRINT), np.int32)
        self.memory = np.zeros((pool.threads, ROWS * PIXELS), np.float32)
        self.saved = np.zeros((pool.threads, SAVED), np.float32)
        self.sums = np.zeros((0, SUMS), np.float32)
        self.columns = self.rows = 0
        self._lists: TileLists | None = None

    @property
    def lists(self) -> TileLists:
        """The tile lists of the last ``project_and_bin``."""
        assert self._lists is not None
        return self._lists

    @property
    def raster(self) -> Raster:
        """The kernels' input from the last ``project_and_bin``."""
        return Raster(self.columns, self.rows, self.projected, self.lists, self.memory, self.saved)

    def project_and_bin(
        self, camera: NDArray[np.float32], params: NDArray[np.float32], differentiate: bool = True
    ) -> None:
        """Project Gaussians into a camera, and list them by tile.

        camera: float32 (1, CAMERA), see ``camera_rows``. params: float32 (N, P), see ``kernels.project``.
        differentiate: whether to make room for gradients.
        """
        count = len(params)
        self.columns, self.rows = (-(-int(size) // TILE) for size in camera[0, SIZE : SIZE + 2])
        self._allocate(count, self.columns * self.rows)
        self.pool.run(project, camera, params, count, self.projected, self.tiles)
        self._bin(count)
        pairs = min(int(self.lists.needed[0]), MAX_PAIRS)
        if pairs > self.lists.pair.size:
            room = min(pairs + pairs // 4, MAX_PAIRS)
            self._lists = self.lists._replace(
                pair=np.zeros(room, np.int32),
                owner=np.zeros(room, np.int32),
                binned=np.zeros((self.pool.threads, 2, room), np.int32),
            )
            self._bin(count)
        length = max(int(self.lists.longest.max()), 1) * STRIPS * SAVED if differentiate else SAVED
        if self.saved.shape[1] < length:
            self.saved = np.zeros((self.pool.threads, length + length // 4), np.float32)
        if differentiate and len(self.sums) != self.lists.pair.size:
            self.sums = np.zeros((self.lists.pair.size, SUMS), np.float32)

    def train(self, target: Target) -> NDArray[np.float64]:
        """Compare the camera of the last ``project_and_bin`` with an image, and write the gradients of its pairs to
        ``sums``. Returns ``losses``, see ``train_tiles``."""
        losses = np.zeros((self.columns * self.rows, LOSSES + (3 * MOMENTS if target.exposure.size else 0)))
        self.pool.run(train_tiles, self.raster, target, self.sums, losses)
        return losses

    def step(
        self,
        camera: NDArray[np.float32],
        params: NDArray[np.float32],
        moments: OptimizerState,
        rule: AdamParameters,
        rigid: NDArray[np.float64] | None = None,
    ) -> int:
        """An optimizer step from the gradients in ``sums``: changes the parameters and their moments. Returns the
        number of gradients that were not finite.

        camera: as given to the last ``project_and_bin``.
        rigid: float64 (6,), written: force and torque, see ``adam_step``.
        """
        count = len(params)
        blocks = -(-count // BLOCK) + 1
        dropped, by_block = np.zeros(blocks, np.int64), np.zeros((0 if rigid is None else blocks, 6))
        mine = self.projected, self.lists, self.sums
        self.pool.run(adam_step, camera, params, count, *mine, moments, rule, dropped, by_block)
        if rigid is not None:
            rigid[:] = by_block.sum(axis=0)
        return int(dropped.sum())

    def _bin(self, count: int) -> None:
        self.pool.run(bin_tiles, self.columns, self.rows, count, self.tiles, self.lists)

    def _allocate(self, count: int, tiles: int) -> None:
        known, threads = self._lists, self.pool.threads
        if known is not None and len(self.projected) >= count and known.first.size > tiles:
            return
        room = max(count, len(self.projected))
        tiles = max(tiles, 0 if known is None else known.first.size - 1)
        pairs = max(4 * room, 1024, 0 if known is None else known.pair.size)
        self.projected = np.zeros((room, PROJECTED), np.float32)
        self.tiles = np.zeros((room, FOOTPRINT), np.int32)
        self._lists = TileLists(
            first=np.zeros(tiles + 1, np.int32),
            pair=np.zeros(pairs, np.int32),
            owner=np.zeros(pairs, np.int32),
            own_first=np.zeros(room, np.int32),
            own_count=np.zeros(room, np.int32),
            needed=np.zeros(1, np.int64),
            longest=np.zeros(threads, np.int64),
            keys=np.zeros((threads, 2, room + 1), np.uint32),
            order=np.zeros((threads, 2, room + 1), np.int32),
            begins=np.zeros((threads, room), np.int32),
            binned=np.zeros((threads, 2, pairs), np.int32),
        )

    def reaching(self, count: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the first ``count`` Gaussians, bool (N,), reach a tile that has pixels of ``mask``."""
        h, w = mask.shape
        within = np.zeros((self.rows * TILE + 1, self.columns * TILE + 1), np.int64)
        within[1 : h + 1, 1 : w + 1] = mask
        within = within.cumsum(axis=0).cumsum(axis=1)[::TILE, ::TILE]
        x0, x1, y0, y1 = self.tiles[:count, :4].T
        pixels = within[y1, x1] - within[y0, x1] - within[y1, x0] + within[y0, x0]
        return (pixels > 0) & (self.lists.own_count[:count] > 0)
