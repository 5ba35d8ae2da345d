"""What representations of an encoding and a small network share: training, rendering, state, cameras.

One step: chunks of rays are drawn, sampled, rendered and differentiated side by side
(``kernels.train``); the encoding's gradients are added up by its own kernel; Adam touches what received a
gradient (``kernels.adam``). Every 8 steps a part of the occupancy grid is refreshed.

A representation is a subclass that makes, grows and differentiates its encoding (``ngp``, ``tensorf``),
and the kernels for it (``kernels.model``).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, FitReport, Rendering, View
from edge_server.fields.common.camera_refinement import CameraErrors
from edge_server.fields.common.fair_lock import Turn
from edge_server.fields.common.field_state import all_or_nothing, fill, pack, unpack_meta
from edge_server.fields.common.kernels.adam import PART, Rule, adam
from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.kernels.precompile import compile_ahead
from edge_server.fields.common.kernels.rays import Space, Views
from edge_server.fields.common.kernels.thread_pool import Pool, shared_pool
from edge_server.fields.common.kernels.train import CHUNK, CHUNK_RAYS, Batch, Recipe, Scratch, train_chunks
from edge_server.fields.common.kernels.volume_rendering import Weights
from edge_server.fields.common.occupancy_grid import EVERY, Occupancy
from edge_server.fields.common.ray_snapshot import NgpSnapshot
from edge_server.fields.common.scene_box import NOWHERE, SceneBox
from edge_server.fields.common.supervision import asked_views
from edge_server.fields.common.trainer_settings import BATCH
from edge_server.fields.common.training_schedule import (
    BETA1_FIELD,
    BETA2,
    NOMINAL_RAYS,
    Pace,
    Usual,
    step_key,
    step_length,
)
from edge_server.fields.common.view_store import Arrays, Rig, same_views
from freshfield.geometry import Pinhole

TINY: dict[str, Any] = {"batch_samples": CHUNK, "cells": 16, "samples": 16}  # for compiling kernels
assert BATCH == CHUNK, "settings and kernels must mean the same by a chunk"
GUIDED, FEW = 0.1, 6  # the weight of a depth guide, and with how many views it is used in any scene
SWEEP_SHARE = 0.5  # of a budget in seconds that finding it may take
DIRTY = 32  # parameters that one dirty flag stands for: what ``adam`` calls a segment, times its width


class TrainedField:
    """A radiance field that learns while it is used. See ``fields.Field`` for the protocol.

    name: what messages call it. shape: the settings in which a state must agree with the field it is for.

    ``fit`` belongs to one thread; ``render``, ``snapshot`` and ``points`` may be called from others
    meanwhile: they wait for the end of the present step, some milliseconds.
    """

    name: ClassVar[str]
    shape: ClassVar[tuple[str, ...]]
    _encoding: Any  # a named tuple with a ``table`` of float32 parameters, as kernels.model wants it
    _net: Net
    _batch: Batch
    _cameras: CameraErrors
    _occupancy: Occupancy
    _swept: tuple[tuple[View, ...], NDArray[np.float32]] | None  # views, and what a plane sweep said of them

    def __init__(self, settings: Any, pool: Pool | None = None) -> None:
        self.settings = settings
        self.pool = pool or shared_pool(self.settings.threads, self.settings.nice)
        self._turn = Turn()
        self.now = time.perf_counter  # the clock of budgets in seconds
        self.reset()

    # --- the protocol -------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget the scene, its box and its cameras; keep settings and compiled kernels."""
        with self._turn.mine():
            self.dropped = 0
            self.rig = Rig(self.settings)
            self._snapshot: NgpSnapshot | None = None
            self._forget_parameters()

    def fit(self, views: Sequence[View], budget: Budget) -> FitReport:
        """Train on ``views`` from the present parameters. Raises ValueError for a view that cannot be one.

        In a budget in seconds, no step begins that would end too late as steps usually go. New pictures are
        taken in first, however short it is. The learning rate falls over the budget, so every
        fit ends with a settled field.
        """
        if not views:
            return FitReport(0, 0.0, 0.0, 0, 0, note="no views: nothing was done")
        pace = Pace(budget, self.now)
        with self._turn.mine():
            intake = self.rig.take_in(views)
            if intake.new_box:
                self._forget_parameters()
            if intake.look:
                self._occupancy.look(self.pool, self.rig)
            assert self.rig.box is not None
            box, cameras = self.rig.box, self._cameras
            data = intake.data
            if not cameras.asked:
                data = self.rig.trusted(views, intake, self.step, self._live())
            data = cameras.corrected(views, data, box)
            data = self._guided(views, data, box, pace, intake.fresh)
            counted = len(views) if cameras.exposures is not None else 0
            sums = np.zeros((len(self._batch.samples), counted, 3, 5))
            self._batch = self._batch._replace(exposure=sums)
        rays = samples = dropped = 0
        losses: deque[float] = deque(maxlen=32)
        while (progress := pace.begin(self._usual)) is not None:
            with self._turn.mine():
                losses.append(self._one_step(data, progress))
                data = cameras.learn(views, data, box, self.step, self.settings.seed, sums, self._live)
                rays += int(self._batch.rays.sum())
                samples += int(self._batch.samples.sum())
                dropped += int(self._batch.dropped.sum() + self._dropped_by_task.sum())
            pace.end()
        self.dropped += dropped
        loss = float(np.mean(losses)) if losses else 0.0
        refused = self.rig.left_out_of(views)
        return FitReport(pace.steps, pace.seconds(), loss, rays, samples, dropped, refused)

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """The picture of a camera, from the present parameters."""
        return self.snapshot().render(camera_to_world, intrinsics)

    def points(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Surface points in world metres and their colours; none before the first fit."""
        return self.snapshot().points(count)

    def snapshot(self, present_ns: int | None = None) -> NgpSnapshot:
        """A copy that renders from any thread and never changes."""
        with self._turn.mine():
            if self._snapshot is None or self._snapshot.step != self.step:
                live = self._live()
                self._snapshot = replace(
                    live,
                    encoding=live.encoding._replace(table=live.encoding.table.copy()),
                    net=Net(live.net.widths, live.net.params.copy()),
                    space=live.space._replace(
                        occupied=live.space.occupied.copy(),
                        coarse=live.space.coarse.copy(),
                        density=np.zeros(0, np.float32),
                    ),
                )
            return self._snapshot

    def _live(self) -> NgpSnapshot:
        """A renderer of the living arrays, for whoever has the turn."""
        return NgpSnapshot(
            box=self.rig.box or NOWHERE,
            encoding=self._encoding,
            levels=self._levels(),
            net=self._net,
            harmonics=self.settings.harmonics,
            space=self._occupancy.space(step_length(self.settings, self.step)),
            background=self.rig.background(),
            cameras=self.rig.views,
            pool=self.pool,
            step=self.step,
        )

    def warm_up(self) -> float:
        """Compile (or load from numba's cache) every kernel before it is needed; returns the seconds taken.

        Works on small fields of its own, in the calling thread and at its priority: the workers' low one
        would make compiling on a busy machine take minutes. This field's state is not touched.
        """
        return compile_ahead(self._tour)

    def _tour(self, pool: Pool) -> None:
        """Go through every kernel once."""
        tiny = self._tiny()
        camera = Pinhole.from_fov(8, 8, 60.0)
        pose = np.eye(4)
        pose[2, 3] = -3.0
        for channels in (3, 4):
            field = type(self)(replace(tiny, min_views=1, contracted=channels == 3), pool)
            image = np.full((8, 8, channels), 128, np.uint8)
            views = [View(f"warm-up {k}", image, pose, camera) for k in range(3)]
            field.fit(views, Budget(steps=1))  # with a depth guide, if any is to be expected
            field.render(pose, camera)

    # --- state --------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Everything needed to go on bit for bit: parameters, moments, occupancy, cameras, counters."""
        with self._turn.mine():
            counters = {
                "step": self.step,
                "updates": self._updates,
                "dropped": self.dropped,
                "needed": self._occupancy.needed,
                "camera_errors": self._cameras.meta(),
            }
            return pack(self.name, self.settings, self.rig, counters, self._arrays())

    def load_state(self, state: Arrays) -> None:
        """Go on where ``state`` was taken. ValueError where it is not a state of a field of this shape."""
        with self._turn.mine(), all_or_nothing(self):
            meta = unpack_meta(self.settings, state, self.name, self.shape)
            self.rig = Rig(self.settings)
            self.rig.load(meta, state)
            self._forget_parameters()
            self.step, self._updates = int(meta["step"]), int(meta["updates"])
            self._grow()
            fill(self._arrays(), state)
            self._cameras.load(meta.get("camera_errors", {}))
            self.dropped, self._occupancy.needed = int(meta["dropped"]), int(meta["needed"])
            self._occupancy.mark()
            self._snapshot = None

    def _arrays(self) -> Arrays:
        return {
            "table": self._encoding.table,
            "table_m": self._table_m,
            "table_v": self._table_v,
            "net": self._net.params,
            "net_m": self._net_m,
            "net_v": self._net_v,
            "density": self._occupancy.density,
            "seen": self._occupancy.seen,
            "occupied": self._occupancy.occupied,
        }

    # --- what a representation is -------------------------------------------------------------

    def _make(self, rng: np.random.Generator) -> tuple[Any, Net]:
        """A fresh encoding and network for ``self.rig.box`` (None: no scene yet)."""
        raise NotImplementedError

    def _tiny(self) -> Any:
        """The settings with everything small: what ``warm_up`` compiles the kernels with."""
        return replace(self.settings, **TINY)

    def _levels(self) -> int:
        """The part of the encoding that is switched on, as its kernels count it."""
        return 1

    def _feature_rows(self) -> int:
        """Rows of ``Batch.d_features``."""
        return int(self._net.widths[0])

    def _grow(self) -> None:
        """Bring the encoding to the size it has at ``self.step``: called after every step."""

    def _train(self, data: Views, recipe: Recipe, space: Space, weights: Weights) -> None:
        """Fill ``self._batch`` and the gradients in it from one step's rays."""
        self.pool.run(
            train_chunks, data, recipe, space, self._encoding, self._net, weights, self._batch, self._scratch
        )

    def _gather(self, levels: int, scale: float) -> None:
        """Add the encoding's gradient of the present batch to ``self._table_g``, set ``self._dirty``.

        scale: what Adam will multiply it with.
        """
        raise NotImplementedError

    def _guided(self, views: Sequence[View], data: Views, box: SceneBox, pace: Pace, fresh: bool) -> Views:
        """``data`` with what a plane sweep says about depth, if that is called for and fits the budget."""
        s = self.settings
        weight = s.depth_guide
        if weight is None:
            # Rooms that many cameras look into are as good without, sooner or later.
            plain = self.rig.plain and s.background == "auto"
            weight = GUIDED if plain or len(asked_views(data)) <= FEW else 0.0
        # Colours and poses that are still to be learnt do not agree.
        self._guide_weight = 0.0 if self._cameras.asked else weight
        if self._guiding() == 0.0:
            return data
        if fresh or self._swept is None or not same_views(views, self._swept[0]):
            if not pace.has_room(self._usual_sweep.seconds, SWEEP_SHARE, self._usual.seconds):
                return data
            # Only where it is called for: other scenes shall neither load nor compile what they do not use.
            from edge_server.fields.common.plane_sweep import guide

            begun = self.now()
            self._swept = (tuple(views), guide(s, self.pool, box, views, data))
            self._usual_sweep.took(self.now() - begun)
        return data._replace(guide=self._swept[1])

    def _guiding(self) -> float:
        """The present weight of what a plane sweep says about depth."""
        return float(self._guide_weight * max(1.0 - self.step / self.settings.guide_steps, 0.0))

    # --- inside -------------------------------------------------------------------------------

    def _forget_parameters(self) -> None:
        s = self.settings
        rng = np.random.default_rng(np.random.SeedSequence(s.seed))
        self.step = 0
        self._snapshot = None  # it is known by its step alone
        self._updates = 0  # optimiser steps that Adam's bias correction counts
        self._usual, self._usual_sweep = Usual(), Usual()
        self._guide_weight = 0.0
        self._swept = None
        self._encoding, self._net = self._make(rng)
        self._take_table(self._encoding.table)
        self._net_m, self._net_v, self._net_g = (np.zeros_like(self._net.params) for _ in range(3))
        self._occupancy = Occupancy.for_box(s, self.rig.box)
        self._cameras = CameraErrors(s.exposure, s.refine_m, s.refine_deg)
        chunks, workers = max(s.batch_samples // CHUNK, 1), self.pool.threads
        units = int(self._net.widths.sum())
        self._batch = Batch(
            x=np.zeros((chunks, 3, CHUNK), np.float32),
            d_features=np.zeros((chunks, self._feature_rows(), CHUNK), np.float32),
            d_params=np.zeros((chunks, self._net.params.size), np.float32),
            columns=np.zeros(chunks, np.int64),
            samples=np.zeros(chunks, np.int64),
            rays=np.zeros(chunks, np.int64),
            dropped=np.zeros(chunks, np.int64),
            loss=np.zeros(chunks),
            exposure=np.zeros((chunks, 0, 3, 5)),
        )
        self._scratch = Scratch(
            acts=np.zeros((workers, units, CHUNK), np.float32),
            d_acts=np.zeros((workers, units, CHUNK), np.float32),
            line=np.zeros((workers, 2, CHUNK), np.float32),
            laid=np.zeros((workers, 11, CHUNK), np.float32),
            column=np.zeros((workers, CHUNK), np.int64),
            ray_first=np.zeros((workers, CHUNK_RAYS + 1), np.int64),
            ray=np.zeros((workers, CHUNK_RAYS, 12), np.float32),
            way=np.zeros((workers, CHUNK_RAYS, 3), np.float32),
            piece=np.zeros((workers, CHUNK, 4), np.int64),
        )
        self._scratch_x = np.zeros((workers, 3, CHUNK), np.float32)

    def _take_table(self, table: NDArray[np.float32]) -> None:
        """Make room for the moments and gradients of a table."""
        self._table_m, self._table_v, self._table_g = (np.zeros_like(table) for _ in range(3))
        self._dirty = np.zeros(table.size // DIRTY, np.bool_)
        self._dropped_by_task = np.zeros(1 + -(-self._dirty.size // PART), np.int64)

    def _one_step(self, data: Views, progress: float) -> float:
        """One optimiser step; returns its mean squared error. progress: of the fit, in [0, 1]."""
        s, levels, box = self.settings, self._levels(), self.rig.box
        assert box is not None
        key = step_key(s.seed, self.step)
        if self.step % EVERY == 0:
            self._occupancy.refresh(
                self.pool, key, self.step // EVERY, self._encoding, levels, self._net,
                self._scratch.acts, self._scratch_x,
            )  # fmt: skip
        space: Space = self._occupancy.space(step_length(self.settings, self.step))
        batch = self._batch
        recipe = Recipe(
            key=np.uint64(key + np.uint64(1)),
            chunk_rays=max(s.rays // batch.samples.size, 1),
            levels=levels,
            harmonics=s.harmonics,
            changed_share=np.float32(s.changed_share),
            background=self.rig.background(),
            random_background=s.background == "random",
        )
        weights = Weights(
            distortion=np.float32(s.distortion),
            sparsity=np.float32(s.sparsity),
            near=np.float32(s.near_fade * box.distance_m / box.radius_m),
            guide=np.float32(self._guiding()),
        )
        self._train(data, recipe, space, weights)
        rays = max(int(batch.rays.sum()), 1)
        self._gather(levels, NOMINAL_RAYS / rays)
        if batch.dropped.any():
            self._repair()
        self._updates += 1
        fall = s.rate_end**progress
        rule = Rule(
            rate=np.float32(s.rate * fall),
            beta1=np.float32(BETA1_FIELD),
            beta2=np.float32(BETA2),
            epsilon=np.float32(s.epsilon),
            scale=np.float32(NOMINAL_RAYS / rays),
            decay=np.float32(s.decay),
            correct1=np.float32(1.0 / (1.0 - BETA1_FIELD**self._updates)),
            correct2=np.float32(1.0 / (1.0 - BETA2**self._updates)),
        )
        rule_net = rule._replace(rate=np.float32(s.rate_net * fall), decay=np.float32(0.0))
        self.pool.run(
            adam,
            (self._net.params, self._net_m, self._net_v, self._net_g),
            (self._encoding.table, self._table_m, self._table_v, self._table_g, self._dirty),
            batch.d_params,
            rule_net,
            rule,
            self._dropped_by_task,
        )
        self.step += 1
        self._grow()
        return float(batch.loss.sum()) / (3 * rays)

    def _repair(self) -> None:
        """Set to zero whatever is not finite: rays that meet it give no gradient that would lead there."""
        arrays = (self._encoding.table, self._table_m, self._table_v)
        for array in (*arrays, self._net.params, self._net_m, self._net_v):
            np.nan_to_num(array, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
