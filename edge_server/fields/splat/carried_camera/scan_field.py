"""The Gaussian field of a scan: many views, usually of one camera that is carried about, of a scene that stands still.

First Gaussians lie on measured depth, where views bring some, else on depth that a plane sweep of the views finds.
Further ones come where the residual is large, at the depth that is rendered there. Each learns at a rate that falls
with its own age. With ``refine``, each view has an exposure and a correction of its pose: both follow from sums that a
step makes anyway.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Correction, View
from edge_server.fields.common.background import foreground_mask
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.cameras.pose_corrections import PoseCorrections, normal_matrix
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.view_store import Arrays, same_views
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.carried_camera.exposures import Exposures
from edge_server.fields.splat.carried_camera.frame_stereo import sweep_depth
from edge_server.fields.splat.carried_camera.refined_cameras import RefinedCameras, ScanSnapshot
from edge_server.fields.splat.carried_camera.seeds_on_depth import discs, filled, quadtree, usable_depth
from edge_server.fields.splat.densification import GaussianCloud, opacity
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters, age_corrections, clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, COLOR, QUATERNION, SCALE, SH_COLUMNS
from edge_server.fields.splat.kernels.rasterize import LOSSES, MOMENTS, Target, render_tiles
from edge_server.fields.splat.splat_constants import PRUNE_OPACITY
from freshfield.geometry import Pinhole

T = TypeVar("T")


class Shown(NamedTuple):
    """What a view's camera sees of the field. color: float32 (H, W, 3), at the field's exposure. depth: float32
    (H, W), along the optical axis, meters, 0 where empty. opacity: float32 (H, W)."""

    color: NDArray[np.float32]
    depth: NDArray[np.float32]
    opacity: NDArray[np.float32]


class ScanField(StillField):
    """See ``StillField``."""

    full_steps: float = tuned.FULL_STEPS  # see ``PoseCorrections``

    # --- cameras ------------------------------------------------------------------------------

    def correction(self, view: View) -> Correction | None:
        """See ``fields.RefinesCameras``."""
        with self._lock:
            return self._live().correction(view)

    def _live(self) -> ScanSnapshot:
        plain = super()._live()
        mine = None if self._rigid is None else RefinedCameras(self._poses, self._exposures)
        return ScanSnapshot(**{f.name: getattr(plain, f.name) for f in fields(plain)}, cameras=mine)

    def _pose_of(self, view: View) -> NDArray[np.float64]:
        return super()._pose_of(view) if self._rigid is None else self._poses.pose(view)

    def _learn_camera(self, view: int, losses: NDArray[np.float64]) -> None:
        if self._rigid is None:
            return
        now, box = self._views[view], self.view_store.box
        assert box is not None
        if self.step >= tuned.EXPOSED_FROM:
            self._exposures.learn(now.camera, losses[:, LOSSES:].sum(axis=0).reshape(3, MOMENTS))
        gradient = -self._rigid / np.array([box.radius_m] * 3 + [1.0] * 3)
        self._poses.descend(now, gradient, *self._aims[view])
        if self.step % tuned.GAUGE_EVERY == 0:
            self._exposures.center()
            self._poses.take_back(tuned.GAUGE_SHARE)

    def _target(self, view: int) -> Target:
        target = super()._target(view)._replace(dissimilarity=np.float32(tuned.DISSIMILARITY))
        if self._rigid is None:
            return target
        return target._replace(exposure=self._exposures.row(self._views[view].camera))

    # --- what StillField asks for -------------------------------------------------------------

    def _forget_parameters(self) -> None:
        super()._forget_parameters()
        box = self.view_store.box
        distance_m = 1.0 if box is None else box.distance_m
        if box is not None and box.contracted and self.settings.near_m is None:
            self.view_store.box = replace(box, near_m=tuned.NEAR_SHARE * distance_m)
        self._poses = PoseCorrections(tuned.MOST_SHARE * distance_m, tuned.MOST_DEG, self.full_steps)
        self._exposures = Exposures()
        self._seen_m = 0.0  # usual depth of what cameras see, where frames tell it and none measure it
        self._given: tuple[View, ...] = ()  # the newest views, with depth as it came
        self._rigid = np.zeros(6) if self.settings.refine else None
        self._rule: AdamParameters | None = None

    def _ingest(self, views: Sequence[View]) -> None:
        if same_views(views, self._given):
            return super()._ingest(self._views)
        self._given = tuple(views)
        views = [replace(view, depth=usable_depth(view.depth)) for view in views]
        super()._ingest(views)
        self._rule = None
        if self._rigid is not None:
            assert self.view_store.box is not None
            seen_m = self._seen_m or self.view_store.box.distance_m
            self._aims = [aim_of(v, seen_m) for v in views]

    def adam_parameters(self, progress: float) -> AdamParameters:
        if self._rule is None:
            rule = super().adam_parameters(0.0)
            box = self.view_store.box
            assert box is not None
            rates = rule.rates.copy()
            rates[:SCALE] = tuned.POSITION_PX * box.pixel_m / box.radius_m
            rates[COLOR:BASE] = tuned.COLOR
            self._rule = rule._replace(rates=rates, corrections=age_corrections(tuned.SETTLE_STEPS))
        return self._rule

    def _counters(self) -> dict[str, Any]:
        return {
            **super()._counters(),
            "poses": self._poses.meta(),
            "exposures": self._exposures.meta(),
            "seen_m": self._seen_m,
        }

    def _load(self, meta: dict[str, Any], state: Arrays) -> None:
        super()._load(meta, state)
        self._poses.load(meta["poses"])
        self._exposures.load(meta["exposures"])
        self._seen_m = float(meta["seen_m"])

    def _run_kernels(self, pool: Pool) -> None:
        super()._run_kernels(pool)
        lens, beside = Pinhole.from_fov(16, 16, 60.0), np.eye(4)
        beside[0, 3] = 0.1  # of 1 m: parallax enough
        views = [View("", np.zeros((16, 16, 3), np.uint8), pose, lens) for pose in (np.eye(4), beside)]
        sweep_depth(views[0], views[1:], 1.0, pool)

    # --- Gaussians ----------------------------------------------------------------------------

    def _seed(self) -> None:
        """Seed on measured depth, in the order of the views; without any, on what a plane sweep finds, views spread
        over all first; without that either, where the cameras agree on colors."""
        measured = [view for view in self._views if view.depth is not None]
        if measured:
            self._seed_on(_some(measured, tuned.SEED_VIEWS), nearer=True)
        elif not self._seed_swept():
            super()._seed()

    def _seed_swept(self) -> bool:
        """Seed on depth that views tell of each other, until further views show hardly anything new or there is no room
        for more: to sweep all of them takes seconds before the first step. Returns False if poses tell no depth."""
        self.cloud = GaussianCloud.empty(self.settings)
        swept: list[View] = []
        new: list[float] = []
        for view in self._sweep_views():
            shown = self._look(view)
            _, there = self._as_rendered(view)
            new.append(float((there & (shown.opacity < tuned.COVERED)).sum() / max(there.sum(), 1)))
            self._add(self._seeds_of(view, shown, nearer=False))
            swept.append(view)
            settled = len(new) >= tuned.SWEPT_LAST and np.mean(new[-tuned.SWEPT_LAST :]) < tuned.SWEPT_NEW
            if settled or len(self.cloud) >= self._most():
                break
        self._learn_distance(swept)
        return len(self.cloud) > 0

    def _seed_on(self, views: Sequence[View], nearer: bool) -> None:
        """Replace the Gaussians by seeds on the depth of ``views``. nearer: see ``_seeds_of``."""
        self.cloud = GaussianCloud.empty(self.settings)
        for view in views:
            self._add(self._seeds_of(view, nearer=nearer))

    def _sweep_views(self) -> Iterator[View]:
        """Views, spread ones first, with depth that others tell, see ``sweep_depth``: none where poses tell nothing.
        Poses are those given: a field without good depth refines them to fit its errors."""
        box, some = self.view_store.box, _some(self._views, tuned.SWEPT_VIEWS)
        assert box is not None
        found = False
        for distance_m in (box.distance_m, self._distance_by_path()):
            if found or distance_m < box.distance_m:
                continue
            for k in _spread_first(len(some)):
                depth = usable_depth(sweep_depth(some[k], self._views, distance_m, self.pool))
                if depth is not None:
                    found = True
                    yield replace(some[k], depth=depth)

    def _learn_distance(self, views: Sequence[View]) -> None:
        """Learn from depth how far away is what cameras see."""
        seen_m = [np.median(v.depth[v.depth > 0]) for v in views if v.depth is not None]
        self._seen_m = float(np.median(seen_m)) if seen_m else self._seen_m

    def _distance_by_path(self) -> float:
        """How far away what cameras see may be, by how far apart they are, whatever the unit of their poses: one camera
        alone tells no distance, and a guess in meters is too near for poses in millimeters."""
        places = np.stack([view.camera_to_world[:3, 3] for view in self._views])
        spread = float(np.median(np.linalg.norm(places - places.mean(axis=0), axis=1)))
        return spread / float(np.tan(np.deg2rad(tuned.SWEPT_ANGLES_DEG[1])))

    def _seeds_of(self, view: View, shown: Shown | None = None, nearer: bool = True) -> NDArray[np.float32]:
        """Gaussians where the field shows no surface.

        shown: what the view's camera sees; None: it is rendered here.
        nearer: also where what a view measures lies before what is shown. Sensors hardly find surfaces that are none,
            sweeps do.
        """
        assert view.depth is not None
        shown, depth = shown or self._look(view), view.depth
        behind = shown.depth > depth * np.float32(1.0 + tuned.BEHIND_SHARE) + np.float32(tuned.BEHIND_M)
        wanted = (shown.opacity < tuned.COVERED) | (behind & (depth > 0) & nearer)
        color, there = self._as_rendered(view)
        leaves = quadtree(color, wanted & there, tuned.CELLS, tuned.DETAIL)
        at = tuple(np.minimum(k + leaves.side // 2, n - 1) for k, n in zip((leaves.row, leaves.column), depth.shape))
        alpha = np.where(depth[at] > 0, np.float32(tuned.OPACITY), np.float32(tuned.GUESSED_OPACITY))
        return discs(color, filled(depth), leaves, view.intrinsics, self._from_origin(view), tuned.WIDTH, alpha)

    def _grow_if_due(self) -> None:
        if self.step % tuned.PRUNE_EVERY == 0:
            self.cloud.keep(opacity(self.cloud.params) >= PRUNE_OPACITY)
            if not len(self.cloud):
                self._seed()
        if self.step % tuned.GROW_EVERY == 0 and len(self.cloud) < self._most():
            self._grow()

    def _grow(self) -> None:
        """Insert Gaussians where the view that comes next shows what the field does not: at the depth that is rendered
        there, or beside it where nothing is."""
        view = self._views[self._next_view()]
        if min(view.image.shape[:2]) < tuned.LEAST_SIDE:
            return
        shown = self._look(view)
        color, there = self._as_rendered(view)
        error = cv2.blur(np.abs(shown.color - color).mean(axis=2), (3, 3))
        depth = shown.depth
        if view.depth is not None:
            agrees = np.abs(view.depth - depth) < tuned.AGREES * depth
            depth = np.where(agrees, np.minimum(view.depth, depth), depth)
        depth = filled(np.where(shown.opacity >= tuned.COVERED, depth, np.float32(0.0)))
        wanted = (error > tuned.GROWN_ERROR) & (depth > 0) & there
        leaves = quadtree(color, wanted, tuned.GROWN_CELLS, tuned.GROWN_DETAIL)
        if len(leaves.row) > tuned.GROWN_MOST:
            drawn = np.sort(self._rng(6).choice(len(leaves.row), tuned.GROWN_MOST, replace=False))
            leaves = type(leaves)(*(part[drawn] for part in leaves))
        nearer = np.float32(1.0 - tuned.NEARER)
        alpha = np.full(len(leaves.row), tuned.GROWN_OPACITY, np.float32)
        pose = self._from_origin(view)
        self._add(discs(color, depth * nearer, leaves, view.intrinsics, pose, tuned.GROWN_WIDTH, alpha))

    def _origin_m(self) -> NDArray[np.float64]:
        """Origin (3,) of new Gaussians in the world, near the scene: from a map grid's, float32 meters are coarse."""
        assert self.view_store.box is not None
        return np.round(np.asarray(self.view_store.box.center_m) / tuned.ORIGIN_GRID_M) * tuned.ORIGIN_GRID_M

    def _from_origin(self, view: View) -> NDArray[np.float64]:
        """Pose (4, 4) of a view's camera, from ``_origin_m``."""
        pose = self._pose_of(view).copy()
        pose[:3, 3] -= self._origin_m()
        return pose

    def _add(self, params: NDArray[np.float32]) -> None:
        """Add Gaussians given in meters from ``_origin_m``, as many as there is room for."""
        params = params[: max(self._most() - len(self.cloud), 0)]
        box = self.view_store.box
        assert box is not None
        if not len(params):
            return
        params = params.copy()
        params[:, :3] = box.normalise(params[:, :3].astype(np.float64) + self._origin_m())
        params[:, SCALE:QUATERNION] -= np.float32(np.log(box.radius_m))
        further = np.zeros((len(params), SH_COLUMNS * self.settings.sh_degree), np.float32)
        params = np.concatenate([params, further], axis=1)
        clamp_gaussians(params)
        self.cloud.add(GaussianCloud.new(params))

    def _most(self) -> int:
        """The largest number of Gaussians."""
        return self.settings.gaussians

    def _look(self, view: View, halvings: int = 0, pose: NDArray[np.float64] | None = None) -> Shown:
        """Render the field from a view's corrected pose or from ``pose``, (4, 4), at its size or less."""
        box, lens = self.view_store.box, view.intrinsics.halved(halvings)
        assert box is not None
        h, w = lens.height, lens.width
        color, depth, alpha = (np.zeros((h, w, *more), np.float32) for more in ((3,), (), ()))
        if len(self.cloud):
            raster, pose = self._render_raster, self._pose_of(view) if pose is None else pose
            raster.project_and_bin(camera_rows([pose], [lens], box), self.cloud.params, False)
            self.pool.run(render_tiles, raster.raster, self.view_store.background(), color, depth, alpha)
        return Shown(color, depth * np.float32(box.radius_m), alpha)

    def _as_rendered(self, view: View) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """A view's image (H, W, 3) at the field's exposure, and which of its pixels supervise and show something."""
        gain, bias = self._exposures.of(view.camera)
        color = (view.image[..., :3] * (1.0 / 255.0) - bias) / gain
        there = foreground_mask(view.image, None)
        return color.astype(np.float32), there if view.weight is None else there & (view.weight > 0)


def _some(items: Sequence[T], most: int) -> list[T]:
    """At most so many, spread evenly."""
    return [items[k] for k in np.unique(np.linspace(0, len(items) - 1, most).astype(int))] if items else []


def _spread_first(count: int) -> list[int]:
    """0 to ``count`` - 1, in an order whose every beginning is spread (van der Corput's)."""
    bits = max(count - 1, 0).bit_length()
    reversed_bits = (sum((k >> bit & 1) << (bits - 1 - bit) for bit in range(bits)) for k in range(1 << bits))
    return list(dict.fromkeys(count * k >> bits for k in reversed_bits)) if count else []


def aim_of(view: View, seen_m: float) -> tuple[NDArray[np.float64], float]:
    """What ``PoseCorrections.descend`` needs of a view: the normal matrix, and the shift of a pixel in meters.

    seen_m: depth, where none is known."""
    depth = None if view.depth is None else filled(view.depth)
    if depth is None or not depth.min() > 0:
        depth = np.full(view.image.shape[:2], seen_m, np.float32)
    return normal_matrix(view, depth), float(np.median(depth)) / view.intrinsics.fx


make = ScanField
