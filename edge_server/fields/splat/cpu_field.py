"""3D Gaussian splatting on CPUs (Kerbl et al. 2023): tile kernels in numba, forward and backward.

One step: the Gaussians are projected into a few cameras (``kernels.project``) and listed by tile, front to
back (``kernels.bin_tiles``); tiles are rendered, compared and differentiated in parallel
(``kernels.rasterize``, strip by strip in ``kernels.composite``); every Gaussian gathers the gradients of its
tiles in a fixed order, backpropagates them through the projection (``kernels.project_backward``) and makes an
Adam step (``kernels.optimizer_step``). From time to time Gaussians are split and pruned (``densification``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, View
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.scene_box import UNIT_BOX
from edge_server.fields.common.stepped_field import Step, SteppedField
from edge_server.fields.common.supervision import supervising_views, without_views
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.training_schedule import BETA1, BETA2, StepBudget, StepTimer, step_key
from edge_server.fields.common.view_outliers import LEAST_VIEWS, refuse, usual_error
from edge_server.fields.common.view_store import SETTLED_STEPS, Arrays, same_views
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.densification import GaussianCloud, densify_and_prune
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, adam_step, clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, BLOCK, COLOR, OPACITY, QUATERNION, SCALE, TILE
from edge_server.fields.splat.kernels.rasterize import Loss, train_tiles
from edge_server.fields.splat.motion import (
    LONGEST_S,
    SceneChange,
    changed_tiles,
    extrapolate,
    release_left_behind,
    reseed,
    track,
    unweighted_tiles,
    weighted_changes,
)
from edge_server.fields.splat.seeding import seed_gaussians
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.snapshot import SplatSnapshot
from freshfield.geometry import Pinhole

_AGES = 4096  # steps after which Adam's bias correction no longer matters
RESEED_AFTER = 30  # least number of steps between two reseedings
TRACKING_SHARE = 0.35  # largest share of an update that tracks what moved
CHANGED_SLOTS = 4  # largest number of views whose changed tiles one step trains on


class SplatField(SteppedField[SplatSnapshot]):
    """Gaussians that learn while they are in use. See ``SteppedField``."""

    name = "splat"
    shape = ("harmonics",)
    settings: SplatSettings
    _now_ns: int | None  # the instant of the Gaussians' parameters
    _given: tuple[View, ...]  # views of the last fit; they survive ``load_state``
    _refused: set[str]  # cameras whose newest view is refused
    _unsure: set[str]  # cameras whose newest view follows a refused one

    def __init__(self, settings: SplatSettings | None = None, pool: Pool | None = None) -> None:
        s = settings or SplatSettings()
        age = np.maximum(np.arange(_AGES), 1)
        decay = np.maximum(np.minimum(s.settle_after / age, 1.0), s.rate_settled)
        corrections = np.stack([1.0 / (1.0 - BETA1**age), 1.0 / (1.0 - BETA2**age), decay], axis=-1)
        self._corrections = corrections.astype(np.float32)
        super().__init__(s, pool)

    # --- the protocol -------------------------------------------------------------------------

    def _begin_fit(self, views: Sequence[View], step_budget: StepBudget, budget: Budget) -> tuple[Step, int, int]:
        with self._lock:
            change = self._ingest(views)
        if change is None:
            return self._one_step, 0, 0
        return self._one_step, *self._follow_motion(change, step_budget, self._tracking_steps(budget))

    def _refused_among(self, views: Sequence[View]) -> tuple[str, ...]:
        return tuple(v.camera for v in views if v.camera in self._refused)

    def _live(self) -> SplatSnapshot:
        return SplatSnapshot(
            box=self.view_store.box or UNIT_BOX,
            gaussians=self.cloud.gaussians(),
            background=self.view_store.background(),
            cameras=self.view_store.views,
            pool=self.pool,
            step=self.step,
            now_ns=self._now_ns,
            planar=self.settings.planar,
        )

    def _run_kernels(self, pool: Pool) -> None:
        tiny = replace(self.settings, gaussians=64, start=8, min_views=1, seed_cells=8, contracted=False)
        camera = Pinhole.from_fov(32, 32, 60.0)
        pose = np.eye(4)
        pose[2, 3] = -3.0
        for channels in (3, 4):
            field = SplatField(tiny, pool)
            for k in range(3):  # something moves: it is found, then tracked, and new Gaussians are seeded
                image = np.full((32, 32, channels), 128, np.uint8)
                image[8:16, 8 + 2 * k : 16 + 2 * k, :3] = 255
                field.fit([View("warm-up", image, pose, camera, k * 10**8)], Budget(steps=RESEED_AFTER))
            field.render(pose, camera)

    # --- state --------------------------------------------------------------------------------

    def _counters(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "grown": self._grown,
            "dropped": self.dropped,
            "now_ns": self._now_ns,
            "given": [v.camera for v in self._given],
            "refused": sorted(self._refused),
            "unsure": sorted(self._unsure),
            "reseeded": self._reseeded,
            "unjudged": sorted(self._unjudged),
            "errors": self._errors,
        }

    def _arrays(self) -> Arrays:
        return {f.name: getattr(self.cloud, f.name) for f in fields(self.cloud)}

    def _load(self, meta: dict[str, Any], state: Arrays) -> None:
        self.cloud = _gaussians_of(self.settings, state)
        self._grown = int(meta["grown"])
        self._now_ns = None if meta["now_ns"] is None else int(meta["now_ns"])
        self._given = tuple(self.view_store.memory[camera].view for camera in meta.get("given", ()))
        self._refused, self._unsure = (set(meta.get(key, ())) for key in ("refused", "unsure"))
        self._unjudged.update(meta.get("unjudged", ()))
        self._errors.update(meta.get("errors", {}))
        self._reseeded = int(meta.get("reseeded", 0))

    # --- inside -------------------------------------------------------------------------------

    def _forget_parameters(self) -> None:
        self.step = 0
        self._grown = 0  # step of the last splitting and pruning
        self._step_time, self._tracking_time, self._reseed_time = StepTimer(), StepTimer(), StepTimer()
        self.cloud = GaussianCloud.empty(self.settings)
        self._raster, self._tracking_raster, self._render_raster = (RasterBuffers(self.pool) for _ in range(3))
        self._now_ns = None
        self._snapshot = None
        self._views: tuple[View, ...] = ()
        self._given = ()
        self._refused, self._unsure = set(), set()
        self._unjudged: set[str] = set()  # cameras whose newest view no step has judged yet
        self._errors: dict[str, float] = {}  # of each camera, when a step last saw it whole
        self._reseeded = 0  # step of the last reseeding
        self._epoch = -1

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self.settings.seed, self.step, purpose]))

    def _ingest(self, views: Sequence[View]) -> SceneChange | None:
        """Ingest new views; seed the Gaussians if there are none. Returns what changed, if anything moved."""
        change = None
        if not same_views(views, self._views):
            memory = self.view_store.memory
            news = {v.camera for v in views if v.camera not in memory or memory[v.camera].view is not v}
            known = _equal(views, self._given)  # decoded again, or the first views after ``load_state``
            intake = self.view_store.add(views)
            if intake.box_changed:
                self._forget_parameters()
            assert self.view_store.box is not None
            now_ns = max(v.shows_ns for v in views)
            elapsed_s = 0.0 if self._now_ns is None else (now_ns - self._now_ns) / 1e9
            self._now_ns = now_ns
            self._cams = camera_rows(
                [v.camera_to_world for v in views],
                [v.intrinsics for v in views],
                self.view_store.box,
                [max((v.shows_ns - now_ns) / 1e9, -LONGEST_S) for v in views],
            )
            if not known:
                self._before = self.cloud.params[:, :3].copy()
                extrapolate(self.cloud, elapsed_s, any(memory[v.camera].moved is not None for v in views))
                self._await_judgement(views, news)
            self._packed = intake.data
            data = self._leave_out_refused(views)
            moved = weighted_changes(
                [None if v.camera in self._unsure else memory[v.camera].moved for v in views], data
            )
            self._changed = changed_tiles(moved)
            self._views, self._given, self._epoch = tuple(views), tuple(views), -1
            fresh = any(v.camera in news for k, v in enumerate(views) if k in self._asked)
            if len(self.cloud) and fresh and not known and any(m is not None for m in moved):
                change = SceneChange(
                    self.view_store.box,
                    views,
                    data,
                    moved,
                    self._changed,
                    self._cams,
                    self.view_store.background(),
                    elapsed_s,
                    len(self._asked),
                )
        if len(self.cloud) == 0:
            self._seed()
        self._snapshot = None
        return change

    def _tracking_steps(self, budget: Budget) -> int:
        """How many steps track motion: ``follow``, or fewer in a short budget."""
        most = self.settings.follow
        if budget.steps is not None:
            return min(most, int(TRACKING_SHARE * budget.steps))
        assert budget.seconds is not None
        usual_s = self._tracking_time.seconds
        return min(most, int(TRACKING_SHARE * budget.seconds / usual_s)) if usual_s else most

    def _await_judgement(self, views: Sequence[View], news: set[str]) -> None:
        """New views are judged by the first step that sees them whole. The view after a refused one says
        nothing about motion, because it would be compared with a wrong one."""
        self._unsure = (self._unsure - news) | (self._refused & news)
        self._refused -= news
        given = {v.camera for v in views}
        judges = self.settings.refuse_beyond > 0.0 and self.step >= SETTLED_STEPS
        self._unjudged = (self._unjudged | news) & given if judges else set()

    def _leave_out_refused(self, views: Sequence[View]) -> Views:
        """Set what the kernels read: the packed views, the refused ones without weight."""
        refused = np.array([v.camera in self._refused for v in views])
        self._data = without_views(self._packed, refused)
        # All of them, where every weight is 0.
        self._asked = supervising_views(self._data) or list(range(len(views)))
        self._epoch = -1  # their order is drawn anew
        return self._data

    def _judge_step(self, picked: NDArray[np.int64], errors: Sequence[float]) -> bool:
        """Judge the views of a step by its errors, before it is applied. Returns whether any is refused.

        errors: of each picked view, the median over its tiles of the root mean square error, in [0, 1].
        """
        seen = [(int(k), self._views[k].camera, error) for k, error in zip(picked, errors)]
        new = [one for one in seen if one[1] in self._unjudged]
        self._errors.update((camera, error) for _, camera, error in seen)
        if not new:
            return False
        given, beyond = {v.camera for v in self._views}, self.settings.refuse_beyond
        known = [error for camera, error in self._errors.items() if camera in given]
        self._unjudged -= {camera for _, camera, _ in new}
        if len(known) < LEAST_VIEWS:
            return False
        refused = self._refused & given
        for k, camera, error in new:
            few = 4 * (len(refused) + 1) <= len(given)
            if refuse(self.view_store.memory[camera], error, usual_error(known, beyond), beyond, few):
                refused.add(camera)
                self._changed[k] = None
        if refused <= self._refused:
            return False
        self._refused |= refused
        self._leave_out_refused(self._views)
        return True

    def _follow_motion(self, change: SceneChange, pace: StepBudget, steps: int) -> tuple[int, int]:
        """Track what moved. Reseed where that is not enough, but only after some steps of learning since the
        last time: what is removed and seeded has to be learned. Returns pixels and pairs."""
        s, rays, samples = self.settings, 0, 0
        due = self.step - self._reseeded >= RESEED_AFTER
        with self._lock:
            tracking = track(self._tracking_raster, self.cloud, change, steps)
        then_s = self._reseed_time.seconds if due else 0.0
        while pace.begin_step(self._tracking_time, then_s=then_s) is not None:
            with self._lock:
                done = next(tracking, None)
            if done is None:
                break
            rays, samples = rays + done[0], samples + done[1]
            pace.end_step()
        if due:
            began = pace.elapsed_s()
            with self._lock:
                release_left_behind(self.pool, self.cloud, change, self._before)
                reseed(s, self._tracking_raster, self.cloud, change, self._rng(2))
                self._reseeded = self.step
            self._reseed_time.add(pace.elapsed_s() - began)
        with self._lock:
            self._snapshot = None
        return rays, samples

    def _choose_tiles(self, key: np.uint64) -> tuple[NDArray[np.int64], list[NDArray[np.uint8] | None]]:
        """The views of this step, and which of their tiles (None: all). key: random bits of the step."""
        s, n = self.settings, len(self._asked)
        slots = min(s.views_a_step, n)
        first = self.step * s.views_a_step
        if self._epoch != first // n:
            self._epoch = first // n
            pick = np.random.SeedSequence([s.seed, self._epoch, 4])
            self._order = np.random.default_rng(pick).permutation(n)
        picked = np.array(self._asked, np.int64)[self._order[(first + np.arange(slots)) % n]]
        moving = [k for k, tiles in enumerate(self._changed) if tiles is not None]
        if moving and int(key) * 2.0**-64 < s.changed_share:
            some = np.array(moving)[(first + np.arange(min(CHANGED_SLOTS, len(moving)))) % len(moving)]
            return some, [self._changed[k] for k in some]
        return picked, [None] * slots

    def _one_step(self, progress: float) -> tuple[float | None, int, int, int]:
        """One optimizer step at ``progress`` of the fit, in [0, 1].

        Returns the mean squared error (None where a view was refused and the step left out), pixels, pairs of
        a Gaussian and a tile, and how many tiles and gradients were not finite.
        """
        s, box = self.settings, self.view_store.box
        assert box is not None
        key = step_key(s.seed, self.step)
        picked, wanted = self._choose_tiles(key)
        cams, cloud = np.ascontiguousarray(self._cams[picked]), self.cloud
        gaussians = cloud.gaussians()
        raster = self._raster
        raster.project_and_bin(cams, gaussians, wanted)
        tasks = raster.tasks()
        losses = np.zeros((len(tasks), 3))
        loss = Loss(
            absolute=s.loss == "l1",
            dssim=np.float32(s.dssim),
            background=self.view_store.background(),
            random=s.background == "random",
            key=key,
        )
        self.pool.run(
            train_tiles,
            self._data,
            picked.astype(np.int64),
            tasks,
            raster.columns,
            raster.projected,
            raster.lists,
            loss,
            raster.memory,
            raster.saved,
            raster.sums,
            losses,
        )
        pixels, room = TILE * TILE * len(tasks), raster.lists.pair.shape[1]
        pairs = sum(min(needed, room) for needed in raster.lists.needed[: len(picked)].tolist())
        if wanted[0] is None or wanted[0] is not self._changed[picked[0]]:  # not of changed tiles alone
            by_tile = np.sqrt(losses[:, 1] / (3 * TILE * TILE))
            by_view = [float(np.median(by_tile[tasks[:, 0] == b])) for b in range(len(picked))]
            if self._judge_step(picked, by_view):
                self._finish_step()
                return None, pixels, pairs, 0
        dropped = np.zeros(-(-len(cloud) // BLOCK) + 1, np.int64)
        self.pool.run(
            adam_step,
            cams,
            gaussians,
            len(cloud),
            raster.projected,
            raster.lists.own_first,
            raster.lists.own_count,
            raster.sums,
            cloud.optimizer_state(),
            self._adam_parameters(progress),
            dropped,
        )
        if s.planar:
            self._planar_step(int(picked[0]))
        _, square, broken = losses.sum(axis=0).tolist()
        if broken:
            self._repair()
        self._finish_step()
        return square / (3 * pixels), pixels, pairs, int(broken) + int(dropped.sum())

    def _planar_step(self, view: int) -> None:
        """Flatten the Gaussians, and align them with the normals that ``view`` shows."""
        from edge_server.fields.splat.planar import align, flatten

        s = self.settings
        flatten(self.cloud, s)
        if s.align and self.step % s.align_every == 0:
            camera = np.ascontiguousarray(self._cams[[view]])
            self._render_raster.project_and_bin(camera, self.cloud.gaussians(), [None], differentiate=False)
            align(self.cloud, s, self._render_raster, camera[0], self._views[view].intrinsics)

    def _finish_step(self) -> None:
        """Count a step; densify when it is time, but not before every view has had a step."""
        s = self.settings
        self.step += 1
        if self.step - self._grown >= max(s.densify_every, -(-len(self._asked) // s.views_a_step)):
            self._grow()

    def _adam_parameters(self, progress: float) -> AdamParameters:
        s, box = self.settings, self.view_store.box
        assert box is not None
        rates = np.full(BASE + 3 * (s.harmonics - 1), 0.1 * s.rate_color)
        rates[:SCALE] = s.rate_position * box.pixel_m / box.radius_m
        rates[SCALE:QUATERNION] = s.rate_scale
        rates[QUATERNION:OPACITY] = s.rate_rotation
        rates[OPACITY], rates[COLOR:BASE] = s.rate_opacity, s.rate_color
        return AdamParameters(
            rates=(rates * s.rate_end**progress).astype(np.float32),
            corrections=self._corrections,
            beta1=np.float32(BETA1),
            beta2=np.float32(BETA2),
            epsilon=np.float32(s.epsilon),
            fade=np.float32(s.fade),
            largest=s.scale_bounds[0],
            thinnest=s.scale_bounds[1],
        )

    def _grow(self) -> None:
        s = self.settings
        self._protect_unsupervised()
        densify_and_prune(self.cloud, s, float(self._data.size[:, 0].mean()), self._rng(5))
        if s.opacity_reset and self.step // s.opacity_reset != self._grown // s.opacity_reset:
            # To a tenth: what the views need recovers, the rest is pruned (Kerbl et al. 5.2).
            self.cloud.params[:, OPACITY] = np.minimum(self.cloud.params[:, OPACITY], np.float32(-2.2))
        self._grown = self.step
        if len(self.cloud) == 0:  # everything was pruned: start again
            self._seed()

    def _protect_unsupervised(self) -> None:
        """Count as seen what is visible in tiles with pixels of weight 0, or in the last view of a camera
        without a current view: that a Gaussian has no gradient there does not mean that it is not needed."""
        cloud, box = self.cloud, self.view_store.box
        assert box is not None
        tiles = unweighted_tiles(self._data)
        slots = [k for k, mask in enumerate(tiles) if mask is not None]
        given = {view.camera for view in self._views}
        others = [view for view in self.view_store.views if view.camera not in given]
        if not slots and not others:
            return
        cams = np.concatenate(
            [self._cams[slots], camera_rows([v.camera_to_world for v in others], [v.intrinsics for v in others], box)]
        )
        wanted = [tiles[k] for k in slots] + [None] * len(others)
        self._render_raster.project_and_bin(cams, cloud.gaussians(), wanted, differentiate=False)
        shows = (self._render_raster.lists.own_count[: len(cams), : len(cloud)] > 0).any(axis=0)
        cloud.looks[shows] = np.maximum(cloud.looks[shows], 1.0)

    def _seed(self) -> None:
        """Seed the first Gaussians from the current views."""
        assert self.view_store.box is not None
        s = self.settings
        first, weight = min(s.start, s.gaussians), self._data.weight
        self.cloud = GaussianCloud.new(
            seed_gaussians(s, self.pool, self.view_store.box, self._views, None, weight, first, self._rng(1))
        )

    def _repair(self) -> None:
        """Replace what is not finite; such Gaussians become invisible and are pruned."""
        clamp_gaussians(self.cloud.params, *self.settings.scale_bounds)
        for array in (self.cloud.m, self.cloud.v):
            np.nan_to_num(array, copy=False, nan=0.0, posinf=0.0, neginf=0.0)


def _gaussians_of(settings: SplatSettings, state: Arrays) -> GaussianCloud:
    """The Gaussians in ``state``. ValueError: they do not fit ``settings``."""
    empty = GaussianCloud.empty(settings)
    count = len(state["params"]) if "params" in state else 0
    arrays = {}
    for f in fields(GaussianCloud):
        mine = getattr(empty, f.name)
        shape = (count, *mine.shape[1:])
        if f.name not in state or state[f.name].shape != shape or state[f.name].dtype != mine.dtype:
            raise ValueError(f"the state lacks {f.name!r}, {mine.dtype} of shape {shape}")
        arrays[f.name] = np.array(state[f.name])
    if count > settings.gaussians:
        raise ValueError(f"the state has {count} Gaussians, this field holds {settings.gaussians} at most")
    return GaussianCloud(**arrays)


def _equal(a: Sequence[View], b: Sequence[View]) -> bool:
    """Whether two sets of views have the same content."""
    return len(a) == len(b) and all(
        x is y
        or (
            x.camera == y.camera
            and x.shows_ns == y.shows_ns
            and x.intrinsics == y.intrinsics
            and np.array_equal(x.camera_to_world, y.camera_to_world)
            and np.array_equal(x.image, y.image)
        )
        for x, y in zip(a, b)
    )
