"""Explicit voxels on CPUs, for the shortest update: density and color in a grid, no network (as Plenoxels,
Fridovich-Keil et al. 2022, without harmonics; thesis 3.20-3.22).

A step draws, renders and differentiates rays in one pass (``kernels.rays``), in a fixed number of parts with
a gradient buffer each. Adam sums the buffers and updates what received a gradient (``kernels.update``). The
grid gets finer during training; rays skip empty cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, View
from edge_server.fields.common.field_state import load_arrays
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.kernels.train import RaySampling
from edge_server.fields.common.occupancy_grid import EMPTY, OccupancyGrid
from edge_server.fields.common.scene_box import PLAIN, UNIT_BOX
from edge_server.fields.common.stepped_field import Step, SteppedField
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.training_schedule import StepBudget, StepTimer, step_key
from edge_server.fields.common.view_store import Arrays
from edge_server.fields.voxel.kernels.rays import SEGMENT, SkipGrid, Voxels, train_rays
from edge_server.fields.voxel.kernels.update import (
    MAX_DENSITY,
    TASK_FLAGS,
    AdamRule,
    DiffusionRule,
    adam_constants,
    diffuse,
    distance_transform,
    update_cell_density,
    upsample_grid,
    voxel_adam,
)
from edge_server.fields.voxel.settings import VoxelSettings, sizes_of
from edge_server.fields.voxel.snapshot import VoxelSnapshot, make_ray_scratch

OCCUPANCY_PHASES = 4  # refreshes until every cell has been refreshed
EVERY = 5  # steps between refreshes of the occupancy
DIFFUSE_PHASES = 4  # steps in which all layers diffuse once, so that each step costs the same
FADE = 0.75  # share of a cell's density that is left at each refresh
BETA2 = 0.95  # Adam's memory in steps that touch a vertex: a fit has a hundred of them, not thousands
WARM_START_SHARE = 1.5  # of the steps until the last grid size: later fits are warm starts


class VoxelField(SteppedField[VoxelSnapshot]):
    """A grid that learns while it is used. See ``SteppedField``."""

    name = "voxel"
    shape = ("sizes", "refine_at", "cells")
    settings: VoxelSettings

    def __init__(self, settings: VoxelSettings | None = None, pool: Pool | None = None) -> None:
        super().__init__(settings or VoxelSettings(), pool)

    # --- the protocol -------------------------------------------------------------------------

    def _begin_fit(self, views: Sequence[View], step_budget: StepBudget, budget: Budget) -> tuple[Step, int, int]:
        s = self.settings
        with self._lock:
            update = self.view_store.add(views)
            if update.box_changed:
                self._forget_parameters()
            if update.visibility_changed:
                moving = self._occupancy.recount_views(self.pool, self.view_store, self._prune_density())
                if update.has_new_images:
                    self._soften(moving)
                self._update_clearance()
            data = self.view_store.without_outliers(views, update, self.step, self._live())
            data = self._with_outline_alpha(data)
            # A fine grid knows most of what a fit meets: full rates would undo it.
            share = s.warm if self.step >= WARM_START_SHARE * max(s.refine_at, default=s.prune_from) else 1.0
            # Steps at full rates: repeated passes over the same pixels overfit.
            full = s.settle * (len(data.drawn) or len(data.pixels)) / s.rays or np.inf
            # The prior weakens with the number of viewpoints; a camera that stands still adds none.
            places = len(np.unique(data.origin, axis=0))
            diffuse_by = s.diffuse * min(s.diffuse_views / max(places, 1), 1.0)

        def one_step(progress: float) -> tuple[float, int, int, int]:
            decay = s.rate_end**progress * min(full / max(step_budget.steps, 1), 1.0)
            loss = self._one_step(data, share * decay, diffuse_by)
            dropped = int(self._bad_rays.sum() + self._bad_gradients.sum())
            return loss, s.rays, int(self._samples.sum()), dropped

        return one_step, 0, 0

    def _live(self) -> VoxelSnapshot:
        return VoxelSnapshot(
            box=self.view_store.box or UNIT_BOX,
            voxels=self._voxels,
            space=self._skip_grid(),
            background=self.view_store.background(),
            cameras=self.view_store.views,
            pool=self.pool,
            step=self.step,
        )

    def _tiny(self) -> VoxelSettings:
        return replace(self.settings, rays=64, cells=16, sizes=(8, 12), refine_at=(1,), prune_from=0)

    # --- state --------------------------------------------------------------------------------

    def _counters(self) -> dict[str, Any]:
        return {"step": self.step, "updates": self._updates, "dropped": self.dropped, "needed": self._occupancy.needed}

    def _load(self, meta: dict[str, Any], state: Arrays) -> None:
        self._updates = int(meta["updates"])
        self._grow(max(self.step - 1, 0))
        load_arrays(self._arrays(), state)
        self._occupancy.needed = int(meta["needed"])
        self._update_clearance()

    def _arrays(self) -> Arrays:
        return {
            "table": self._voxels.table,
            "table_v": self._second_moment,
            "density": self._occupancy.density,
            "seen": self._occupancy.seen,
            "occupied": self._occupancy.occupied,
        }

    # --- inside -------------------------------------------------------------------------------

    def _forget_parameters(self) -> None:
        self.step = 0
        self._snapshot = None
        self._outline_views: tuple[Views, Views] | None = None  # of the last views: without and with alpha
        self._updates = 0  # optimizer steps that Adam's bias correction counts
        self._step_time = StepTimer()
        s = self.settings
        self._sizes = sizes_of(s, self.view_store.box)
        table = _empty_grid(self._sizes[0])
        table[:] = (s.first, 0.5, 0.5, 0.5)
        self._set_grid(self._sizes[0], table)
        self._occupancy = OccupancyGrid.for_box(s.cells, s.min_views, self.view_store.box, unknown=2.0 * EMPTY)
        self._clearance = np.zeros(s.cells**3, np.uint8)
        self._ray_scratch = make_ray_scratch(self.pool.threads)
        self._samples, self._bad_rays = np.zeros(s.parts, np.int64), np.zeros(s.parts, np.int64)
        self._loss = np.zeros(s.parts)

    def _set_grid(self, size: int, table: NDArray[np.float32]) -> None:
        self._voxels, self._second_moment = Voxels(size, table), np.zeros_like(table)
        self._gradient = np.zeros((self.settings.parts, *table.shape), np.float32)
        self._dirty = np.zeros((self.settings.parts, len(table) // SEGMENT), np.uint8)
        self._bad_gradients = np.zeros(-(-self._dirty.shape[1] // TASK_FLAGS), np.int64)

    def _skip_grid(self) -> SkipGrid:
        """Empty space for rays; shares the field's array."""
        o = self._occupancy
        step, near = np.float32(self._step_length()), np.float32(o.near)
        return SkipGrid(self._clearance, o.cells, o.contracted, step, near)

    def _prune_density(self) -> float:
        """Density in optical depth per scene unit below which a cell is empty."""
        return float(self.settings.prune) / self._step_length()

    def _soften(self, moving: NDArray[np.bool_] | None) -> None:
        """Lower the density in cells where something moved: inside and behind an opaque vertex there is no
        gradient, so old surfaces would stay forever."""
        if moving is None or not moving.any():
            return
        cells, size = self._occupancy.cells, self._voxels.size
        cell = np.minimum(np.arange(size) * cells // (size - 1), cells - 1)
        there = moving.reshape(cells, cells, cells)[np.ix_(cell, cell, cell)]
        density = self._voxels.table[: size**3, 0].reshape(size, size, size)
        np.minimum(density, np.float32(self.settings.soften), out=density, where=there)

    def _update_clearance(self) -> None:
        """Recompute the distances to occupied cells."""
        distance_transform(self._occupancy.occupied, self._occupancy.cells, self._clearance)

    def _step_length(self) -> float:
        """One vertex spacing, in scene units."""
        width = 4.0 if self._occupancy.contracted else 2.0
        return width / (self._voxels.size - 1)

    def _with_outline_alpha(self, data: Views) -> Views:
        """``data`` with an alpha channel that is 0 where a pixel shows the plain background."""
        if self._outline_views is not None and self._outline_views[0] is data:
            return self._outline_views[1]
        s, outlined = self.settings, data
        if (
            s.outline > 0.0
            and s.background == "auto"
            and data.pixels.shape[1] == 3
            and self.view_store.background_is_plain
        ):
            color = np.rint(255.0 * self.view_store.background()).astype(np.int16)
            apart = np.abs(data.pixels.astype(np.int16) - color).max(axis=1)
            alpha = np.where(apart > PLAIN, 255, 0).astype(np.uint8)
            outlined = data._replace(pixels=np.concatenate([data.pixels, alpha[:, None]], axis=1))
        self._outline_views = (data, outlined)
        return outlined

    def _grow(self, step: int) -> None:
        """Upsample the grid to its size at a step."""
        size = self._sizes[sum(step >= at for at in self.settings.refine_at)]
        old = self._voxels.size
        if size == old:
            return
        grid = _empty_grid(size)
        self.pool.run(upsample_grid, self._voxels.table, old, grid, size)
        # Moments restart: a coarse vertex sums the gradients of many fine ones, so its second moment would
        # slow these down.
        self._set_grid(size, grid)

    def _one_step(self, data: Views, decay: float, diffuse_by: float) -> float:
        """One optimizer step; returns its mean squared error.

        decay: share of the full rates. diffuse_by: share of the way to its neighbors' mean that it moves
        in ``DIFFUSE_PHASES`` steps at full rates.
        """
        self._grow(self.step)
        s, length = self.settings, self._step_length()
        key, occupancy, outline = step_key(s.seed, self.step), self._occupancy, np.float32(s.outline)
        if self.step % EVERY == 0 and self.step >= s.prune_from:
            self.pool.run(
                update_cell_density,
                self.step // EVERY % OCCUPANCY_PHASES,
                OCCUPANCY_PHASES,
                np.float32(FADE),
                self._voxels,
                np.float32(1.0 / length),
                occupancy.cells,
                occupancy.seen,
                occupancy.needed,
                occupancy.density,
            )
            occupancy.update_occupied(self._prune_density())
            self._update_clearance()
        recipe = RaySampling(
            key=np.uint64(key + np.uint64(1)),
            chunk_rays=s.rays,
            levels=1,
            harmonics=1,
            changed_share=np.float32(s.changed_share),
            background=self.view_store.background(),
            random_background=s.background == "random",
        )
        self.pool.run(
            train_rays,
            data,
            recipe,
            self._skip_grid(),
            self._voxels,
            s.rays,
            outline,
            self._ray_scratch,
            self._gradient,
            self._dirty,
            self._samples,
            self._bad_rays,
            self._loss,
        )
        if self._bad_rays.any():
            self._repair()
        self._updates += 1
        rule = AdamRule(
            constants=adam_constants(
                (s.rate * decay, s.rate_color * decay), (s.growth, 0.0), (s.l1, 0.0), (MAX_DENSITY, 1.0)
            ),
            beta2=np.float32(BETA2),
            epsilon=np.float32(s.epsilon),
            correct2=np.float32(1.0 / (1.0 - BETA2**self._updates)),
        )
        self.pool.run(
            voxel_adam, self._voxels.table, self._second_moment, self._gradient, self._dirty, rule, self._bad_gradients
        )
        if diffuse_by > 0.0 and self.step >= s.prune_from:
            # Scaled with the rates, to balance the data. Colors reach 1, densities MAX_DENSITY.
            edge = np.array([MAX_DENSITY, 1.0, 1.0, 1.0], np.float32) * np.float32(s.diffuse_edge)
            diffusion = DiffusionRule(edge, np.float32(decay * diffuse_by / 6.0))
            phase = self.step % DIFFUSE_PHASES
            self.pool.run(diffuse, phase, DIFFUSE_PHASES, self._voxels, self._clearance, occupancy.cells, diffusion)
        self.step += 1
        return float(self._loss.sum()) / (3 * s.rays)

    def _repair(self) -> None:
        """Set what is not finite to zero: rays that meet it get no gradient to repair it."""
        for array in (self._voxels.table, self._second_moment):
            np.nan_to_num(array, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        np.clip(self._voxels.table, 0.0, MAX_DENSITY, out=self._voxels.table)


def _empty_grid(size: int) -> NDArray[np.float32]:
    """Zeros for size^3 vertices, rounded up to whole segments."""
    return np.zeros((-(-(size**3) // SEGMENT) * SEGMENT, 4), np.float32)


make = VoxelField
