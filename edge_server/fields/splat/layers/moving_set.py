"""The moving set: Gaussians attached to anchors, learned over the plates of the cameras that see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.field_state import give_attributes, take_attributes
from edge_server.fields.common.kernels.visual_hull import count_points
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.densification import GaussianCloud, densify_and_prune, opacity
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters
from edge_server.fields.splat.kernels.rasterize import Target
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.kernels.align import align_view
from edge_server.fields.splat.layers.motion import Motion, ViewRow
from edge_server.fields.splat.layers.observations import FixedCamera, Observation, Observations
from edge_server.fields.splat.seeding import seed_gaussians
from edge_server.fields.splat.settings import SplatSettings

Arrays = dict[str, NDArray]
_KEPT = ("anchor", "share", "capacity_factor", "steps", "_grown", "_draws")  # of a state


class MovingSet:
    """Gaussians, with parameters at zero displacement of the anchors.

    cloud: the Gaussians. motion: displacements of the anchors.
    anchor, share: int64 and float32 (N, 3), see ``Motion.attach``.
    capacity_factor: factor by which the capacity exceeds that of a usual foreground.
    """

    def __init__(self, settings: SplatSettings, pool: Pool, box: SceneBox, seed: int) -> None:
        self.settings, self.pool, self.box, self.seed = settings, pool, box, seed
        self.cloud = GaussianCloud.empty(settings)
        self.anchor, self.share = np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32)
        self.capacity_factor, self.steps, self._grown, self._draws = 1.0, 0, 0, 0
        self.motion, self.few = Motion(box.radius_m, self._rng(0)), False
        self.raster = RasterBuffers(pool)

    def __len__(self) -> int:
        return len(self.cloud)

    @property
    def alive(self) -> bool:
        """Whether there are enough Gaussians to be aligned."""
        return len(self.cloud) >= tuned.LEAST_ALIVE

    @property
    def capacity(self) -> int:
        """Largest number of Gaussians."""
        return round(tuned.GAUSSIANS * (1.0 + (self.capacity_factor - 1.0) / tuned.GAUSSIANS_SLOWER))

    def follow_foreground(self, share: float) -> None:
        """Let the capacity follow the foreground's share of the pixels: up at once, down slowly."""
        now = min(max(share / tuned.USUAL_SHARE, 1.0), tuned.MOST_FOREGROUND)
        self.capacity_factor = max(tuned.FOREGROUND_DECAY * self.capacity_factor, now)

    def bind(self, cameras: int) -> None:
        """Choose the motion prior, by the number of cameras."""
        self.few = cameras <= tuned.FEW_CAMERAS
        bounds = tuned.ACCELERATION_M_PER_S2, tuned.NEIGHBOR_M_PER_S
        if self.few:
            few = tuned.FEW_ACCELERATION_M_PER_S2, tuned.FEW_NEIGHBOR_M_PER_S
            bounds = min(few[0], self.box.distance_m), min(few[1], self.box.distance_m)
        self.motion.acceleration_m_per_s2, self.motion.neighbor_m_per_s = bounds

    # --- at an instant ------------------------------------------------------------------------

    def places(self, instant_s: float) -> NDArray[np.float32]:
        """Where the Gaussians are at an instant, float32 (N, 3), scene units."""
        return self.motion.displaced(self.cloud.params[:, :3], self.anchor, self.share, instant_s)

    def params(self, instant_s: float) -> NDArray[np.float32]:
        """The Gaussians' parameters at an instant, float32 (N, P), copied."""
        params = self.cloud.params.copy()
        params[:, :3] = self.places(instant_s)
        return params

    def distance_m(self, camera: FixedCamera, instant_s: float) -> float:
        """Distance from a camera to the middle of the Gaussians, meters."""
        places = self.places(instant_s)
        halves = [(len(places) - 1) // 2, len(places) // 2]
        middle = np.partition(places.T, halves, axis=1)[:, halves].mean(axis=1)  # four times as fast as np.median
        apart = middle - self.box.normalise(camera.view.camera_to_world[:3, 3])
        return float(np.linalg.norm(apart)) * self.box.radius_m

    # --- motion -------------------------------------------------------------------------------

    def align(self, observation: Observation, camera: FixedCamera) -> NDArray[np.float32]:
        """Linearize a frame's error in the anchors' displacements: fills its ``row`` and ``shown``. Returns
        the opacity of the moving set, float32 (H, W)."""
        assert camera.row is not None and observation.weight is not None and self.motion.anchors is not None
        instant_s = observation.instant_s
        params = self.params(instant_s)
        self.raster.project_and_bin(camera.row, params, differentiate=False)
        m, v, shown, opacity = align_view(
            self.raster,
            camera.row,
            params[:, :3],
            observation.view.image,
            camera.plate.picture,
            observation.weight,
            self.anchor,
            self.share,
            len(self.motion.anchors),
        )
        observation.row = ViewRow(instant_s, m, v, self.motion.at(instant_s).ravel())
        observation.shown = shown
        return opacity

    def run_kernels(self, camera: FixedCamera, observation: Observation) -> None:
        """Run every kernel once; the results do not matter."""
        params = np.zeros((tuned.LEAST_ALIVE, self.cloud.params.shape[1]), np.float32)
        self.cloud = GaussianCloud.new(params)
        self.renew_anchors(observation.instant_s)
        observation.weight = np.ones(observation.foreground.shape, np.float32)
        self.align(observation, camera)
        rates = np.zeros(params.shape[1], np.float32)
        self.train(observation, camera, AdamParameters(rates, np.ones((1, 3), np.float32), np.float32(1.0)))
        self._inside([params[:, :3]], [observation], {observation.camera: camera}, 1)
        assert observation.row is not None
        self.motion.slide(observation.instant_s + 1.0 / tuned.KNOTS_PER_S)
        self.motion.solve([observation.row])

    # --- appearance ---------------------------------------------------------------------------

    def train(self, observation: Observation, camera: FixedCamera, parameters: AdamParameters) -> int:
        """One optimizer step on one frame, over the camera's plate. Returns pairs of Gaussian and tile."""
        assert camera.row is not None and observation.weight is not None
        raster, cloud = self.raster, self.cloud
        params = self.params(observation.instant_s)
        before = params[:, :3].copy()
        raster.project_and_bin(camera.row, params)
        raster.train(_over_plate(observation, camera))
        raster.step(camera.row, params, cloud.optimizer_state(), parameters)
        rest = cloud.params[:, :3] + (params[:, :3] - before)
        cloud.params[:] = params
        cloud.params[:, :3] = rest
        self.steps += 1
        if self.steps - self._grown >= tuned.DENSIFY_EVERY:
            self._grow(camera.view.intrinsics.width)
        return int(raster.lists.needed[0])

    def _grow(self, pixels: int) -> None:
        """Split and prune; split Gaussians keep their anchors."""
        self._grown = self.steps
        origin = densify_and_prune(self.cloud, self.capacity, pixels, self._rng(1))
        self.anchor, self.share = self.anchor[origin], self.share[origin]

    # --- seeding and removal -------------------------------------------------------------------

    def seeding_frames(self, observations: Observations, cameras: int) -> list[Observation]:
        """The frames of the newest knot that most cameras have seen; none if there is no such knot."""
        last = observations.newest_knot
        for share in tuned.CAMERA_SHARES:
            for knot in range(last, last - tuned.SEEDING_KNOTS, -1):
                found = observations.of_knots(knot, knot)
                if len(found) >= max(1, round(share * cameras)):
                    return found
        return []

    def remove_outside(
        self, frames: Sequence[Observation], cameras: dict[str, FixedCamera], measured: bool = False
    ) -> None:
        """Remove the Gaussians that lie outside the foregrounds that should contain them. If these are the majority,
        remove all, with their motion: new ones are then seeded at rest.

        measured: also remove those in front of a frame's measured depth.
        """
        if len(self.cloud):
            places = [self.places(o.instant_s) for o in frames]
            keep = self._inside(places, frames, cameras, tuned.KEEP_DILATION_PX) >= tuned.KEEP_INSIDE
            if keep.mean() < tuned.LOST_BELOW:
                keep[:] = False
                self.motion.forget()
            elif measured:
                from edge_server.fields.splat.layers.depth.body_depth import seen_through

                keep &= ~seen_through(places, frames, cameras, self.box)
            self._keep(keep)

    def seed_missing(self, frames: Sequence[Observation], cameras: dict[str, FixedCamera]) -> None:
        """Seed Gaussians in foreground that is rendered wrongly, according to the rendering of the moving set for each
        frame (``Observation.shown``)."""
        missing = [
            o.foreground & o.shown_wrongly(tuned.MISSING_ERROR) if len(self.cloud) > tuned.FEW else o.foreground
            for o in frames
        ]
        pixels = sum(int(mask.sum()) for mask in missing)
        count = min(int(tuned.SEEDS_A_PIXEL * pixels), self.capacity - len(self.cloud))
        if count <= 4:
            return
        instant_s = float(np.mean([o.instant_s for o in frames]))
        params = seed_gaussians(
            self.settings,
            self.pool,
            self.box,
            [o.view for o in frames],
            missing,
            np.zeros(0, np.float32),
            count,
            self._rng(2),
            [o.foreground for o in frames],
        )
        places, attached = [params[:, :3]] * len(frames), None
        if len(params) and self.motion.anchors is not None:
            attached = self._attach(params, instant_s)
            places = [self.motion.displaced(params[:, :3], *attached, o.instant_s) for o in frames]
        inside = self._inside(places, frames, cameras, tuned.SEED_DILATION_PX) >= tuned.SEED_INSIDE
        if attached is not None:
            attached = attached[0][inside], attached[1][inside]
        self._add(params[inside], attached, instant_s)

    def seed_at_depth(self, frames: Sequence[Observation], cameras: dict[str, FixedCamera]) -> None:
        """Seed Gaussians from frames with ``body_m``, the newest first. See ``body_depth.seed_at_depth``."""
        from edge_server.fields.splat.layers.depth.body_depth import seed_at_depth

        few = len(self.cloud) <= tuned.FEW
        for o in sorted(frames, key=lambda o: -o.instant_s):
            room = self.capacity - len(self.cloud)
            if o.body_m is None or room <= 0:
                continue
            params = seed_at_depth(o, cameras[o.camera], self.box, self.cloud.params.shape[1], few)
            if len(params) > room:
                params = params[np.sort(self._rng(4).choice(len(params), room, replace=False))]
            attached = None if self.motion.anchors is None else self._attach(params, o.instant_s)
            self._add(params, attached, o.instant_s)

    def _attach(self, params: NDArray[np.float32], instant_s: float) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Anchors and shares of Gaussians, whose parameters (N, P) at an instant become those at rest."""
        anchor, share = self.motion.attach(params[:, :3], instant_s)
        params[:, :3] -= self.motion.displaced(np.zeros_like(params[:, :3]), anchor, share, instant_s)
        return anchor, share

    def _add(
        self,
        params: NDArray[np.float32],
        attached: tuple[NDArray[np.int64], NDArray[np.float32]] | None,
        instant_s: float,
    ) -> None:
        """Add Gaussians. attached: see ``_attach``; None: there are no anchors yet, and they are chosen here."""
        if not len(params):
            return
        self.cloud.add(GaussianCloud.new(params))
        if attached is None:
            self.renew_anchors(instant_s)
        else:
            self.anchor = np.concatenate([self.anchor, attached[0]])
            self.share = np.concatenate([self.share, attached[1]])

    def renew_anchors(self, instant_s: float) -> None:
        """Choose anchors anew; parameters then hold at ``instant_s``. All frames must be aligned again."""
        if self.motion.anchors is not None:
            self.cloud.params[:, :3] = self.places(instant_s)
        places = self.cloud.params[:, :3]
        count = round((tuned.FEW_ANCHORS if self.few else tuned.ANCHORS) * self.capacity_factor)
        count = min(count, tuned.FEW_MOST_ANCHORS) if self.few else count
        count = min(count, max(1, len(places) // tuned.GAUSSIANS_AN_ANCHOR))
        self.motion.choose_anchors(places, opacity(self.cloud.params), count, instant_s)
        self.anchor, self.share = self.motion.attach(places, instant_s)

    def _keep(self, which: NDArray[np.bool_]) -> None:
        self.cloud.keep(which)
        self.anchor, self.share = self.anchor[which], self.share[which]

    def _inside(
        self,
        places: Sequence[NDArray[np.float32]],
        frames: Sequence[Observation],
        cameras: dict[str, FixedCamera],
        dilation_px: int,
    ) -> NDArray[np.float64]:
        """For each point, (N,): the share of the frames that see it in whose dilated foreground it lies.

        places: for each frame (N, 3), the points at its instant.
        dilation_px: side of the square by which foregrounds are dilated."""
        seen, inside = (np.zeros(len(places[0]), np.int32) for _ in range(2))
        square = np.ones((dilation_px, dilation_px), np.uint8)
        for points, o in zip(places, frames, strict=True):
            mask = cv2.dilate(o.foreground.astype(np.uint8), square)
            self.pool.run(count_points, cameras[o.camera].row, np.ascontiguousarray(points), mask, seen, inside)
        return inside / np.maximum(seen, 1)

    # --- state --------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Everything needed to continue bit for bit."""
        cloud = {f"cloud.{f.name}": getattr(self.cloud, f.name).copy() for f in fields(self.cloud)}
        motion = {f"motion.{name}": array for name, array in self.motion.state().items()}
        return {**cloud, **motion, **take_attributes(self, _KEPT)}

    def load_state(self, state: Arrays) -> None:
        """Continue from ``state``. KeyError: it lacks something."""
        self.cloud = GaussianCloud(*(np.array(state[f"cloud.{f.name}"]) for f in fields(GaussianCloud)))
        prefix = "motion."
        self.motion.load_state({n[len(prefix) :]: a for n, a in state.items() if n.startswith(prefix)})
        give_attributes(self, _KEPT, state)

    def _rng(self, purpose: int) -> np.random.Generator:
        self._draws += 1
        return np.random.default_rng(np.random.SeedSequence([self.seed, self._draws, purpose, 6]))


def _over_plate(observation: Observation, camera: FixedCamera) -> Target:
    """A frame as a training target, over the camera's plate, so that errors of the still field do not affect the moving
    set."""
    assert observation.weight is not None
    image = np.ascontiguousarray(observation.view.image)
    return Target(image, observation.weight, np.zeros(3, np.float32), camera.plate.picture)
