"""Supervision of the static field by fixed cameras: plates, at one exposure, and depth; and its timing.

With a budget in seconds, long work is done in the thread that trains the static field.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, View
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.equal_exposures import equalize_exposures
from edge_server.fields.splat.layers.observations import FixedCamera, Observations
from edge_server.fields.splat.layers.plates import plain_share
from edge_server.fields.splat.layers.static_layer import PlateImage, StaticLayer
from edge_server.fields.splat.snapshot import SplatSnapshot

if TYPE_CHECKING:
    from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate
    from edge_server.fields.splat.layers.depth.depth_supervision import CameraPlates, DepthSupervision
    from edge_server.fields.splat.layers.depth.network_depth import NetworkDepth

log = logging.getLogger(__name__)

Cameras = Mapping[str, FixedCamera]


class StaticSupervision:
    """Keeps a ``StaticLayer`` in agreement with the plates.

    plates_s: instant of the frames when plates were last compared.
    fine_s: instant of the frames when one was last taken in at its full resolution.
    fine: whether the static field learns from fine plates.
    exposure_rounds: number of rounds of ``exposures_agree`` so far.
    anew: whether the static field is to restart.
    with_depth: whether it starts, or has started, with depth. early: whether it started before plates were certain.
    depth: None as long as no camera has measured depth.
    plain: whether so much of the plates is untextured that stereo helps; None before they are certain, and if it does
        not matter.
    earlier: the static field as shown before its restart; None once the restarted one is better.
    layers_shown: whether a field learned from plates has been shown since the layers started.
    """

    def __init__(self, static: StaticLayer, network: NetworkDepth | None = None) -> None:
        """network: of monocular depth, where the user has one."""
        self.static, self.network = static, network
        self.plates_s = self.fine_s = -np.inf
        self.fine = False
        self.exposure_rounds = 0
        self.anew = self.with_depth = self.early = False
        self.plain: bool | None = None
        self.warned = False  # whether it was logged that a single camera gives no depth
        self.depth: DepthSupervision | None = None
        self.earlier: SplatSnapshot | None = None
        self.layers_shown = False

    @property
    def is_unsure(self) -> bool:
        """Whether the static field has learned from plates that were not certain, and no depth."""
        return self.early and not self.with_depth

    def begin_again(self) -> None:
        """Forget the start of the static field; plates stay."""
        self.exposure_rounds = 0
        self.anew = self.with_depth = self.early = self.layers_shown = False

    # --- depth --------------------------------------------------------------------------------

    def take_depth(self, camera: FixedCamera, view: View, foreground: NDArray[np.bool_]) -> bool:
        """Add the depth of a frame that is in the camera's plate. Returns whether it is plausible: it contradicts
        neither the camera's earlier depth nor the other cameras'."""
        assert view.depth is not None
        plate = self.make_depth_plate(camera)
        before = plate.refused
        taken = plate.take(view.depth, foreground)
        if not taken and before == 0:
            log.warning("%s: its depth contradicts what it measured before, and is left out", view.camera)
        return taken and self.trusts_depth(view.camera)

    def make_depth_plate(self, camera: FixedCamera) -> DepthPlate:
        """A camera's depth plate, made with its first frame that has depth."""
        if camera.depth is None:
            from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate

            self.make_depth()
            camera.depth = DepthPlate.empty(*camera.view.image.shape[:2])
        return camera.depth

    def make_depth(self) -> DepthSupervision:
        """Supervision with depth, made with the first frame that has depth. Compiles its kernels, or loads them."""
        if self.depth is None:
            from edge_server.fields.splat.layers.depth.depth_supervision import DepthSupervision, warm_up

            warm_up()
            self.depth = DepthSupervision(self.static.field.settings, self.static.field.pool, self.network)
        return self.depth

    def trusts_depth(self, camera: str) -> bool:
        """Whether a camera measures depth that does not contradict the others'."""
        return self.depth is not None and camera not in self.depth.wrong

    def forget_camera(self, camera: str) -> None:
        """Forget the records of a camera that now stands somewhere else."""
        self.static.forget_camera(camera)
        if self.depth is not None:
            self.depth.forget_camera(camera)

    def _depth_is_known(self, observed: Sequence[FixedCamera]) -> bool:
        """Whether at least half of the cameras have depth, and the depth plates of these are known."""
        known = [c.depth.is_known(c.plate.known) for c in observed if c.depth is not None and c.depth.count.any()]
        return 2 * len(known) >= max(len(observed), 1) and all(known)

    @property
    def _stereo_cameras(self) -> int:
        return tuned.PLAIN_CAMERAS if self.plain else tuned.STEREO_CAMERAS

    def _stereo_helps(self, cameras: Cameras) -> bool:
        """Whether few cameras see the scene, and less than half of them have measured depth."""
        few = tuned.LEAST_CAMERAS <= len(cameras) <= self._stereo_cameras
        measure = sum(c.depth is not None and bool(c.depth.count.any()) for c in cameras.values())
        return few and 2 * measure < len(cameras)

    # --- when layers begin --------------------------------------------------------------------

    def plates_are_known(self, cameras: Cameras, observations: Observations) -> bool:
        """Whether layers may begin."""
        # A camera that has gone silent will deliver no more.
        observed = _observed(cameras, observations)
        if not observed or any(camera.plate.count < tuned.PLATE_FRAMES for camera in observed):
            return False
        if self._depth_is_known(observed):
            from edge_server.fields.splat.layers.depth.layer_depth_constants import PLATE_S

            return observations.newest_s >= PLATE_S
        if observations.newest_s < tuned.EARLY_S:
            return False
        alone = len(cameras) < tuned.LEAST_CAMERAS
        if alone and not self.warned:
            self.warned = True
            log.warning("one camera without a depth sensor gives no depth: only its own view will be right")
        return not alone

    def exposures_agree(self, cameras: Cameras, observations: Observations) -> bool:
        """Start with the plates, and correct the cameras' exposures if they differ; the field with which they agree is
        trained on. One round per call. Returns whether it was the last."""
        if self._depth_is_known(_observed(cameras, observations)):
            return self._begin_with_depth(cameras, observations)
        agree = self.exposure_rounds >= tuned.EXPOSURE_ROUNDS
        self.early = observations.newest_s < tuned.PLATE_S
        self._begin(self._plates(cameras))
        return agree or self._equalize(cameras)

    def _begin(self, plates: Sequence[PlateImage]) -> None:
        """Train the still field on ``plates``: at first continuing from the views, so that layers are shown at once.
        Later, or if it has learned differing exposures, from scratch: its earlier state is shown until that is better.
        """
        self.earlier = self.earlier or self.static.field.snapshot()
        self.static.forget()
        if self.exposure_rounds > 0 or not self.early:
            self.static.field.reset()
        self.static.begin(plates, tuned.EARLY_SHOWN_AFTER if self.early else None)

    def _equalize(self, cameras: Cameras) -> bool:
        """Train for a few steps, and correct exposures by the difference of plates and renderings. Returns whether they
        agreed."""
        self.exposure_rounds += 1
        self.static.train(StepBudget(Budget(steps=tuned.EXPOSURE_STEPS)))
        self.static.publish()
        self.static.render([camera.view for camera in cameras.values()])
        renderings = {name: rendering for name, (_, rendering) in self.static.rendered.items()}
        self.static.rendered = {}
        agree = equalize_exposures(cameras, renderings)
        if agree:
            self.exposure_rounds = tuned.EXPOSURE_ROUNDS
        return agree

    def _begin_with_depth(self, cameras: Cameras, observations: Observations) -> bool:
        """Correct exposures by surfaces that several cameras see, and restart the field with depth. Returns
        True."""
        logs = self.make_depth().exposures(self._copied(cameras))
        if np.std(list(logs.values()), axis=0).max() >= tuned.EXPOSURES_AGREE:
            for name, log_ratio in logs.items():
                cameras[name].correct_exposure(np.exp(log_ratio).astype(np.float32))
        self.exposure_rounds = tuned.EXPOSURE_ROUNDS
        self.static.field.keep_box([camera.view for camera in cameras.values()])
        self._keep_showing()
        self.anew = self.with_depth = True
        self.early = observations.newest_s < tuned.PLATE_S
        return True

    def _keep_showing(self) -> None:
        """Keep showing the current field until the restarted one is better."""
        self.earlier = self.earlier or self.static.shown or self.static.field.snapshot()

    # --- what is learned ----------------------------------------------------------------------

    def compare(self, cameras: Cameras, observations: Observations, beside: bool) -> None:
        """Let the static field learn changed plates, or restart.

        beside: in a thread, until it has learned them; or else only note that there is something to learn.
        """
        now_s = observations.newest_s
        # Another thread learns slowly: a field restarted at once would long be worse than the one that is shown.
        # With depth it is soon better, and its cameras' poses are corrected then.
        learned = self.layers_shown and (self.with_depth or self.static.field.step >= tuned.EARLY_STEPS)
        learned = learned or not beside or now_s >= tuned.PLATES_SURE_S
        certain = self.early and now_s >= tuned.PLATE_S and learned
        more = tuned.STEREO_CAMERAS < len(cameras) <= tuned.PLAIN_CAMERAS
        if self.plain is None and more and now_s >= tuned.PLATE_S:
            plates = [camera.plate_image(fine=False).color for camera in cameras.values()]
            least, most = tuned.PLAIN_SHARE
            self.plain = least < plain_share(plates) < most
        stereo = self._stereo_helps(cameras)
        if stereo:
            self.make_depth().stereo_cameras = self._stereo_cameras
        if self.anew:
            pass
        elif self.with_depth:
            if certain:
                self._begin_with_depth(cameras, observations)
        elif self.depth is not None and (stereo or self._depth_is_known(_observed(cameras, observations))):
            self._begin_with_depth(cameras, observations)
        elif certain:
            self._keep_showing()
            self.anew, self.early = True, False
        self._correct(cameras, observations)
        if not self.fine and self._fine_plates_are_known(cameras, observations):
            self.static.stop()
            self.fine = True
            if not self.anew:
                self.static.refine(self._plates(cameras))
            self.plates_s = now_s
        due = now_s - self.plates_s >= tuned.PLATES_EVERY_S
        if due and self.is_unsure and not self.anew:  # more of the plates is known
            self.plates_s = now_s
            self.static.learn(self._plates(cameras))
        if beside and self.static.training:
            if self.anew:
                self.static.end_soon()
        elif self.anew:
            self._begin_anew(cameras, beside)
            self.plates_s = now_s
        elif beside if not self.static.finished else due:
            self.plates_s = now_s
            self._learn_again(cameras, beside)

    def _correct(self, cameras: Cameras, observations: Observations) -> None:
        """Apply the corrections that registration has found to cameras and frames, or remove them."""
        if self.depth is None:
            return
        corrections = self.depth.corrections
        for name, camera in cameras.items():
            found = corrections.get(name)
            pose, scale = (camera.assumed_pose, 1.0) if found is None else (found.pose, found.scale)
            if camera.depth_scale != scale or not np.array_equal(camera.view.camera_to_world, pose):
                camera.correct(pose, scale)
                for o in observations:
                    if o.camera == name:
                        o.view, o.row = replace(o.view, camera_to_world=pose), None

    def _begin_anew(self, cameras: Cameras, beside: bool) -> None:
        """Restart from scratch with the plates, and their depth where known: a field that started early has learned
        people as background, and continued training keeps them."""
        static, self.anew = self.static, False
        self._keep_showing()  # again: with a thread, ``to_show`` has seen a field that is ready meanwhile
        static.forget()
        shown_after = self._shown_after()
        if self.with_depth:
            depth, copies = self.make_depth(), self._copied(cameras)
            box = static.field.view_store.box
            assert box is not None

            def begin() -> None:
                plates, surfaces = depth.plates(copies, anew=True)
                static.field.begin_anew(depth.first_gaussians(surfaces, box))
                static.begin(plates, shown_after)
        else:
            images = self._plates(cameras)

            def begin() -> None:
                static.learn(images)
                better_than = static.field.error()
                static.field.begin_anew(None)
                static.begin(images, shown_after, better_than)

        if beside:
            static.train_beside(begin, [camera.view for camera in cameras.values()])
        else:
            begin()

    def _shown_after(self) -> int:
        """Steps after which a restarted field may be shown. With depth: at most as many as the current field has had
        (few on a busy machine), since it is better by then."""
        if not self.with_depth:
            return tuned.EARLY_SHOWN_AFTER
        from edge_server.fields.splat.layers.depth.layer_depth_constants import SHOWN_AFTER

        least, most = SHOWN_AFTER
        if self.early or self.earlier is None:
            return least
        return min(max(self.earlier.step, least), most)

    def _learn_again(self, cameras: Cameras, beside: bool) -> None:
        static, depth = self.static, self.depth
        if depth is not None and self.with_depth:
            copies, known = self._copied(cameras), depth

            def learn() -> None:
                real = [camera.learned for camera in copies]
                if static.finished and (static.have_changed(real) or known.has_changed(copies)):
                    static.learn_again(known.plates(copies, anew=False)[0])
        else:
            plates = self._plates(cameras)

            def learn() -> None:
                if static.finished and static.have_changed(plates):
                    static.learn_again(plates)

        if beside:
            static.train_beside(learn, [camera.view for camera in cameras.values()])
        else:
            learn()

    def _plates(self, cameras: Cameras) -> list[PlateImage]:
        if self.depth is not None and self.with_depth:
            return self.depth.plates(self._copied(cameras), anew=False)[0]
        return [camera.plate_image(self.fine) for camera in cameras.values()]

    def _copied(self, cameras: Cameras) -> list[CameraPlates]:
        from edge_server.fields.splat.layers.depth.depth_supervision import CameraPlates

        copies = []
        for camera in cameras.values():
            plate = camera.plate_image(fine=False)
            learned = camera.plate_image(fine=True) if self.fine else plate
            depth = None if camera.depth is None else camera.depth.copied()
            copies.append(CameraPlates(plate, learned, depth, camera.assumed_pose))
        return copies

    # --- plates at full resolution ------------------------------------------------------------

    def take_whole(self, taken: Sequence[View], cameras: Cameras, observations: Observations) -> None:
        """Add frames to their cameras' fine plates: some in each fit until all are known, then one occasionally.
        Cameras take turns."""
        views = {v.camera: v for v in taken if v.whole is not None}
        seen = [o for o in observations if o.camera in views and o.view.generated_ns == views[o.camera].generated_ns]
        alone = len(cameras) < tuned.LEAST_CAMERAS
        every_s = tuned.FINE_EVERY_S if self.fine else tuned.FIRST_FINE_EVERY_S
        if not seen or alone or observations.newest_s - self.fine_s < every_s:
            return
        self.fine_s = observations.newest_s
        seen.sort(key=lambda o: cameras[o.camera].fine_count)
        for o in seen[: 1 if self.fine else tuned.FIRST_FINE]:
            camera, decode = cameras[o.camera], views[o.camera].whole
            if camera.fine is not None and decode is not None and (whole := decode()) is not None:
                camera.fine.take(whole.image, o.foreground | ~camera.plate.known, camera.plate.gain)

    def _fine_plates_are_known(self, cameras: Cameras, observations: Observations) -> bool:
        seen = [cameras[camera].fine for camera in {o.camera for o in observations}]
        fine = [f for f in seen if f is not None]
        return bool(fine) and all(f.count >= tuned.FINE_FRAMES for f in fine)

    # --- what is shown ------------------------------------------------------------------------

    def to_show(self, box: Any) -> SplatSnapshot | None:
        """The static field, or until it is better the one from before the restart; None if that has another box."""
        if self.earlier is None or self.static.ready:
            self.earlier, self.layers_shown = None, True
            return self.static.shown
        return self.earlier if self.earlier.box == box else None


def _observed(cameras: Cameras, observations: Observations) -> list[FixedCamera]:
    """The cameras with observed frames."""
    return [cameras[name] for name in {o.camera for o in observations}]
