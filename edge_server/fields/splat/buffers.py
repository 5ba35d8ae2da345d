"""What the kernels of the Gaussian field work on: cameras as rows, and buffers that grow with the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import SIZE
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.kernels.bin_tiles import TileLists, bin_tiles
from edge_server.fields.splat.kernels.composite import PIXELS, SAVED, STRIPS, SUMS
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, OptimizerState, adam_step
from edge_server.fields.splat.kernels.project import BLOCK, FOOTPRINT, PROJECTED, TILE, Gaussians, project
from edge_server.fields.splat.kernels.rasterize import LOSSES, MOMENTS, ROWS, Raster, Targets, train_tiles
from edge_server.fields.splat.splat_constants import MAX_PAIRS


class RasterBuffers:
    """Projected Gaussians and tile lists of several cameras, and the memory in which workers rasterize."""

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self.projected = np.zeros((0, 0, PROJECTED), np.float32)
        self.tiles = np.zeros((0, 0, FOOTPRINT), np.int32)
        self.memory = np.zeros((pool.threads, ROWS * PIXELS), np.float32)
        self.saved = np.zeros((pool.threads, SAVED), np.float32)
        self.sums = np.zeros((0, 0, SUMS), np.float32)
        self.columns = self.rows = np.zeros(0, np.int64)
        self._lists: TileLists | None = None

    @property
    def lists(self) -> TileLists:
        """The tile lists of the last ``project_and_bin``."""
        assert self._lists is not None
        return self._lists

    @property
    def first(self) -> Raster:
        """What the kernels read of the first camera."""
        return Raster(int(self.columns[0]), int(self.rows[0]), self.projected, self.lists, self.memory, self.saved)

    def project_and_bin(self, cams: NDArray[np.float32], gaussians: Gaussians, differentiate: bool = True) -> None:
        """Project the Gaussians into the cameras, and list them by tile.

        cams: float32 (B, CAMERA), see ``camera_rows``.
        differentiate: whether to make room for gradients.
        """
        count, slots = len(gaussians.params), len(cams)
        sizes = cams[:, SIZE : SIZE + 2].astype(np.int64)
        self.columns, self.rows = (-(-sizes[:, k] // TILE) for k in (0, 1))
        tiles = int((self.columns * self.rows).max())
        self._allocate(slots, count, tiles)
        self.pool.run(project, cams, gaussians, count, self.projected, self.tiles)
        self._bin(count)
        pairs = min(int(self.lists.needed[:slots].max(initial=0)), MAX_PAIRS)
        if pairs > self.lists.pair.shape[1]:
            room = min(pairs + pairs // 4, MAX_PAIRS)
            self._lists = self.lists._replace(
                pair=np.zeros((self.lists.pair.shape[0], room), np.int32),
                owner=np.zeros((self.lists.pair.shape[0], room), np.int32),
                binned=np.zeros((self.pool.threads, 2, room), np.int32),
            )
            self._bin(count)
        longest = max(int(self.lists.longest[:slots].max(initial=0)), 1)
        length = longest * STRIPS * SAVED if differentiate else SAVED
        if self.saved.shape[1] < length:
            self.saved = np.zeros((self.pool.threads, length + length // 4), np.float32)
        if differentiate and self.sums.shape[:2] != self.lists.pair.shape:
            self.sums = np.zeros((*self.lists.pair.shape, SUMS), np.float32)

    def train(self, targets: Targets, view: int) -> NDArray[np.float64]:
        """Compare the first camera of the last ``project_and_bin`` with image ``view`` of the targets, and write the
        gradients of its pairs to ``sums``. Returns ``losses``, see ``train_tiles``."""
        width = LOSSES + (3 * MOMENTS if len(targets.exposure) else 0)
        losses = np.zeros((int(self.columns[0] * self.rows[0]), width))
        self.pool.run(train_tiles, self.first, targets, view, self.sums, losses)
        return losses

    def step(
        self,
        cams: NDArray[np.float32],
        gaussians: Gaussians,
        moments: OptimizerState,
        rule: AdamParameters,
        rigid: NDArray[np.float64] | None = None,
    ) -> int:
        """An optimizer step from the gradients in ``sums``: changes the Gaussians and their moments. Returns how many
        gradients were not finite.

        cams: as given to the last ``project_and_bin``.
        rigid: float64 (6,), written: force and torque, see ``adam_step``.
        """
        count = len(gaussians.params)
        blocks = -(-count // BLOCK) + 1
        dropped, by_block = np.zeros(blocks, np.int64), np.zeros((0 if rigid is None else blocks, 6))
        mine = self.projected, self.lists, self.sums
        self.pool.run(adam_step, cams, gaussians, count, *mine, moments, rule, dropped, by_block)
        if rigid is not None:
            rigid[:] = by_block.sum(axis=0)
        return int(dropped.sum())

    def _bin(self, count: int) -> None:
        bands = max(self.pool.threads // len(self.columns), 1)
        self.pool.run(bin_tiles, self.columns, self.rows, bands, count, self.tiles, self.lists)

    def _allocate(self, slots: int, count: int, tiles: int) -> None:
        if (
            self._lists is not None
            and self.projected.shape[0] >= slots
            and self.projected.shape[1] >= count
            and self._lists.first.shape[1] > tiles
        ):
            return
        threads = self.pool.threads
        slots, room = max(slots, self.projected.shape[0]), max(count, self.projected.shape[1])
        tiles = max(tiles, 0 if self._lists is None else self._lists.first.shape[1] - 1)
        pairs = max(4 * room, 1024, 0 if self._lists is None else self._lists.pair.shape[1])
        self.projected = np.zeros((slots, room, PROJECTED), np.float32)
        self.tiles = np.zeros((slots, room, FOOTPRINT), np.int32)
        self._lists = TileLists(
            first=np.zeros((slots, tiles + 1), np.int32),
            pair=np.zeros((slots, pairs), np.int32),
            owner=np.zeros((slots, pairs), np.int32),
            own_first=np.zeros((slots, room), np.int32),
            own_count=np.zeros((slots, room), np.int32),
            needed=np.zeros(slots, np.int64),
            longest=np.zeros((slots, threads), np.int64),
            keys=np.zeros((threads, 2, room + 1), np.uint32),
            order=np.zeros((threads, 2, room + 1), np.int32),
            begins=np.zeros((threads, room), np.int32),
            binned=np.zeros((threads, 2, pairs), np.int32),
        )

    def reaching(self, b: int, count: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the first ``count`` Gaussians, bool (N,), reach a tile of camera b that has pixels of ``mask``."""
        h, w = mask.shape
        within = np.zeros((self.rows[b] * TILE + 1, self.columns[b] * TILE + 1), np.int64)
        within[1 : h + 1, 1 : w + 1] = mask
        within = within.cumsum(axis=0).cumsum(axis=1)[::TILE, ::TILE]
        x0, x1, y0, y1 = self.tiles[b, :count, :4].T
        pixels = within[y1, x1] - within[y0, x1] - within[y1, x0] + within[y0, x0]
        return (pixels > 0) & (self.lists.own_count[b, :count] > 0)
