"""The Gaussian field of cameras that stand still: plates, a static field and a moving set.

A view becomes part of its camera's plate; what is not plate is foreground, and evidence of how things moved
at the instant when it was taken. Data flow one way: view, plate, foreground, motion, moving set, picture.
Nothing that moves is written into the static field.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, FitReport, Rendering, Snapshot, View
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.field_state import all_or_nothing
from edge_server.fields.common.supervision import check_view
from edge_server.fields.common.threads.precompile import compile_ahead
from edge_server.fields.common.threads.thread_pool import Pool, shared_pool
from edge_server.fields.common.training_schedule import StepBudget, StepTimer
from edge_server.fields.splat.cpu_field import SplatField
from edge_server.fields.splat.kernels.project import COLOR, Gaussians
from edge_server.fields.splat.layers.layered_state import pack, unpack
from edge_server.fields.splat.layers.motion import KNOTS_PER_S
from edge_server.fields.splat.layers.moving_set import LEAST_FOREGROUND, MovingSet
from edge_server.fields.splat.layers.observations import (
    FixedCamera,
    Observation,
    Observations,
    pixel_weights,
)
from edge_server.fields.splat.layers.plates import Plate
from edge_server.fields.splat.layers.snapshot import LayeredSnapshot, MovingSnapshot
from edge_server.fields.splat.layers.static_field import SCHEDULE, StaticField
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import Pinhole

Arrays = dict[str, NDArray]

PLATE_FRAMES, PLATE_S = 8, 3.2  # of each camera, and since the first frame, before plates are learned
SHOWN_AFTER = 400  # steps of the static field, after which it replaces the first field
EVIDENCE_S = 0.8  # age up to which frames tell of motion

PASSES = 2  # of Gauss-Newton a fit
MOST_ALIGNED = 64  # frames aligned in one pass, newest first
STEPS, STEP_PROGRESS = 20, 0.3  # of appearance a fit; progress at which rates are taken
BIRTHS_EVERY, BIRTHS_AT_LEAST_EVERY = 3, 9  # fits; the second where budgets have no room for them
ANCHORS_EVERY_S = 0.5
PLATES_EVERY_S = 0.5  # how often plates are compared with what the static field has learned


class LayeredField:
    """See ``fields.Field`` for the protocol.

    Until plates are known, and for good where a camera moves or pictures are transparent, views go to a
    ``SplatField``. Call ``fit`` from one thread only; snapshots may be taken and rendered from any thread.
    """

    def __init__(self, settings: SplatSettings | None = None, pool: Pool | None = None) -> None:
        self.settings = settings or SplatSettings()
        self.pool = pool or shared_pool(self.settings.threads, self.settings.nice)
        self.now = time.perf_counter  # the clock of budgets in seconds
        self.first = SplatField(self.settings, self.pool)
        self.static = StaticField(self.settings, self.pool)
        self.part_s: dict[str, float] = {}  # seconds spent by part, in all fits
        self.reset()

    # --- the protocol -------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget the scene, its cameras and their plates; keep settings and compiled kernels."""
        self.first.reset()
        self.static.reset()
        self.cameras: dict[str, FixedCamera] = {}
        self.observations = Observations()
        self.moving: MovingSet | None = None
        self.layered = True  # False: a camera moved
        self.shown = False  # whether the layers are shown, and no longer the first field
        self.origin_ns: int | None = None
        self.fits = 0  # since the static field began to learn
        self.anchors_s = self.plates_s = -np.inf  # when these were last chosen and compared
        self._step_time, self._birth_time = StepTimer(), StepTimer()
        self._published: LayeredSnapshot | None = None
        self._still: tuple[tuple[int, bytes], Gaussians] | None = None  # see ``_static_gaussians``

    def fit(self, views: Sequence[View], budget: Budget) -> FitReport:
        """Take in the views not seen before, follow what moves, and train. ValueError: a view is invalid.

        A budget in steps bounds the steps of the static field; those of the moving set come on top, and the
        report counts both.
        """
        if not views:
            return FitReport(0, 0.0, 0.0, 0, 0, note="no views: nothing was done")
        start = self.now()
        for view in views:
            check_view(view)
        if self.layered and not all(self._stands_still(view) for view in views):
            self._give_up_layers()
        if not self.layered:
            return self.first.fit(_newest_of_each(views), budget)
        pace = StepBudget(budget, self.now)
        arrivals = self._take_in(views)
        if self.static.step == 0 and not self._plates_are_known():
            return self.first.fit(_newest_of_each(views), _remaining(budget, self.now() - start))
        self.fits += 1
        self._learn_plates()
        # On the wall clock, following motion would leave the first schedule of the static field no time.
        follows = len(self.observations) and (budget.seconds is None or self.static.step >= SCHEDULE)
        appearance = 0 if self.moving is None else -self.moving.steps
        rays, samples = self._follow_motion(pace) if follows else (0, 0)
        appearance += 0 if self.moving is None else self.moving.steps
        begun = self.now()
        loss, static_rays, static_samples = self.static.train(pace)
        self._spent("static field", begun)
        self._publish()
        self._render_static(most=1)
        steps = pace.steps + appearance
        report = FitReport(steps, pace.elapsed_s(), loss, rays + static_rays, samples + static_samples)
        return report if arrivals or steps else replace(report, note="no new views")

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """Render the scene at the instant of the newest view."""
        return self.snapshot().render(camera_to_world, intrinsics)

    def points(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Surface points in world meters and their colors; none before the first fit."""
        return self.snapshot().points(count)

    def snapshot(self, present_ns: int | None = None) -> Snapshot:
        """The scene at an instant; None: that of the newest view."""
        published = self._published
        return self.first.snapshot(present_ns) if published is None else published.at(present_ns)

    def warm_up(self) -> float:
        """Compile every kernel, or load it from numba's cache; returns the seconds taken."""
        return self.first.warm_up() + compile_ahead(self._run_kernels)

    def _run_kernels(self, pool: Pool) -> None:
        """Run every kernel of the layers once, in a small field of its own."""
        tiny = replace(self.settings, gaussians=64, start=8, min_views=1, seed_cells=8, contracted=False)
        camera, pose = Pinhole.from_fov(32, 32, 60.0), np.eye(4)
        pose[2, 3] = -3.0
        field = LayeredField(tiny, pool)
        views = [View("warm-up", np.full((32, 32, 3), 128, np.uint8), pose, camera, k) for k in range(2)]
        field._take_in(views)
        field._learn_plates()
        assert field.moving is not None
        field.moving.run_kernels(field.cameras["warm-up"], next(iter(field.observations)))

    # --- state --------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Everything needed to resume bit for bit."""
        return pack(self)

    def load_state(self, state: Arrays) -> None:
        """Resume from ``state``. ValueError: it is not a state of a field of this shape."""
        with all_or_nothing(self):
            unpack(self, state)

    def finish_loading(self) -> None:
        """What follows from the loaded parts."""
        self._published = self._still = None
        if self.moving is not None:
            self._find_rows()
        if self.shown and self.layered:
            self._publish()

    # --- intake -------------------------------------------------------------------------------

    def _stands_still(self, view: View) -> bool:
        """Whether layers can take the view in: its camera has not moved, and it has no transparency."""
        known = self.cameras.get(view.camera)
        return view.image.shape[2] == 3 and (
            known is None
            or (known.view.intrinsics == view.intrinsics
                and np.allclose(known.view.camera_to_world, view.camera_to_world, atol=1e-3))
        )  # fmt: skip

    def _give_up_layers(self) -> None:
        """Go on with the first field, until ``reset``, with what the static field has learned if that is
        shown."""
        if self.shown:
            self.first.load_state(self.static.state())
        self.layered = self.shown = False
        self._published, self.moving, self.observations = None, None, Observations()
        self.cameras = {}
        self.static.reset()

    def _take_in(self, views: Sequence[View]) -> int:
        """Plates and foregrounds of the views not seen before. Returns how many there are."""
        begun, arrivals = self.now(), 0
        if self.origin_ns is None:
            self.origin_ns = min(view.shows_ns for view in views)
        for view in sorted(views, key=lambda v: (v.generated_ns, v.camera)):
            if view.camera not in self.cameras:
                plate = Plate(view.image.shape[0], view.image.shape[1], self.pool)
                self.cameras[view.camera] = FixedCamera(view, plate)
            camera = self.cameras[view.camera]
            if view.generated_ns in camera.taken:
                continue
            camera.taken.append(view.generated_ns)
            arrivals += 1
            foreground = camera.plate.take(view.image)
            self.observations.add(Observation(
                (view.shows_ns - self.origin_ns) / 1e9, view.camera,
                replace(view, camera_to_world=camera.view.camera_to_world), foreground,
            ))  # fmt: skip
        if len(self.observations):
            self.observations.forget_before(self.observations.newest_s - EVIDENCE_S)
        self._spent("plates", begun)
        return arrivals

    def _plates_are_known(self) -> bool:
        return (
            len(self.observations) > 0
            and self.observations.newest_s >= PLATE_S
            and all(camera.plate.count >= PLATE_FRAMES for camera in self.cameras.values())
        )

    # --- the static field ---------------------------------------------------------------------

    def _learn_plates(self) -> None:
        """Give the static field its plates, and again when they have changed."""
        begun, now_s = self.now(), self.observations.newest_s
        if self.moving is None:
            self.static.learn(self.cameras)
            self.moving = MovingSet(self.settings, self.pool, self._box(), self.settings.seed)
            self.plates_s = self.anchors_s = now_s
        elif self.static.finished and now_s - self.plates_s >= PLATES_EVERY_S:
            self.static.learn_again(self.cameras)
            self.plates_s = now_s
        self._find_rows()
        self._spent("static field", begun)

    def _find_rows(self) -> None:
        for camera in self.cameras.values():
            if camera.row is None:
                view = camera.view
                camera.row = camera_rows([view.camera_to_world], [view.intrinsics], self._box())

    def _render_static(self, most: int) -> None:
        """Render depth and color of the static field for ``most`` of its cameras, those rendered longest ago,
        as far as the field has learned since."""
        step = self.static.step
        stale = [c for c in self.cameras.values() if c.rendered_step < step]
        if self._published is None or not stale:
            return
        begun = self.now()
        static = replace(
            self._published, gaussians=_as_gaussians(self.static.shown_params(), self.settings), moving=None
        )
        for camera in sorted(stale, key=lambda c: c.rendered_step)[:most]:
            rendered = static.render(camera.view.camera_to_world, camera.view.intrinsics)
            camera.depth_m, camera.rendered_step = rendered.depth, step
            camera.plate.stand_in(rendered.color)
        self._spent("static renders", begun)

    def _box(self) -> Any:
        box = self.static.view_store.box
        assert box is not None
        return box

    # --- what moves ---------------------------------------------------------------------------

    def _follow_motion(self, pace: StepBudget) -> tuple[int, int]:
        """Motion, then appearance, then births. Returns pixels and pairs."""
        moving = self.moving
        assert moving is not None
        shares = [float(o.foreground.mean()) for o in self.observations]
        moving.follow_foreground(float(np.mean(shares)))
        newest_s = self.observations.newest_s
        rays = samples = 0
        if moving.motion.anchors is not None:
            moving.motion.slide(newest_s + 1.0 / KNOTS_PER_S)
        if moving.alive:
            if newest_s - self.anchors_s >= ANCHORS_EVERY_S:
                self._renew_anchors(newest_s)
            for k in range(PASSES):
                self._solve(last=k == PASSES - 1)
            for o in self.observations:
                o.fresh = False
            self._publish()
            rays, samples = self._train_appearance(pace)
        begun, due = self.now(), self.fits % BIRTHS_EVERY == 0 or not moving.alive
        room = pace.has_room(self._birth_time.seconds, 1.0, 0.0) or self.fits % BIRTHS_AT_LEAST_EVERY == 0
        if due and room:
            self._births()
            self._birth_time.add(self.now() - begun)
            self._spent("births", begun)
        return rays, samples

    def _solve(self, last: bool) -> None:
        """One pass of Gauss-Newton: align frames that are new, or of the newest knot, then solve.

        last: of this fit; what it explains is held out of the plates."""
        assert self.moving is not None
        motion, begun = self.moving.motion, self.now()
        newest = self.observations.newest_knot
        seen = [o for o in self.observations if motion.oldest_s <= o.instant_s <= motion.newest_s]
        due = [o for o in seen if o.row is None or o.fresh or o.knot >= newest]
        for o in due[-MOST_ALIGNED:]:
            self._align(o, hold=last)
        begun = self._spent("alignment", begun)
        motion.solve([o.row for o in seen if o.row is not None])
        self._spent("solving", begun)

    def _align(self, observation: Observation, hold: bool) -> None:
        camera, moving = self.cameras[observation.camera], self.moving
        assert moving is not None
        self._weigh(observation, camera)
        opacity = moving.align(observation, camera)
        if hold and observation.instant_s >= camera.newest_s:
            camera.newest_s = observation.instant_s
            assert observation.shown is not None
            camera.plate.hold(observation.view.image, observation.shown, opacity)

    def _weigh(self, observation: Observation, camera: FixedCamera) -> None:
        if observation.weight is None:
            assert self.moving is not None
            distance_m = self.moving.distance_m(camera, observation.instant_s)
            observation.weight = pixel_weights(
                observation.foreground, camera.depth_m, distance_m, observation.view.weight
            )

    def _train_appearance(self, pace: StepBudget) -> tuple[int, int]:
        """Steps on the frames of the last two knots, one frame a step, each as often as the others."""
        moving = self.moving
        assert moving is not None
        newest = self.observations.newest_knot
        frames = self.observations.of_knots(newest - 1, newest)
        order = np.random.default_rng([self.settings.seed, self.fits, 7]).permutation(len(frames))
        parameters = self.static.moving_parameters(STEP_PROGRESS)
        begun, rays, samples = self.now(), 0, 0
        for step in range(STEPS):
            if not moving.alive or not pace.has_room(self._step_time.seconds, 1.0, 0.0):
                break
            step_begun = self.now()
            frame = frames[order[step % len(frames)]]
            self._weigh(frame, self.cameras[frame.camera])
            samples += moving.train(frame, self.cameras[frame.camera], parameters)
            rays += frame.foreground.size
            self._step_time.add(self.now() - step_begun)
        self._spent("appearance", begun)
        return rays, samples

    def _births(self) -> None:
        """Remove what lies outside foregrounds, and seed what is missing, at the newest instant that most
        cameras have seen."""
        moving = self.moving
        assert moving is not None
        frames = moving.birth_frames(self.observations, len(self.cameras))
        if not frames:
            return
        pixels = sum(int(o.foreground.sum()) for o in frames)
        if pixels < LEAST_FOREGROUND * frames[0].foreground.size * len(self.cameras):
            return
        moving.remove_outside(frames, self.cameras)
        if moving.alive:
            for o in frames:
                self._align(o, hold=False)
        moving.seed_missing(frames, self.cameras)

    def _renew_anchors(self, instant_s: float) -> None:
        assert self.moving is not None
        self.moving.renew_anchors(instant_s)
        self.anchors_s = instant_s
        for o in self.observations:
            o.row = None

    # --- what is shown ------------------------------------------------------------------------

    def _publish(self) -> None:
        """Show the layers as they are now, once the static field is better than the first one."""
        if self.static.step < SHOWN_AFTER:
            return
        begun, begins = self.now(), not self.shown
        self.shown = True
        live, moving = self.static._live(), self.moving
        assert moving is not None and self.origin_ns is not None
        shown = None
        if moving.alive:
            shown = MovingSnapshot(
                moving.cloud.params.copy(), moving.anchor.copy(), moving.share.copy(), moving.motion.copy(),
                self.origin_ns, self.observations.newest_s,
            )  # fmt: skip
        still = self._static_gaussians()
        self._published = LayeredSnapshot(
            live.box, still, live.background, live.cameras, live.pool, self.static.step, planar=live.planar,
            static=still.params, moving=shown,
        )  # fmt: skip
        self._spent("publication", begun)
        if begins:
            self.first.reset()
            self._render_static(most=len(self.cameras))

    def _static_gaussians(self) -> Gaussians:
        """The static field at the cameras' present exposure; the arrays of the last publication, where
        nothing has changed."""
        gain = np.median([c.plate.gain for c in self.cameras.values()], axis=0).astype(np.float32)
        key = (self.static.step, gain.tobytes())
        if self._still is None or self._still[0] != key:
            params = self.static.shown_params()
            params[:, COLOR:] *= np.tile(gain, (params.shape[1] - COLOR) // 3)
            self._still = (key, _as_gaussians(params, self.settings))
        return self._still[1]

    # --- inside -------------------------------------------------------------------------------

    def _spent(self, part: str, begun: float) -> float:
        """Add the time since ``begun`` to a part's; returns now."""
        now = self.now()
        self.part_s[part] = self.part_s.get(part, 0.0) + now - begun
        return now


def _as_gaussians(params: NDArray[np.float32], settings: SplatSettings) -> Gaussians:
    return Gaussians(params, settings.harmonics, np.zeros((len(params), 3), np.float32))


def _newest_of_each(views: Sequence[View]) -> list[View]:
    """The newest view of each camera, in the order of the cameras' first appearance."""
    newest: dict[str, View] = {}
    for view in views:
        if view.camera not in newest or view.shows_ns > newest[view.camera].shows_ns:
            newest[view.camera] = view
    return list(newest.values())


def _remaining(budget: Budget, spent_s: float) -> Budget:
    """What is left of a budget in seconds."""
    return budget if budget.seconds is None else Budget(seconds=max(budget.seconds - spent_s, 0.0))
