"""The base class of representations with an encoding and a small network: training, rendering, state.

In a step, chunks of rays are drawn, sampled, rendered and differentiated in parallel (``kernels.train``), the
encoding's gradients are added up by its own kernel, and Adam updates what received a gradient
(``kernels.adam``). Every 8 steps a part of the occupancy grid is refreshed.

A subclass makes, grows and differentiates its encoding, and has kernels for it (``kernels.radiance_model``).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields import field_constants as tuned
from edge_server.fields.common.cameras.camera_refinement import CameraRefinement
from edge_server.fields.common.field_state import load_arrays
from edge_server.fields.common.kernels.adam import PART, Rule, adam
from edge_server.fields.common.kernels.mlp import Net, init_net
from edge_server.fields.common.kernels.rays import Space, Views
from edge_server.fields.common.kernels.train import CHUNK, CHUNK_RAYS, ROW, Batch, RaySampling, Scratch, train_chunks
from edge_server.fields.common.kernels.volume_rendering import Weights
from edge_server.fields.common.occupancy_grid import OccupancyGrid
from edge_server.fields.common.ray_snapshot import RaySnapshot
from edge_server.fields.common.scene_box import UNIT_BOX, SceneBox
from edge_server.fields.common.settings import BATCH
from edge_server.fields.common.stepped_field import Step, SteppedField
from edge_server.fields.common.supervision import supervising_views
from edge_server.fields.common.training_schedule import StepBudget, StepTimer, step_key, step_length
from edge_server.fields.common.view_store import Arrays, same_views

TINY: dict[str, Any] = {"batch_samples": CHUNK, "cells": 16, "samples": 16}  # for compiling kernels
assert BATCH == CHUNK, "settings and kernels must agree on the size of a chunk"
DIRTY = 32  # parameters for one dirty flag: a segment of ``adam``, times its width


class TrainedField(SteppedField[RaySnapshot]):
    """A radiance field that learns while it is used. See ``SteppedField``."""

    shape: ClassVar[tuple[str, ...]] = ("hidden", "hidden_layers", "sh_degree", "cells")
    _encoding: Any  # a named tuple with a ``table`` of float32 parameters, see ``kernels.radiance_model``
    _bins: tuple[Any, ...] = ()  # what the encoding's kernels need for training beside ``Scratch``
    _net: Net
    _batch: Batch
    _cameras: CameraRefinement
    _occupancy: OccupancyGrid
    _swept: tuple[tuple[View, ...], NDArray[np.float32]] | None  # views, and what ``depth_guide`` returned for them

    # --- the protocol -------------------------------------------------------------------------

    def _begin_fit(self, views: Sequence[View], step_budget: StepBudget) -> Step:
        with self._lock:
            update = self.view_store.add(views)
            if update.box_changed:
                self._forget_parameters()
            if update.visibility_changed:
                self._occupancy.recount_views(self.pool, self.view_store)
            assert self.view_store.box is not None
            box, cameras = self.view_store.box, self._cameras
            data = cameras.corrected(views, update.data, box)
            data = self._add_depth_guide(views, data, box, step_budget)
            shape = len(self._batch.samples), *cameras.embeddings.shape
            self._batch = self._batch._replace(d_embeddings=np.zeros(shape, np.float32))

        def one_step(progress: float) -> tuple[float, int, int, int]:
            nonlocal data
            loss, batch = self._one_step(data, progress), self._batch
            data = cameras.learn(views, data, box, self.step, batch, self._live)
            dropped = int(batch.dropped.sum() + self._dropped_by_task.sum())
            return loss, int(batch.rays.sum()), int(batch.samples.sum()), dropped

        return one_step

    def learned_pose(self, view: View) -> NDArray[np.float64] | None:
        """The pose (4, 4) that a view which it learns from was corrected to; None: it was not. No other camera's error
        tells that of a view that is held out, so that this is no ``fields.RefinesCameras``."""
        poses = self._cameras.poses
        return None if poses is None else poses.learned_pose(view)

    def _live(self) -> RaySnapshot:
        return RaySnapshot(
            settings=self.settings,
            box=self.view_store.box or UNIT_BOX,
            encoding=self._encoding,
            levels=self._levels(),
            net=self._net,
            space=self._occupancy.space(step_length(self.settings, self.step)),
            background=self.view_store.background(),
            pool=self.pool,
            step=self.step,
        )

    # --- state --------------------------------------------------------------------------------

    def _counters(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "dropped": self.dropped,
            "needed": self._occupancy.needed,
            "camera_errors": self._cameras.meta(),
        }

    def _load(self, meta: dict[str, Any], state: Arrays) -> None:
        self._grow()
        load_arrays(self._arrays(), state)
        self._cameras.load(meta.get("camera_errors", {}))
        self._occupancy.needed = int(meta["needed"])
        self._occupancy.update_occupied()

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

    @abstractmethod
    def _make(self, rng: np.random.Generator) -> tuple[Any, int]:
        """A fresh encoding for ``self.view_store.box`` (None: no scene yet), and its number of features."""

    def _tiny(self) -> Any:
        return msgspec.structs.replace(self.settings, **TINY)

    def _levels(self) -> int:
        """How many levels of the encoding are in use."""
        return 1

    def _feature_rows(self) -> int:
        """Rows of ``Batch.d_features``."""
        return int(self._net.widths[0])

    def _grow(self) -> None:
        """Give the encoding the size and sampling it has at ``self.step``; called after every step."""

    @abstractmethod
    def _gather(self, levels: int) -> None:
        """Add the encoding's gradient of ``self._batch`` to ``self._table_g`` and set ``self._dirty``."""

    def _add_depth_guide(self, views: Sequence[View], data: Views, box: SceneBox, step_budget: StepBudget) -> Views:
        """``data`` with a depth guide, if the settings ask for one and a plane sweep fits the budget."""
        s = self.settings
        weight = s.depth_guide
        if weight is None:
            # With many cameras in a room, a field is as good without a guide, sooner or later.
            plain = self.view_store.background_is_plain and s.background == "auto"
            weight = tuned.GUIDE_WEIGHT if plain or len(supervising_views(data)) <= tuned.FEW_VIEWS else 0.0
        # Cameras do not agree while their appearances and poses are still to be learned.
        self._guide_weight = 0.0 if self._cameras.enabled else weight
        if self._present_guide_weight() == 0.0:
            return data
        if self._swept is None or not same_views(views, self._swept[0]):
            if not step_budget.has_room(self._sweep_timer.seconds, tuned.SWEEP_SHARE, self._step_time.seconds):
                return data
            # Imported here: other scenes need neither load nor compile it.
            from edge_server.fields.common.plane_sweep import depth_guide

            begun = self.now()
            self._swept = (tuple(views), depth_guide(s, self.pool, box, views, data))
            self._sweep_timer.add(self.now() - begun)
        return data._replace(guide=self._swept[1])

    def _present_guide_weight(self) -> float:
        """The weight of the depth guide at this step."""
        return float(self._guide_weight * max(1.0 - self.step / self.settings.guide_steps, 0.0))

    # --- inside -------------------------------------------------------------------------------

    def _forget_parameters(self) -> None:
        s = self.settings
        rng = np.random.default_rng(np.random.SeedSequence(s.seed))
        self.step = 0
        self._snapshot = None
        self._step_time, self._sweep_timer = StepTimer(), StepTimer()
        self._guide_weight = 0.0
        self._swept = None
        self._encoding, features = self._make(rng)
        self._net = init_net(features, 4 + 9 * s.sh_degree + 3 * s.appearance, [s.hidden] * s.hidden_layers, rng)
        self._take_table(self._encoding.table)
        self._net_m, self._net_v, self._net_g = (np.zeros_like(self._net.params) for _ in range(3))
        self._occupancy = OccupancyGrid(s.cells, s.min_views, self.view_store.box)
        self._cameras = CameraRefinement(s)
        chunks, workers = max(s.batch_samples // CHUNK, 1), self.pool.threads
        units = int(self._net.widths.sum())
        self._batch = Batch(
            x=np.zeros((chunks, 3, ROW), np.float32),
            d_features=np.zeros((chunks, self._feature_rows(), ROW), np.float32),
            d_params=np.zeros((chunks, self._net.params.size), np.float32),
            columns=np.zeros(chunks, np.int64),
            samples=np.zeros(chunks, np.int64),
            rays=np.zeros(chunks, np.int64),
            dropped=np.zeros(chunks, np.int64),
            loss=np.zeros(chunks),
            d_embeddings=np.zeros((chunks, 0, 0), np.float32),
        )
        self._scratch = Scratch(
            acts=np.zeros((workers, units, ROW), np.float32),
            d_acts=np.zeros((workers, units, ROW), np.float32),
            line=np.zeros((workers, 3, ROW), np.float32),
            by_ray=np.zeros((workers, 11, ROW), np.float32),
            column=np.zeros((workers, CHUNK), np.int64),
            ray_first=np.zeros((workers, CHUNK_RAYS + 1), np.int64),
            ray=np.zeros((workers, CHUNK_RAYS, 12), np.float32),
            travel=np.zeros((workers, CHUNK_RAYS, 3), np.float32),
            span=np.zeros((workers, CHUNK, 4), np.int64),
        )
        self._scratch_x = np.zeros((workers, 3, ROW), np.float32)

    def _take_table(self, table: NDArray[np.float32]) -> None:
        """Allocate the moments and gradients of a table."""
        self._table_m, self._table_v, self._table_g = (np.zeros_like(table) for _ in range(3))
        self._dirty = np.zeros(table.size // DIRTY, np.bool_)
        self._dropped_by_task = np.zeros(1 + -(-self._dirty.size // PART), np.int64)

    def _one_step(self, data: Views, progress: float) -> float:
        """One optimizer step; returns its mean squared error. progress: progress of the fit, in [0, 1]."""
        s, levels, box = self.settings, self._levels(), self.view_store.box
        assert box is not None
        key = step_key(s.seed, self.step)
        if self.step % tuned.OCCUPANCY_EVERY == 0:
            model = self._encoding, levels, self._net
            self._occupancy.refresh(
                self.pool, key, self.step // tuned.OCCUPANCY_EVERY, model, self._scratch.acts, self._scratch_x
            )
        space: Space = self._occupancy.space(step_length(self.settings, self.step))
        batch = self._batch
        ray_sampling = RaySampling(
            key=np.uint64(key + np.uint64(1)),
            chunk_rays=max(s.rays // batch.samples.size, 1),
            levels=levels,
            sh_degree=s.sh_degree,
            changed_share=np.float32(s.changed_share),
            background=self.view_store.background(),
            embeddings=self._cameras.embeddings,
        )
        weights = Weights(distortion=np.float32(s.distortion), guide=np.float32(self._present_guide_weight()))
        self.pool.run(
            train_chunks,
            data,
            ray_sampling,
            space,
            self._encoding,
            self._net,
            weights,
            batch,
            self._scratch,
            self._bins,
        )
        rays = max(int(batch.rays.sum()), 1)
        self._gather(levels)
        if batch.dropped.any():
            self._repair()
        updates, fall = self.step + 1, s.rate_end**progress
        rule = Rule(
            rate=np.float32(s.rate * fall),
            beta1=np.float32(tuned.BETA1_FIELD),
            beta2=np.float32(tuned.BETA2),
            epsilon=np.float32(s.epsilon),
            scale=np.float32(tuned.NOMINAL_RAYS / rays),
            correct1=np.float32(1.0 / (1.0 - tuned.BETA1_FIELD**updates)),
            correct2=np.float32(1.0 / (1.0 - tuned.BETA2**updates)),
        )
        rule_net = rule._replace(rate=np.float32(s.rate_net * fall))
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
        """Set parameters and moments that are not finite to zero: rays that meet them give no gradient."""
        arrays = (self._encoding.table, self._table_m, self._table_v)
        for array in (*arrays, self._net.params, self._net_m, self._net_v):
            np.nan_to_num(array, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
