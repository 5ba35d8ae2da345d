"""The Gaussian field of fixed cameras: background plates, a still field and a moving set.

A view updates its camera's background plate; the rest is foreground, from which motion at the instant of capture is
estimated. Data flow one way: view, plate, foreground, motion, moving set, image. Once plates are known, moving objects
do not enter the still field.

A fit with a budget in seconds tracks motion in the calling thread only, in kernels too short to be divided, and trains
the still field in another thread. A fit with a budget in steps does both in turn, so that it can be repeated bit for
bit.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, FitReport, Rendering, View
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.field_state import all_or_nothing
from edge_server.fields.common.supervision import check_view
from edge_server.fields.common.threads.thread_pool import CallerPool, Pool, compile_kernels, shared_pool
from edge_server.fields.common.training_schedule import StepBudget, StepTimer
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.kernels.project import COLOR
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.layered_state import pack, unpack
from edge_server.fields.splat.layers.motion_tracker import MotionTracker
from edge_server.fields.splat.layers.moving_set import MovingSet
from edge_server.fields.splat.layers.observations import (
    FixedCamera,
    Observation,
    Observations,
    bumped_by,
    cameras_of,
    newest_of_each,
)
from edge_server.fields.splat.layers.snapshot import LayeredSnapshot, MovingSnapshot
from edge_server.fields.splat.layers.static_layer import StaticLayer
from edge_server.fields.splat.layers.static_supervision import StaticSupervision
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.snapshot import SplatSnapshot
from freshfield.geometry import Pinhole

if TYPE_CHECKING:
    from edge_server.fields.splat.layers.depth.network_depth import Network, NetworkDepth

log = logging.getLogger(__name__)

Arrays = dict[str, NDArray]


class LayeredField:
    """See ``fields.Field`` for the protocol.

    Until plates are known, with a single camera, and permanently if a camera moves or images are transparent, the
    still field learns from the views themselves. A camera that is knocked starts over at its new place.
    Call ``fit`` from one thread only; snapshots may be taken and rendered from any thread.

    beside_s: seconds that all fits have spent on work that a fit in seconds does in the other thread.
    """

    def __init__(self, settings: SplatSettings | None = None, pool: Pool | None = None) -> None:
        self.settings = settings or SplatSettings()
        self.pool = pool or shared_pool(self.settings.threads, self.settings.nice)
        self.caller = CallerPool()
        self.now = time.perf_counter  # the clock of budgets in seconds
        self.still = StillField(self.settings, self.pool)
        self.static = StaticLayer(self.still)
        self.beside_s = 0.0
        self.depth_network: NetworkDepth | None = None
        self._frame_time = StepTimer()
        self.reset()

    def use_depth_network(self, network: Network) -> None:
        """Let a monocular network fill in plate depth that neither sensors nor stereo find."""
        from edge_server.fields.splat.layers.depth.network_depth import NetworkDepth

        self.depth_network = self.supervision.network = NetworkDepth(network)
        if self.supervision.depth is not None:  # of a state that was loaded
            self.supervision.depth.network = self.depth_network

    # --- the protocol -------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget the scene, its cameras and their plates; keep settings and compiled kernels."""
        self.static.forget()
        self.pool.spare(0)
        self.still.reset()
        self.cameras: dict[str, FixedCamera] = {}
        self.observations = Observations()
        self.tracker: MotionTracker | None = None
        self.layered = True  # False: a camera moves, or its frames are unsuitable for layers
        self.refused: set[str] = set()  # cameras whose newest frame does not match their plate
        self.origin_ns: int | None = None
        self.supervision = StaticSupervision(self.static, self.depth_network)
        self._published: SplatSnapshot | None = None
        self._exposed: tuple[SplatSnapshot, bytes, NDArray[np.float32]] | None = None  # see ``_at_present_exposure``

    @property
    def frame_s(self) -> float | None:
        """Seconds to take in a frame; None if layers were given up."""
        return self._frame_time.seconds if self.layered else None

    @property
    def most_pixels(self) -> int | None:
        """Largest total number of pixels of one image per camera; None if layers were given up."""
        return tuned.MOST_PIXELS if self.layered else None

    @property
    def moving_shares(self) -> dict[str, float]:
        """Moving share of the pixels of each camera's newest frame, where it is known; the least share for a frame that
        does not match its plate."""
        shares = {o.camera: max(o.share, tuned.LEAST_SHARE) for o in self.observations}
        return shares | dict.fromkeys(self.refused, tuned.LEAST_SHARE)

    @property
    def troubles(self) -> tuple[str, ...]:
        """Problems of poses and measured depth, in words."""
        depth = self.supervision.depth
        bumped = [f"{name} {bumped_by(camera)}" for name, camera in self.cameras.items() if camera.bumped is not None]
        return (*bumped, *(() if depth is None else depth.troubles))

    @property
    def learning(self) -> str:
        """The progress of learning before plates are certain, in words; empty afterwards, and without layers."""
        if not self.layered or len(self.cameras) < tuned.LEAST_CAMERAS:
            return ""
        if self.tracker is None:
            frames = min(min(camera.plate.count for camera in self.cameras.values()), tuned.PLATE_FRAMES)
            return f"learning the background: {frames} of {tuned.PLATE_FRAMES} frames of each camera"
        if self.supervision.early and len(self.observations) and self.observations.newest_s < tuned.PLATE_S:
            return f"learning the background: {self.observations.newest_s:.1f} of {tuned.PLATE_S:g} s"
        static, earlier = self.supervision.static, self.supervision.earlier
        if not static.ready and (earlier is None or earlier.step < tuned.EARLY_SHOWN_AFTER):
            step = 0 if static.shown is None else static.shown.step
            most = static.shown_after if step < static.shown_after else tuned.SHOWN_AT_LATEST
            return f"learning the background: {step} of {most} steps"
        return ""

    @property
    def step(self) -> int:
        """Optimizer steps of the still field so far."""
        return self.still.step

    @property
    def views(self) -> tuple[View, ...]:
        """Training views of the still field: a view of each camera, or its background plate."""
        return tuple(view for view in self.still.views if not self.cameras or view.camera in self.cameras)

    @property
    def moving(self) -> MovingSet | None:
        """The moving set; None before plates are known."""
        return None if self.tracker is None else self.tracker.moving

    def fit(self, views: Sequence[View], budget: Budget) -> FitReport:
        """Take in new views, track motion, and train. Raises ValueError if a view is invalid.

        A budget in steps bounds the steps of the still field, which do not count as steps of the fit: they
        delay no publication.
        """
        if not views:
            return FitReport(0, 0.0, 0.0, 0, 0, note="no views: nothing was done")
        pace = StepBudget(budget, self.now)
        beside = budget.seconds is not None
        self._share_cores(beside, computes=False)
        for view in views:
            if not self._has_seen(view):
                check_view(view)
        if self.layered and (reasons := [why for view in views if (why := self._unfit_for_layers(view))]):
            self._give_up_layers(reasons[0])
        if not self.layered:
            return self._fit_still(views, budget, pace)
        if self.tracker is not None and self.tracker.moving.box is not self.still.view_store.box:
            self._begin_again("another camera has changed the box of the scene")
        taken = self._take_in(views)
        if wandering := [name for name, camera in self.cameras.items() if camera.moves > tuned.MOST_MOVES]:
            self._give_up_layers(f"{wandering[0]} moves")
            return self._fit_still(views, budget, pace)
        if self.tracker is not None and not len(self.observations):
            self._begin_again("no camera stands where it stood")
        if self.tracker is None:
            if not self.supervision.plates_are_known(self.cameras, self.observations):
                report = self._fit_still(views, budget, pace)
                self.supervision.take_whole(taken, self.cameras, self.observations)
                return report
            agree = self.supervision.exposures_agree(self.cameras, self.observations)
            self._published = self._published or self.supervision.earlier
            if not agree:
                return FitReport(0, pace.elapsed_s(), 0.0, 0, 0, note="the cameras' exposures are equalized")
            log.info("layers begin: the plates of %d cameras are known", len(self.cameras))
        tracker = self.tracker or self._begin_layers()
        begun = self.now()
        self.supervision.compare(self.cameras, self.observations, beside)
        self.beside_s += self.now() - begun
        self._find_rows()
        parameters = self.still.adam_parameters(tuned.STEP_PROGRESS)
        steps = rays = samples = 0
        follows = budget.seconds is None or self.supervision.layers_shown
        self._share_cores(beside, computes=follows and self.static.at_work)
        if budget.seconds is not None and not follows:
            self.static.wait(budget.seconds - pace.elapsed_s())  # it has the processor: nobody sees yet what moves
        else:
            steps, rays, samples = tracker.follow(pace, parameters)
        loss, begun = 0.0, self.now()
        if not beside:
            loss, static_rays, static_samples = self.static.train(pace)
            self.static.publish()
            rays, samples = rays + static_rays, samples + static_samples
        self._take_renderings(beside)
        self.beside_s += self.now() - begun
        self._publish()
        self.supervision.take_whole(taken, self.cameras, self.observations)
        note = "" if steps or pace.steps else self._why_no_step(tracker.moving) if taken else "no new views"
        return FitReport(
            steps,
            pace.elapsed_s(),
            loss,
            rays,
            samples,
            note=note,
            short=follows and steps == 0 and pace.steps == 0 and tracker.moving.alive > 0,
            refused=tuple(camera for camera in cameras_of(views) if camera in self.refused),
        )

    def _share_cores(self, beside: bool, computes: bool) -> None:
        """Let the pool leave a worker idle while this thread computes beside it (``computes``), and always if a pool of
        two runs beside a server's threads: each kernel would wait for a worker that these threads delay."""
        self.pool.spare(int(self.layered and beside and (computes or self.pool.threads == 2)))

    def _fit_still(self, views: Sequence[View], budget: Budget, pace: StepBudget) -> FitReport:
        """Spend the rest of a budget on the still field, on the newest view of each camera."""
        if budget.seconds is not None:
            budget = Budget(seconds=max(budget.seconds - pace.elapsed_s(), 0.0))
        return self.still.fit(newest_of_each(views), budget)

    def _why_no_step(self, moving: MovingSet) -> str:
        if moving.alive:
            return "motion was followed, without time for a step"
        return "nothing is left to learn" if self.static.finished else "only the still field learns"

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """Render the scene at the instant of the newest view."""
        return self.snapshot().render(camera_to_world, intrinsics)

    def snapshot(self, present_ns: int | None = None) -> SplatSnapshot:
        """The scene at an instant; None: that of the newest view."""
        published = self._published
        return self.still.snapshot(present_ns) if published is None else published.at(present_ns)

    def warm_up(self, cameras: int | None = None) -> float:
        """Compile every kernel, or load it from numba's cache; returns the seconds taken."""
        seconds = self.still.warm_up() + compile_kernels(self._run_kernels)
        if cameras is not None and cameras <= tuned.STEREO_CAMERAS:  # their depth is measured, or found by stereo
            from edge_server.fields.splat.layers.depth.depth_supervision import warm_up

            seconds += warm_up()
        return seconds

    def _run_kernels(self, pool: Pool) -> None:
        """Run every kernel of the layers once, in a small separate field."""
        tiny = msgspec.structs.replace(self.still._tiny(), min_views=1, contracted=False)
        camera, pose = Pinhole.from_fov(32, 32, 60.0), np.eye(4)
        pose[2, 3] = -3.0
        field = LayeredField(tiny, pool)
        views = [View("warm-up", np.full((32, 32, 3), 128, np.uint8), pose, camera, k) for k in range(2)]
        field._take_in(views)
        plate = field.cameras["warm-up"].plate
        plate.load_state(plate.state())  # blurs its frames, as a change of exposure does
        field.static.begin([camera.plate_image(fine=False) for camera in field.cameras.values()])
        moving = field._begin_layers().moving
        field._find_rows()
        moving.run_kernels(field.cameras["warm-up"], next(iter(field.observations)))

    # --- state --------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Everything needed to resume bit for bit."""
        self.static.stop()
        return pack(self)

    def load_state(self, state: Arrays) -> None:
        """Resume from ``state``. ValueError: it is not a state of a field of this shape."""
        self.static.stop()
        with all_or_nothing(self):
            unpack(self, state)

    def finish_loading(self) -> None:
        """Restore what derives from the loaded parts."""
        self._published = self._exposed = None
        if self.tracker is not None:
            self.static.publish()
            self._find_rows()
            self._publish()

    # --- intake -------------------------------------------------------------------------------

    def _unfit_for_layers(self, view: View) -> str:
        """Why layers cannot take the view in; empty if they can."""
        known = self.cameras.get(view.camera)
        if view.image.shape[2] != 3:
            return f"images of {view.camera} are transparent"
        if known is not None and known.view.intrinsics != view.intrinsics:
            return f"the lens or the image size of {view.camera} has changed"
        return ""

    def _give_up_layers(self, reason: str) -> None:
        """Continue with the still field only, until ``reset``."""
        log.info("layers are given up until a reset: %s", reason)
        self.static.forget()
        if self.supervision.with_depth:  # virtual ones
            self.still.view_store.forget_views()
        self.layered = False
        self.pool.spare(0)
        self._published, self.tracker, self.observations = None, None, Observations()
        self.cameras, self.supervision = {}, StaticSupervision(self.static, self.depth_network)

    def _take_in(self, views: Sequence[View]) -> list[View]:
        """Plates and foregrounds of the views not seen before. Returns these views."""
        begun = self.now()
        if self.origin_ns is None:
            self.origin_ns = min(view.generated_ns for view in views)
        news = {(v.generated_ns, v.camera): v for v in views if not self._has_seen(v)}
        for _, view in sorted(news.items()):
            self._take(view)
        if news:
            self._frame_time.add((self.now() - begun) / len(news))
        if len(self.observations):
            self.observations.forget_before(self.observations.newest_s - tuned.EVIDENCE_S)
        return list(news.values())

    def _has_seen(self, view: View) -> bool:
        return view.camera in self.cameras and view.generated_ns in self.cameras[view.camera].taken

    def _take(self, view: View) -> None:
        assert self.origin_ns is not None
        if view.camera not in self.cameras:
            self.cameras[view.camera] = FixedCamera.begin(view)
        camera = self.cameras[view.camera]
        late = camera.is_late(view)
        camera.taken.append(view.generated_ns)
        if late:
            return
        if not camera.stands_at(view):
            if not camera.leaves_for(view):
                self.refused |= {view.camera}
                return
            camera = self._move_camera(view)
        refused = self.refused | {view.camera}
        may_refuse = self.tracker is not None and 4 * len(refused) <= len(self.cameras)
        foreground = camera.plate.take(view.image, may_refuse, by_itself=self.supervision.is_unsure)
        if camera.shows_turned(view, foreground, self.observations.usual_share):
            foreground = None
            if camera.was_turned:
                self._turn_camera(view)
                return
        if foreground is None:
            self.refused = refused
            return
        self.refused -= {view.camera}
        believed = view.depth is not None and self.supervision.take_depth(camera, view, foreground)
        if camera.anew:
            return  # against an empty plate nothing is foreground
        depth = view.depth if believed and _is_measured_with(view) else None
        view = replace(view, camera_to_world=camera.view.camera_to_world, depth=depth)
        instant_s = (view.generated_ns - self.origin_ns) / 1e9
        self.observations.add(Observation(instant_s, view.camera, view, foreground))

    def _move_camera(self, view: View) -> FixedCamera:
        """Restart a camera at its current place, with the exposure that it had; the others continue."""
        log.info("%s stands somewhere else: its plate is restarted", view.camera)
        self.supervision.forget_camera(view.camera)
        before, camera = self.cameras[view.camera], FixedCamera.begin(view)
        camera.taken, camera.moves, camera.anew, camera.began_ns = before.taken, before.moves, True, view.generated_ns
        camera.correct_exposure(before.plate.gain)
        self.cameras[view.camera] = camera
        self.observations.forget_camera(view.camera)
        return camera

    def _turn_camera(self, view: View) -> None:
        """Restart a bumped camera, rotated as its frames show."""
        before = self.cameras[view.camera]
        stands = before.view.camera_to_world.copy()
        stands[:3, :3] @= before.turns[-1]
        camera = self._move_camera(view)
        camera.bumped = stands
        camera.correct(stands, before.depth_scale)
        log.warning("%s: %s", view.camera, bumped_by(camera))
        self.refused -= {view.camera}

    # --- the still field ---------------------------------------------------------------------

    def _begin_layers(self) -> MotionTracker:
        """Start motion tracking, in the scene's box."""
        self.supervision.plates_s = self.observations.newest_s
        self.make_tracker()
        assert self.tracker is not None
        self.tracker.anchors_s = self.supervision.plates_s
        return self.tracker

    def _begin_again(self, why: str) -> None:
        """Restart the layers: a late camera has changed the scene's box, which defines all coordinates, or nothing is
        observed any more. Plates stay."""
        log.info("layers begin again: %s", why)
        self.static.forget()
        self.tracker = None
        self.supervision.begin_again()
        self.observations = Observations()
        for camera in self.cameras.values():
            camera.row, camera.depth_m, camera.rendered_step, camera.anew = None, None, -1, False

    def make_tracker(self) -> None:
        """Make an empty tracker, in the static field's box."""
        moving = MovingSet(self.settings, self.caller, self._box(), self.settings.seed)
        self.tracker = MotionTracker(moving, self.observations, self.cameras)

    def _find_rows(self) -> None:
        for camera in self.cameras.values():
            if camera.row is None:
                view = camera.view
                camera.row = camera_rows([view.camera_to_world], [view.intrinsics], self._box())

    def _take_renderings(self, beside: bool) -> None:
        """Give cameras new depth and color renderings of the still field if it has learned since. Without a thread that
        renders them, they are rendered here: all at first, then one per fit."""
        shown, cameras = self.static.shown, self.cameras
        if not beside and shown is not None and self.static.ready:
            stale = sorted((c for c in cameras.values() if c.rendered_step < shown.step), key=lambda c: c.rendered_step)
            never = [c for c in stale if c.rendered_step < 0]
            self.static.render([c.view for c in never or stale[:1]])
        rendered = list(self.static.rendered)
        for name in rendered[: tuned.RENDERINGS_A_FIT] if beside else rendered:
            cameras[name].take_rendering(*self.static.rendered.pop(name))

    def _box(self) -> Any:
        box = self.still.view_store.box
        assert box is not None
        return box

    # --- what is shown ------------------------------------------------------------------------

    def _publish(self) -> None:
        """Publish the current layers."""
        still, tracker = self.supervision.to_show(self._box()), self.tracker
        if still is None:
            return
        assert tracker is not None and self.origin_ns is not None
        moving = tracker.moving
        shown = MovingSnapshot.of(moving, self.origin_ns, self.observations.newest_s) if moving.alive else None
        exposed = self._at_present_exposure(still)
        depth = self.supervision.depth
        parts = still.box, exposed, still.background, still.pool, still.step, still.planar
        surfaces = None if depth is None else depth.scene
        self._published = LayeredSnapshot(*parts, static=exposed, moving=shown, surfaces=surfaces)

    def _at_present_exposure(self, shown: SplatSnapshot) -> NDArray[np.float32]:
        """Parameters of the still field at the cameras' current exposure; those of the last publication if nothing has
        changed."""
        gain = np.median([c.plate.gain for c in self.cameras.values()], axis=0).astype(np.float32)
        if self._exposed is None or self._exposed[0] is not shown or self._exposed[1] != gain.tobytes():
            params = shown.params.copy()
            params[:, COLOR:] *= np.tile(gain, (params.shape[1] - COLOR) // 3)
            self._exposed = (shown, gain.tobytes(), params)
        return self._exposed[2]


def _is_measured_with(view: View) -> bool:
    """Whether a view's depth was taken at the instant of its image, so that moving objects are at the same place."""
    from edge_server.fields.splat.layers.depth.layer_depth_constants import (
        BODY_GAP_NS,  # only where a camera measures depth
    )

    return view.depth_ns is None or abs(view.depth_ns - view.generated_ns) <= BODY_GAP_NS


make = LayeredField
