"""3D Gaussian splatting on CPUs (Kerbl et al. 2023): tile kernels in numba, forward and backward.

One step: the Gaussians are projected into a camera (``kernels.project``) and listed by tile, front to back
(``kernels.bin_tiles``); tiles are rendered, compared and differentiated in parallel (``kernels.rasterize``,
strip by strip in ``kernels.composite``); every Gaussian gathers the gradients of its tiles in a fixed order,
backpropagates them through the projection (``kernels.project_backward``) and makes an Adam step
(``kernels.optimizer_step``). From time to time Gaussians are split and pruned (``densification``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.field_state import load_arrays
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.scene_box import UNIT_BOX
from edge_server.fields.common.stepped_field import Step, SteppedField
from edge_server.fields.common.supervision import supervising_views
from edge_server.fields.common.training_schedule import StepBudget, StepTimer
from edge_server.fields.common.view_store import Arrays, same_views
from edge_server.fields.splat import splat_constants as tuned
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.densification import GaussianCloud, densify_and_prune
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, age_corrections, clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, QUATERNION, SCALE, SH_COLUMNS, TILE
from edge_server.fields.splat.kernels.rasterize import LOSSES, Target
from edge_server.fields.splat.seeding import seed_gaussians
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.snapshot import SplatSnapshot


class StillField(SteppedField[SplatSnapshot]):
    """Gaussians that do not move, and learn while they are in use. See ``SteppedField``.

    In a scene with motion, it learns what the newest view of each camera shows.
    """

    Settings = SplatSettings
    shape = ("sh_degree",)
    settings: SplatSettings
    _rigid: NDArray[np.float64] | None = None  # (6,): steps write force and torque here, see ``RasterBuffers.step``

    # --- the protocol -------------------------------------------------------------------------

    @property
    def step_time(self) -> StepTimer:
        """Estimate of the duration of a step."""
        return self._step_time

    def take_in(self, views: Sequence[View]) -> None:
        """Make ``views`` the training views. Raises ValueError if one is invalid."""
        with self._lock:
            self._ingest(views)

    def keep_box(self, views: Sequence[View]) -> None:
        """Fix the scene's box, or if there is none that of ``views``, whatever cameras come later."""
        with self._lock:
            if self.view_store.box is None:
                self.view_store.add(views)
            self.view_store.keep_box()

    def begin_anew(self, params: NDArray[np.float32] | None) -> None:
        """Forget views and Gaussians, but not the scene's box.

        params: float32 (N, P), of the first Gaussians; None: they are found from the next views.
        """
        with self._lock:
            self.view_store.forget_views()
            self._forget_parameters()
            if params is not None:
                self.cloud = GaussianCloud.new(params)

    def train_step(self, progress: float, grow: bool) -> tuple[float, int, int]:
        """One optimizer step at ``progress``, in [0, 1], of a schedule. grow: whether Gaussians may be split and
        pruned. Returns the mean squared error, pixels, and pairs of a Gaussian and a tile."""
        with self._lock:
            loss, pixels, pairs, lost = self._one_step(progress, grow)
            self.dropped += lost
        return loss, pixels, pairs

    def error(self) -> float:
        """Mean squared error of the training views, as in ``train_step``."""
        with self._lock:
            square, pixels = 0.0, 0
            for view in self._asked:
                self._raster.project_and_bin(self._camera(view), self.cloud.params)
                losses = self._raster.train(self._target(view))
                square, pixels = square + float(losses[:, 0].sum()), pixels + TILE * TILE * len(losses)
        return square / (3 * max(pixels, 1))

    def set_params(self, params: NDArray[np.float32]) -> None:
        """Replace the parameters, float32 (N, P), of all Gaussians."""
        with self._lock:
            self.cloud.params[:] = params
            self._snapshot = None

    def _begin_fit(self, views: Sequence[View], step_budget: StepBudget) -> Step:
        self.take_in(views)
        return self._one_step

    def _live(self) -> SplatSnapshot:
        return SplatSnapshot(
            box=self.view_store.box or UNIT_BOX,
            params=self.cloud.params,
            background=self.view_store.background(),
            pool=self.pool,
            step=self.step,
            planar=self.settings.planar,
        )

    def _tiny(self) -> SplatSettings:
        return msgspec.structs.replace(self.settings, gaussians=64, start=8, seed_cells=8)

    # --- state --------------------------------------------------------------------------------

    def _counters(self) -> dict[str, Any]:
        return {"step": self.step, "grown": self._grown, "dropped": self.dropped}

    def _arrays(self) -> Arrays:
        return {f.name: getattr(self.cloud, f.name) for f in fields(self.cloud)}

    def _load(self, meta: dict[str, Any], state: Arrays) -> None:
        count, most = len(state["params"]), self.settings.gaussians
        if count > most:
            raise ValueError(f"the state has {count} Gaussians, this field holds {most} at most")
        self.cloud = GaussianCloud.new(np.zeros((count, BASE + SH_COLUMNS * self.settings.sh_degree), np.float32))
        load_arrays(StillField._arrays(self), state)  # not what a subclass adds
        self._grown = int(meta["grown"])

    # --- inside -------------------------------------------------------------------------------

    def _forget_parameters(self) -> None:
        self.step = 0
        self._grown = 0  # step of the last splitting and pruning
        self._step_time = StepTimer()
        self.cloud = GaussianCloud.empty(self.settings)
        self._raster, self._render_raster = RasterBuffers(self.pool), RasterBuffers(self.pool)
        self._snapshot = None
        self._views: tuple[View, ...] = ()
        self._epoch = -1

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.settings.seed, self.step, purpose]))

    def _ingest(self, views: Sequence[View]) -> None:
        """Add new views; seed the Gaussians if there are none."""
        if not same_views(views, self._views):
            intake = self.view_store.add(views)
            if intake.box_changed:
                self._forget_parameters()
            self._data: Views = intake.data
            # All of them, where every weight is 0.
            self._asked = supervising_views(self._data) or list(range(len(views)))
            self._views, self._epoch = tuple(views), -1
        if len(self.cloud) == 0:
            self._seed()
        self._snapshot = None

    def _pose_of(self, view: View) -> NDArray[np.float64]:
        """The pose that a view is trained at: camera to world (4, 4)."""
        return view.camera_to_world

    def _next_view(self) -> int:
        """The view of this step: all take turns, in a new random order for each pass."""
        count = len(self._asked)
        if self._epoch != self.step // count:
            self._epoch = self.step // count
            drawn = np.random.default_rng(np.random.SeedSequence([self.settings.seed, self._epoch, 4]))
            self._order = drawn.permutation(count)
        return self._asked[self._order[self.step % count]]

    def _one_step(self, progress: float, grow: bool = True) -> tuple[float, int, int, int]:
        """One optimizer step at ``progress`` of the fit, in [0, 1]. grow: see ``train_step``.

        Returns the mean squared error, pixels, pairs of a Gaussian and a tile, and the number of tiles and
        gradients that were not finite.
        """
        view = self._next_view()
        camera, cloud, raster = self._camera(view), self.cloud, self._raster
        raster.project_and_bin(camera, cloud.params)
        losses = raster.train(self._target(view))
        dropped = raster.step(
            camera, cloud.params, cloud.optimizer_state(), self.adam_parameters(progress), self._rigid
        )
        self._learn_camera(view, losses)
        if self.settings.planar:
            from edge_server.fields.splat.planar import flatten  # compiled only where it is used

            flatten(cloud, self.settings.flatten)
        square, broken = losses.sum(axis=0)[:LOSSES].tolist()
        if broken:
            self._repair()
        self.step += 1
        if grow:
            self._grow_if_due()
        pixels = TILE * TILE * len(losses)
        pairs = min(int(raster.lists.needed[0]), raster.lists.pair.size)
        return square / (3 * pixels), pixels, pairs, int(broken) + dropped

    def _camera(self, view: int) -> NDArray[np.float32]:
        """The row (1, CAMERA) of a view's camera at the pose that it is trained at now."""
        one, box = self._views[view], self.view_store.box
        assert box is not None
        return camera_rows([self._pose_of(one)], [one.intrinsics], box)

    def _target(self, view: int) -> Target:
        """A view as a training target."""
        return Target(*self._pixels_of(view), self.view_store.background())

    def _pixels_of(self, view: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """The image of a view, (H, W, 3 or 4), and its weights, see ``Target``."""
        (w, h), first = self._data.size[view], self._data.first[view]
        return self._data.pixels[first : first + w * h].reshape(h, w, -1), self._weight_of(view)

    def adam_parameters(self, progress: float) -> AdamParameters:
        """Parameters of an optimizer step at ``progress``, in [0, 1], of a fit."""
        s, box = self.settings, self.view_store.box
        assert box is not None
        rates = np.full(BASE + SH_COLUMNS * s.sh_degree, tuned.RATE_SH)
        rates[:SCALE] = tuned.RATE_POSITION * box.pixel_m / box.radius_m
        rates[SCALE:QUATERNION] = tuned.RATE_SCALE
        rates[QUATERNION:OPACITY] = tuned.RATE_ROTATION
        rates[OPACITY], rates[COLOR:BASE] = tuned.RATE_OPACITY, tuned.RATE_COLOR
        return AdamParameters(
            (rates * s.rate_end**progress).astype(np.float32), age_corrections(), np.float32(s.epsilon)
        )

    def _learn_camera(self, view: int, losses: NDArray[np.float64]) -> None:
        """Update the camera of a view from a step. losses: see ``train_tiles``."""

    def _grow_if_due(self) -> None:
        # Not before every view has had a step.
        if self.step - self._grown >= max(self.settings.densify_every, len(self._asked)):
            self._grow()

    def _grow(self) -> None:
        self._protect_unsupervised()
        densify_and_prune(self.cloud, self.settings.gaussians, float(self._data.size[:, 0].mean()), self._rng(5))
        self._grown = self.step
        if len(self.cloud) == 0:  # everything was pruned: start again
            self._seed()

    def _protect_unsupervised(self) -> None:
        """Count Gaussians as seen if they are visible in tiles with pixels of weight 0, or in the last view of a camera
        without a current view: they may be needed although they have no gradient there."""
        cloud, box = self.cloud, self.view_store.box
        assert box is not None
        data = self._data
        raster, shows = self._render_raster, np.zeros(len(cloud), np.bool_)
        for k in range(len(data.size)):
            if (without := self._weight_of(k) == 0).any():
                raster.project_and_bin(self._camera(k), cloud.params, differentiate=False)
                shows |= raster.reaching(len(cloud), without)
        given = {view.camera for view in self._views}
        for view in self.view_store.views:
            if view.camera not in given:
                camera = camera_rows([self._pose_of(view)], [view.intrinsics], box)
                raster.project_and_bin(camera, cloud.params, differentiate=False)
                shows |= raster.lists.own_count[: len(cloud)] > 0
        cloud.looks[shows] = np.maximum(cloud.looks[shows], 1.0)

    def _weight_of(self, view: int) -> NDArray[np.float32]:
        """Weight of each pixel of a view, (H, W); (0, 0) if all have full weight."""
        (w, h), first, weight = self._data.size[view], self._data.first[view], self._data.weight
        return weight[first : first + w * h].reshape(h, w) if weight.size else weight.reshape(0, 0)

    def _seed(self) -> None:
        """Seed the first Gaussians from the current views."""
        assert self.view_store.box is not None
        s = self.settings
        first, weight = min(s.start, s.gaussians), self._data.weight
        self.cloud = GaussianCloud.new(
            seed_gaussians(s, self.pool, self.view_store.box, self._views, None, weight, first, self._rng(1))
        )

    def _repair(self) -> None:
        """Replace values that are not finite; such Gaussians become invisible and are pruned."""
        clamp_gaussians(self.cloud.params)
        for array in (self.cloud.m, self.cloud.v):
            np.nan_to_num(array, copy=False, nan=0.0, posinf=0.0, neginf=0.0)


make = StillField
