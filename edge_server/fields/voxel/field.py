"""Explicit voxels on CPUs, for the shortest update: density and colour in a grid, no network (as Plenoxels,
Fridovich-Keil et al. 2022, without their harmonics; thesis 3.20-3.22).

One step: rays are drawn, traced and differentiated in one pass (``kernels.voxel``), in a fixed number of
parts with a gradient buffer each; Adam adds these up and touches what received a gradient
(``kernels.voxel_update``). The grid gets finer while it is trained; empty cells are left out.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, Field, FitReport, Rendering, View
from edge_server.fields.common.fair_lock import FairLock
from edge_server.fields.common.field_state import all_or_nothing, load_arrays, pack_state, unpack_meta
from edge_server.fields.common.kernels.precompile import compile_ahead
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.kernels.thread_pool import Pool, shared_pool
from edge_server.fields.common.kernels.train import RaySampling
from edge_server.fields.common.occupancy_grid import EMPTY, OccupancyGrid
from edge_server.fields.common.scene_box import PLAIN, UNIT_BOX
from edge_server.fields.common.training_schedule import StepBudget, StepTimer, step_key
from edge_server.fields.common.view_store import Arrays, ViewStore
from edge_server.fields.voxel.kernels.rays import SEGMENT, Clearing, Voxels, train_rays
from edge_server.fields.voxel.kernels.update import (
    DENSEST,
    PART,
    DiffusionRule,
    VoxelRule,
    clear,
    densest,
    diffuse,
    each_of,
    refine,
    voxel_adam,
)
from edge_server.fields.voxel.settings import VoxelSettings, make_settings, sizes_of
from edge_server.fields.voxel.snapshot import VoxelSnapshot, make_trace
from freshfield.geometry import Pinhole

PHASES = 4  # looks until every cell has been looked at
EVERY = 5  # steps between looks at where there is density
DIFFUSED = 4  # steps in which all layers diffuse once: an equal share of each step, for budgets to be kept
FADE = 0.75  # of a cell's density per look
BETA2 = 0.95  # Adam's memory in steps that touch a vertex: a fit has a hundred of them, not thousands
WARM = 1.5  # of the steps until the grid has its last size: from then on a fit is a warm start
TOLERANCE = PLAIN  # of 255, within which a pixel is taken for the plain background
SHAPE = ("sizes", "refine_at", "cells")  # a state fits a field that agrees in these


class VoxelField:
    """A grid that learns while it is used. See ``fields.Field`` for the protocol.

    ``fit`` belongs to one thread; ``render``, ``snapshot`` and ``points`` may be called from others
    meanwhile: they wait for the end of the present step, some milliseconds.
    """

    def __init__(self, settings: VoxelSettings | None = None, pool: Pool | None = None) -> None:
        self.settings = settings or VoxelSettings()
        self.pool = pool or shared_pool(self.settings.threads, self.settings.nice)
        self._lock = FairLock()
        self.now = time.perf_counter  # the clock of budgets in seconds
        self.reset()

    # --- the protocol -------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget the scene, its box and its cameras; keep settings and compiled kernels."""
        with self._lock:
            self.dropped = 0
            self.view_store = ViewStore(self.settings)
            self._snapshot: VoxelSnapshot | None = None
            self._forget()

    def fit(self, views: Sequence[View], budget: Budget) -> FitReport:
        """Train on ``views`` from the present grid. Raises ValueError for a view that cannot be one.

        In a budget in seconds, no step begins that would end too late as steps usually go. New pictures are
        taken in first, however short it is. The learning rate falls over the budget.
        """
        if not views:
            return FitReport(0, 0.0, 0.0, 0, 0, note="no views: nothing was done")
        pace, s = StepBudget(budget, self.now), self.settings
        with self._lock:
            intake = self.view_store.add(views)
            if intake.box_changed:
                self._forget()
            if intake.visibility_changed:
                moving = self._occupancy.recount_views(self.pool, self.view_store, self._empty())
                if intake.has_new_images:
                    self._soften(moving)
                self._clear()
            data = self._outlined(self.view_store.without_outliers(views, intake, self.step, self._live()))
            # Once the grid is fine, most of what a fit meets is known: full rates would undo it.
            share = s.warm if self.step >= WARM * max(s.refine_at, default=s.prune_from) else 1.0
            # Steps at full rates: a grid that meets the same pixels over and over learns them by heart.
            full = s.settle * (len(data.drawn) or len(data.pixels)) / s.rays or np.inf
            # A prior counts the less the more has been seen; a camera that stands still sees no more.
            places = len(np.unique(data.origin, axis=0))
            diffuse_by = s.diffuse * min(s.diffuse_views / max(places, 1), 1.0)
        rays = samples = dropped = 0
        losses: deque[float] = deque(maxlen=32)
        while (progress := pace.begin_step(self._usual)) is not None:
            with self._lock:
                fall = s.rate_end**progress * min(full / max(pace.steps, 1), 1.0)
                losses.append(self._one_step(data, share * fall, diffuse_by))
                rays += self.settings.rays
                samples += int(self._samples.sum())
                dropped += int(self._bad_rays.sum() + self._bad_gradients.sum())
            pace.end_step()
        self.dropped += dropped
        loss = float(np.mean(losses)) if losses else 0.0
        refused = self.view_store.refused_among(views)
        return FitReport(pace.steps, pace.elapsed_s(), loss, rays, samples, dropped, refused)

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """The picture of a camera, from the present grid."""
        return self.snapshot().render(camera_to_world, intrinsics)

    def points(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Surface points in world metres and their colours; none before the first fit."""
        return self.snapshot().points(count)

    def snapshot(self, present_ns: int | None = None) -> VoxelSnapshot:
        """A copy that renders from any thread and never changes."""
        with self._lock:
            if self._snapshot is None or self._snapshot.step != self.step:
                live = self._live()
                self._snapshot = replace(
                    live,
                    voxels=live.voxels._replace(table=live.voxels.table.copy()),
                    space=live.space._replace(away=live.space.away.copy()),
                )
            return self._snapshot

    def _live(self) -> VoxelSnapshot:
        """A snapshot of living arrays: valid until the next step."""
        return VoxelSnapshot(
            box=self.view_store.box or UNIT_BOX,
            voxels=self._voxels,
            space=self._clearing(),
            background=self.view_store.background(),
            cameras=self.view_store.views,
            pool=self.pool,
            step=self.step,
        )

    def warm_up(self) -> float:
        """Compile (or load from numba's cache) every kernel before it is needed; returns the seconds taken.

        Works on small fields of its own, in the calling thread and at its priority: the workers' low one
        would make compiling on a busy machine take minutes. This field's state is not touched.
        """
        return compile_ahead(self._run_kernels)

    def _run_kernels(self, pool: Pool) -> None:
        """Go through every kernel once."""
        tiny = replace(
            self.settings, rays=64, cells=16, sizes=(8, 12), refine_at=(1,), prune_from=0, min_views=1
        )
        camera = Pinhole.from_fov(8, 8, 60.0)
        pose = np.eye(4)
        pose[2, 3] = -3.0
        for channels in (3, 4):
            field = VoxelField(replace(tiny, contracted=channels == 3), pool)
            image = np.full((8, 8, channels), 128, np.uint8)
            field.fit([View("warm-up", image, pose, camera)], Budget(steps=2))
            field.render(pose, camera)

    # --- state --------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Everything needed to go on bit for bit: grid, moments, occupancy, cameras, counters."""
        with self._lock:
            counters = {
                "step": self.step,
                "updates": self._updates,
                "dropped": self.dropped,
                "needed": self._occupancy.needed,
            }
            return pack_state("voxel", self.settings, self.view_store, counters, self._arrays())

    def load_state(self, state: Arrays) -> None:
        """Go on where ``state`` was taken. ValueError where it is not a state of a field of this shape."""
        with self._lock, all_or_nothing(self):
            meta = unpack_meta(self.settings, state, "voxel", SHAPE)
            self.view_store = ViewStore(self.settings)
            self.view_store.load(meta, state)
            self._forget()
            self.step, self._updates = int(meta["step"]), int(meta["updates"])
            self._grow(max(self.step - 1, 0))
            load_arrays(self._arrays(), state)
            self.dropped, self._occupancy.needed = int(meta["dropped"]), int(meta["needed"])
            self._clear()
            self._snapshot = None

    def _arrays(self) -> Arrays:
        return {
            "table": self._voxels.table,
            "table_v": self._v,
            "density": self._occupancy.density,
            "seen": self._occupancy.seen,
            "occupied": self._occupancy.occupied,
        }

    # --- inside -------------------------------------------------------------------------------

    def _forget(self) -> None:
        self.step = 0
        self._snapshot = None  # it is known by its step alone
        self._outlines: tuple[Views, Views] | None = None  # of the views last seen, before and after
        self._updates = 0  # optimiser steps that Adam's bias correction counts
        self._usual = StepTimer()
        s = self.settings
        self._sizes = sizes_of(s, self.view_store.box)
        table = _room_for(self._sizes[0])
        table[:] = (s.first, 0.5, 0.5, 0.5)
        self._take(self._sizes[0], table)
        self._occupancy = OccupancyGrid.for_box(s, self.view_store.box, unknown=2.0 * EMPTY)
        self._away = np.zeros(s.cells**3, np.uint8)
        self._memory = make_trace(self.pool.threads)
        self._samples, self._bad_rays = np.zeros(s.parts, np.int64), np.zeros(s.parts, np.int64)
        self._loss = np.zeros(s.parts)

    def _take(self, size: int, table: NDArray[np.float32]) -> None:
        self._voxels, self._v = Voxels(size, table), np.zeros_like(table)
        self._gradient = np.zeros((self.settings.parts, *table.shape), np.float32)
        self._dirty = np.zeros((self.settings.parts, len(table) // SEGMENT), np.uint8)
        self._bad_gradients = np.zeros(-(-self._dirty.shape[1] // PART), np.int64)

    def _clearing(self) -> Clearing:
        """Where rays are sampled: a view on the living array."""
        o = self._occupancy
        step, near = np.float32(self._step_length()), np.float32(o.near)
        return Clearing(self._away, o.cells, o.contracted, step, near)

    def _empty(self) -> float:
        """The density of a scene unit below which a cell gets no samples."""
        return float(self.settings.prune) / self._step_length()

    def _soften(self, moving: NDArray[np.bool_] | None) -> None:
        """Make what is opaque in cells where something moved translucent: behind an opaque vertex, and in it,
        nothing has a gradient, and what was there would stay for ever."""
        if moving is None or not moving.any():
            return
        cells, size = self._occupancy.cells, self._voxels.size
        cell = np.minimum(np.arange(size) * cells // (size - 1), cells - 1)
        there = moving.reshape(cells, cells, cells)[np.ix_(cell, cell, cell)]
        density = self._voxels.table[: size**3, 0].reshape(size, size, size)
        np.minimum(density, np.float32(self.settings.soften), out=density, where=there)

    def _clear(self) -> None:
        """Tell rays anew where cells are empty."""
        clear(self._occupancy.occupied, self._occupancy.cells, self._away)

    def _step_length(self) -> float:
        """One vertex spacing, in scene units."""
        width = 4.0 if self._occupancy.contracted else 2.0
        return width / (self._voxels.size - 1)

    def _outlined(self, data: Views) -> Views:
        """``data`` with an alpha channel where a plain background tells what is empty."""
        if self._outlines is not None and self._outlines[0] is data:
            return self._outlines[1]
        s, outlined = self.settings, data
        if (
            s.outline > 0.0
            and s.background == "auto"
            and data.pixels.shape[1] == 3
            and self.view_store.background_is_plain
        ):
            color = np.rint(255.0 * self.view_store.background()).astype(np.int16)
            apart = np.abs(data.pixels.astype(np.int16) - color).max(axis=1)
            alpha = np.where(apart > TOLERANCE, 255, 0).astype(np.uint8)
            outlined = data._replace(pixels=np.concatenate([data.pixels, alpha[:, None]], axis=1))
        self._outlines = (data, outlined)
        return outlined

    def _grow(self, step: int) -> None:
        """Bring the grid to the size it has at a step."""
        size = self._sizes[sum(step >= at for at in self.settings.refine_at)]
        old = self._voxels.size
        if size == old:
            return
        grid = _room_for(size)
        self.pool.run(refine, self._voxels.table, old, grid, size)
        # Moments start anew: a coarse vertex collects the gradients of many fine ones, and what it remembers
        # of them would hold these back for as long as its memory lasts.
        self._take(size, grid)

    def _one_step(self, data: Views, fall: float, diffuse_by: float) -> float:
        """One optimiser step; returns its mean squared error. fall: share of the rates. diffuse_by: share of
        the way to its neighbours' mean that a vertex goes in ``DIFFUSED`` steps at full rates."""
        self._grow(self.step)
        s, length = self.settings, self._step_length()
        key, occupancy, outline = step_key(s.seed, self.step), self._occupancy, np.float32(s.outline)
        if self.step % EVERY == 0 and self.step >= s.prune_from:
            self.pool.run(
                densest, self.step // EVERY % PHASES, PHASES, np.float32(FADE), self._voxels,
                np.float32(1.0 / length), occupancy.cells, occupancy.seen, occupancy.needed,
                occupancy.density,
            )  # fmt: skip
            occupancy.update_occupied(self._empty())
            self._clear()
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
            train_rays, data, recipe, self._clearing(), self._voxels, s.rays, outline, self._memory,
            self._gradient, self._dirty, self._samples, self._bad_rays, self._loss,
        )  # fmt: skip
        if self._bad_rays.any():
            self._repair()
        self._updates += 1
        rule = VoxelRule(
            each=each_of((s.rate * fall, s.rate_color * fall), (s.growth, 0.0), (s.l1, 0.0), (DENSEST, 1.0)),
            beta2=np.float32(BETA2),
            epsilon=np.float32(s.epsilon),
            correct2=np.float32(1.0 / (1.0 - BETA2**self._updates)),
        )
        self.pool.run(
            voxel_adam, self._voxels.table, self._v, self._gradient, self._dirty, rule, self._bad_gradients
        )
        if diffuse_by > 0.0 and self.step >= s.prune_from:
            # As strong as the rates, which it holds the balance to. A colour is at most 1, a density DENSEST.
            edge = np.array([DENSEST, 1.0, 1.0, 1.0], np.float32) * np.float32(s.diffuse_edge)
            draw = DiffusionRule(edge, np.float32(fall * diffuse_by / 6.0))
            turn = self.step % DIFFUSED
            self.pool.run(diffuse, turn, DIFFUSED, self._voxels, self._away, occupancy.cells, draw)
        self.step += 1
        return float(self._loss.sum()) / (3 * s.rays)

    def _repair(self) -> None:
        """Set to zero whatever is not finite: rays that meet it give no gradient that would lead there."""
        for array in (self._voxels.table, self._v):
            np.nan_to_num(array, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        np.clip(self._voxels.table, 0.0, DENSEST, out=self._voxels.table)


def _room_for(size: int) -> NDArray[np.float32]:
    """An empty grid: rounded up so that no dirty flag stands for less than SEGMENT vertices."""
    return np.zeros((-(-(size**3) // SEGMENT) * SEGMENT, 4), np.float32)


def make(options: dict[str, Any], seed: int = 0) -> Field:
    """A field from plain options (``voxel_settings``). ValueError where CUDA is asked for."""
    settings = make_settings(options, seed)
    if settings.device == "cuda":
        raise ValueError("voxel: runs on CPUs only; use device cpu or auto, or the field ngp")
    return VoxelField(settings)
