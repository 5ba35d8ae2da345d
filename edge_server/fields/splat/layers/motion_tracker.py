"""Tracks the moving set: its motion from every frame of the last second, then its appearance.

With a budget in seconds the newest frames come first. Frames beyond the budget are left out, or wait for the next fit.
"""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np

from edge_server.fields.common.training_schedule import StepBudget, StepTimer
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.moving_set import MovingSet
from edge_server.fields.splat.layers.observations import FixedCamera, Observation, Observations, knot_of, pixel_weights


class MotionTracker:
    """Keeps a ``MovingSet`` in agreement with the frames.

    anchors_s, seeded_s: instants of the frames at which anchors were last chosen, and Gaussians seeded.
    fits: number of fits.
    """

    def __init__(self, moving: MovingSet, observations: Observations, cameras: dict[str, FixedCamera]) -> None:
        self.moving, self.observations, self.cameras = moving, observations, cameras
        self.anchors_s = self.seeded_s = -np.inf
        self.fits = 0
        self._step_time, self._seed_time = StepTimer(), StepTimer()

    def follow(self, pace: StepBudget, parameters: AdamParameters) -> tuple[int, int, int]:
        """Estimate motion, seed Gaussians where they are missing, train appearance. Returns steps, pixels and
        pairs.

        parameters: for optimizer steps.
        """
        moving, newest_s = self.moving, self.observations.newest_s
        self.fits += 1
        moving.bind(len(self.cameras))
        moving.follow_foreground(float(np.mean([o.share for o in self.observations])))
        strides = self._strides()
        for until_s in strides:
            if moving.motion.anchors is not None:
                moving.motion.slide(until_s + 1.0 / tuned.KNOTS_PER_S)
            if not moving.alive:
                continue
            if until_s - self.anchors_s >= tuned.ANCHORS_EVERY_S:
                self._renew_anchors(until_s)
            for _ in range(tuned.PASSES):
                if self._solve(until_s, pace) < tuned.AGAIN_M or not pace.within(tuned.ALIGNING_SHARE):
                    break
            for o in self.observations:
                o.fresh &= o.instant_s > until_s
        since_s, begun = newest_s - self.seeded_s, time.perf_counter()
        has_room = pace.has_room(self._seed_time.seconds, 1.0, 0.0) or since_s >= tuned.SEED_AT_LEAST_EVERY_S
        every_s = tuned.FEW_SEED_EVERY_S if moving.few else tuned.SEED_EVERY_S
        if not moving.alive or (since_s >= every_s and has_room):
            self.seeded_s = newest_s
            self._seed()
            self._seed_time.add(time.perf_counter() - begun)
        large = max(o.foreground.size for o in self.observations) > tuned.FEW_STEPS_PIXELS
        steps = tuned.FEW_STEPS if moving.few and large else tuned.STEPS
        return self._train_appearance(pace, parameters, steps * len(strides))

    def _strides(self) -> list[float]:
        """Instants up to which motion is tracked, one after the other: the last is the newest frame's, the others
        divide the time since the last fit if it is longer than ``STRIDE_S``. If no frame of that fit is left, tracking
        is lost and starts at the newest frame: strides from the oldest frame on track worse."""
        newest_s = self.observations.newest_s
        fresh_s = np.array([o.instant_s for o in self.observations if o.fresh])
        since_s = max((o.instant_s for o in self.observations if not o.fresh), default=newest_s)
        count = max(1, int(np.ceil((newest_s - since_s) / tuned.STRIDE_S)))
        ends = np.linspace(since_s, newest_s, count + 1)
        held = [np.any((fresh_s > begin) & (fresh_s <= end)) for begin, end in pairwise(ends)]
        return [float(end) for end, some in zip(ends[1:-1], held) if some] + [newest_s]

    def _solve(self, until_s: float, pace: StepBudget) -> float:
        """One pass of Gauss-Newton over the frames up to an instant: align those that are new, or of the
        newest knot, then solve. Returns by how many meters it has moved the anchors then (median)."""
        motion = self.moving.motion
        until = min(motion.newest_s, until_s)
        seen = [o for o in self.observations if motion.oldest_s <= o.instant_s <= until]
        due = [o for o in seen if o.row is None or o.fresh or o.knot >= knot_of(until_s)]
        for k, o in enumerate(reversed(due)):
            if k >= tuned.MOST_ALIGNED or not (k < tuned.LEAST_ALIGNED or pace.within(tuned.ALIGNING_SHARE)):
                break
            self._align(o, exclude=True)
        before = motion.at(until_s)
        motion.solve([o.row for o in seen if o.row is not None])
        apart = np.linalg.norm(motion.at(until_s) - before, axis=1)
        return float(np.median(apart)) * motion.radius_m

    def _align(self, observation: Observation, exclude: bool) -> None:
        camera = self.cameras[observation.camera]
        self._weigh(observation, camera)
        opacity = self.moving.align(observation, camera)
        if exclude and observation.instant_s >= camera.newest_s:
            camera.newest_s = observation.instant_s
            assert observation.shown is not None
            if observation.instant_s >= tuned.PLATE_S:  # before, apparent foreground may be the plate
                camera.plate.exclude_explained(observation.view.image, observation.shown, opacity)

    def _weigh(self, observation: Observation, camera: FixedCamera) -> None:
        if observation.weight is None:
            distance_m = self.moving.distance_m(camera, observation.instant_s)
            observation.weight = pixel_weights(
                observation.foreground, camera.depth_m, distance_m, observation.view.weight
            )

    def _train_appearance(self, pace: StepBudget, parameters: AdamParameters, most: int) -> tuple[int, int, int]:
        """At most ``most`` steps on the frames of the last two knots, one frame per step, all equally often."""
        moving, newest = self.moving, self.observations.newest_knot
        frames = self.observations.of_knots(newest - 1, newest)
        order = np.random.default_rng([moving.seed, self.fits, 7]).permutation(len(frames))
        rays, samples, steps = 0, 0, 0
        while steps < most and moving.alive and pace.has_room(self._step_time.seconds, 1.0, 0.0):
            begun = time.perf_counter()
            frame = frames[order[steps % len(frames)]]
            self._weigh(frame, self.cameras[frame.camera])
            samples += moving.train(frame, self.cameras[frame.camera], parameters)
            rays, steps = rays + frame.foreground.size, steps + 1
            self._step_time.add(time.perf_counter() - begun)
        if not steps and moving.alive:
            self._step_time.drop_longest()  # slow steps may be over; without a step this would stay unknown
        return steps, rays, samples

    def _seed(self) -> None:
        """Remove Gaussians outside the foregrounds, and seed missing ones: at the measured depth of moving objects, or
        else at the newest instant that most cameras have seen."""
        moving, measured = self.moving, self._measured_frames()
        frames = measured or moving.seeding_frames(self.observations, len(self.cameras))
        if not frames:
            return
        pixels = sum(int(o.foreground.sum()) for o in frames)
        if pixels < tuned.LEAST_FOREGROUND * frames[0].foreground.size * len(self.cameras):
            return
        moving.remove_outside(frames, self.cameras, bool(measured))
        if moving.motion.anchors is None:
            self._forget_rows()
        if moving.alive:
            for o in frames:
                self._align(o, exclude=False)
        if measured:
            moving.seed_at_depth(measured, self.cameras)
        else:
            moving.seed_missing(frames, self.cameras)

    def _measured_frames(self) -> list[Observation]:
        """See ``body_depth.measured_frames``."""
        if all(o.view.depth is None for o in self.observations):
            return []
        from edge_server.fields.splat.layers.depth.body_depth import measured_frames

        return measured_frames(self.observations, self.cameras)

    def _renew_anchors(self, instant_s: float) -> None:
        self.moving.renew_anchors(instant_s)
        self.anchors_s = instant_s
        self._forget_rows()

    def _forget_rows(self) -> None:
        for o in self.observations:
            o.row = o.shown = None
