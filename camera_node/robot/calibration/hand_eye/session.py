"""``camera-node calibrate hand-eye --live``: a guided session that says which poses are missing.

With a moving arm both streams are recorded, flange poses and detected target poses, each with its own stamps, and
``time_offset`` estimates the offset between them (camera delay, transport of the joint states) from the motion.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from camera_node.config import ArmConfig, SourceConfig, source_config
from camera_node.robot.arm.camera_poses import arm_model, base_matrix
from camera_node.robot.arm.joint_states import ArmStream
from camera_node.robot.calibration import WANT_MM, CalibrationError, guided
from camera_node.robot.calibration.guided import KEPT, Image, Step
from camera_node.robot.calibration.hand_eye.calibrate import Calibration, calibrate, calibrate_tracks
from camera_node.robot.calibration.hand_eye.refinement import Refinement, refine
from camera_node.robot.calibration.hand_eye.samples import (
    Array,
    Samples,
    angle_deg,
    distance_mm,
    diversity,
    rotation_vectors,
)
from camera_node.robot.calibration.inputs import Track, pairs_json, read_pairs, sorted_track
from camera_node.robot.calibration.targets import Corners, Target, estimate_pose, to_gray
from camera_node.sources.base import Source
from freshfield import files, scenario
from freshfield.clock import WallClock
from freshfield.geometry import Pinhole, se3_inverse

MIN_POSES, GOOD_SPREAD_DEG = 10, 15.0
# A pose rotated by less from a kept one adds little information.
NEW_DEG = 8.0
# Largest motion between two frames at rest: for more, stamps that are a few milliseconds off would matter.
STILL_MM, STILL_DEG = 0.5, 0.1
MIN_SECONDS = 10.0
"""Motion with the target in sight that a time offset needs; its deviation falls with the root of it."""
_GAP_NS = 125_000_000  # longest gap between two detections that counts as motion
_MIN_TO_SOLVE = 4
MOVING = "arm moving"


def calibrate_live(args: argparse.Namespace, board: Target, lens: Pinhole | None, setup: str) -> Calibration:
    """Run a session with a scenario's camera and calibrate from its samples. Ctrl-C ends the session early.

    board, lens: the target, and a lens that replaces the camera's own.
    setup: eye-in-hand or eye-to-hand.
    Raises CalibrationError, and the errors of what it opens: scenario, files, camera, arm.
    """
    if not args.want_mm > 0:
        raise CalibrationError("--want-mm: expected a positive number")
    loaded = guided.load_scenario(args)
    config = source_config(loaded)
    arm: ArmConfig | None = getattr(config, "arm", None)
    to_base = np.eye(4) if arm is None else _base_from_world(loaded, arm, args.camera)
    before = read_pairs(args.samples, setup) if args.samples is not None and args.samples.exists() else None

    def keep(samples: Samples) -> None:
        if args.samples is not None:
            files.write_json(args.samples, pairs_json(samples))

    streams = StreamRecorder() if args.moving and arm is not None else None
    session = HandEyeSession(board, setup, args.want_mm, args.moving, before, keep, streams is not None)
    source = guided.open_source(loaded, config, args)
    with contextlib.ExitStack() as stack:
        stack.callback(source.release)
        if streams is not None and arm is not None:
            stack.callback(streams.follow_arm(loaded, arm).stop)
        pace = guided.Pace(float(source.fps), args.seconds)
        guided.guide(session_steps(session, source, config, pace, lens, to_base, streams), args.preview)
    if streams is None:
        return calibrate(session.samples, args.method)
    return calibrate_tracks(streams.flange(), streams.target(), setup, args.method, args.max_gap_ms / 1e3)


def session_steps(
    session: HandEyeSession,
    source: Source,
    config: SourceConfig,
    pace: Callable[[int], bool],
    lens: Pinhole | None = None,
    to_base: Array | None = None,
    streams: StreamRecorder | None = None,
) -> Iterator[tuple[Image, Corners | None, Step]]:
    """Offer a source's shots, whose poses are the flange's, to a session. Yields each image, the corners found in it,
    and the step.

    pace: see ``guided.read_shots``.
    lens: replaces the source's own.
    to_base: base-from-world (4, 4), if the shots' poses are in the world.
    streams: records the target poses and decides when there is enough.
    """
    for t_ns, shot, image in guided.read_shots(source, config.codec, pace):
        flange = shot.pose.matrix() if to_base is None else to_base @ shot.pose.matrix()
        step = session.offer(image, lens or shot.intrinsics, flange)
        if streams is not None:
            if session.target_pose is not None:
                streams.add_target(t_ns, session.target_pose)
            step = streams.advise(step, session)
        yield image, session.corners, step


def _base_from_world(loaded: scenario.Scenario, arm: ArmConfig, camera: str) -> Array:
    """Base-from-world (4, 4), because the arm's poses are in the world and the calibration needs them in its
    base. Raises CalibrationError."""
    if camera not in arm.cameras or arm.cameras[camera] is not None:
        raise CalibrationError(
            f"{loaded.path}: source.arm.cameras: set {camera}: null for the calibration (also for a camera "
            "that stands): its poses are then the flange's"
        )
    return se3_inverse(base_matrix(arm))


class HandEyeSession:
    """Collects samples until the standard deviation of the translation is at most ``want_mm``.

    moving: also take images while the arm moves; its poses must then be exact in time.
    before: samples of an earlier session to continue.
    kept: called with all samples after each new one.
    streams: the streams are recorded too, and calibrated at the end; solving in between would hold up the camera.
    samples: all that were kept.
    corners, target_pose: found in the last image.
    refined: current calibration, if there is one.
    """

    def __init__(
        self,
        target: Target,
        setup: str,
        want_mm: float = WANT_MM,
        moving: bool = False,
        before: Samples | None = None,
        kept: Callable[[Samples], None] = lambda samples: None,
        streams: bool = False,
    ) -> None:
        self.samples = before or Samples(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), setup)
        self.corners: Corners | None = None
        self.target_pose: Array | None = None
        self.refined: Refinement | None = None
        self._target, self._want_mm, self._moving, self._kept = target, want_mm, moving, kept
        self._streams = streams
        self._last: Array | None = None
        self._solve()

    @property
    def varied(self) -> bool:
        """Whether there are enough poses, turned about different axes."""
        return len(self.samples) >= MIN_POSES and self._diversity.axis_spread_deg >= GOOD_SPREAD_DEG

    def offer(self, image: NDArray[np.uint8], lens: Pinhole, flange: Array) -> Step:
        """Process an image (H, W, 3) taken with the flange at ``flange`` (4, 4), in base."""
        last, self._last = self._last, flange
        self.corners = self.target_pose = None
        still = last is not None and distance_mm(last, flange) <= STILL_MM and angle_deg(last, flange) <= STILL_DEG
        if not (still or self._moving):
            return self._step(MOVING, "hold still")
        self.corners = self._target.find(to_gray(image))
        if self.corners is None:
            return self._step("target not found", "bring all of it into the picture, well lit")
        try:
            self.target_pose = estimate_pose(self.corners, lens)
        except CalibrationError as error:
            return self._step("target unclear", str(error))
        turned_deg = angle_deg(self.samples.flange, flange)
        if len(turned_deg) and turned_deg.min() < NEW_DEG:
            return self._step(f"like pose {int(np.argmin(turned_deg)) + 1}")
        both = ((self.samples.flange, flange), (self.samples.target, self.target_pose))
        flanges, targets = (np.concatenate([earlier, new[None]]) for earlier, new in both)
        self.samples = replace(self.samples, flange=flanges, target=targets)
        self._solve()
        self._kept(self.samples)
        return self._step(KEPT)

    def _solve(self) -> None:
        self._diversity = diversity(self.samples)
        solvable = self._diversity.reason is None and len(self.samples) >= _MIN_TO_SOLVE and not self._streams
        self.refined = refine(self.samples) if solvable else None

    def _step(self, outcome: str, advice: str | None = None) -> Step:
        progress = f"{len(self.samples)} poses, axes spread by {self._diversity.axis_spread_deg:.0f} degrees"
        if self.refined is not None:
            progress += f", sure to {self.refined.std_mm:.2f} mm {self.refined.std_deg:.3f} degrees"
        enough = self.varied and self.refined is not None and self.refined.std_mm <= self._want_mm
        return Step(outcome, progress, enough, advice or ("enough" if enough else missing_turn(self.samples.flange)))


def missing_turn(flanges: Array) -> str:
    """Instruction to an operator: the axis about which poses (N, 4, 4) differ least from the first."""
    if not len(flanges):
        return "bring the target into the picture"
    turns = rotation_vectors(flanges[0, :3, :3].T @ flanges[:, :3, :3])
    axis = int(np.argmin((turns**2).sum(axis=0)))
    sign = "-" if turns[:, axis].sum() > 0 else "+"
    return f"turn the flange by 20 to 40 degrees about its {sign}{'xyz'[axis]}, the target in sight"


class StreamRecorder:
    """Records poses (4, 4) with their stamps (ns). One thread may add flanges while another adds targets."""

    def __init__(self) -> None:
        self._flanges: list[tuple[int, Array]] = []
        self._targets: list[tuple[int, Array]] = []
        self._seen_ns = 0

    def follow_arm(self, loaded: scenario.Scenario, arm: ArmConfig) -> ArmStream:
        """Record the scenario's arm, as flange poses in its base, until the stream is stopped. Raises
        ScenarioError and ArmError."""
        model = arm_model(loaded, arm)
        stream = ArmStream(
            arm.host,
            WallClock(),
            arm.frequency_hz,
            on_sample=lambda t_ns, joints: self.add_flange(t_ns, model.forward(joints)),
        )
        stream.start()
        return stream

    def add_flange(self, t_ns: int, pose: Array) -> None:
        """pose: flange in base."""
        self._flanges.append((t_ns, pose))

    def add_target(self, t_ns: int, pose: Array) -> None:
        """pose: target in camera."""
        if self._targets:
            gap_ns = t_ns - self._targets[-1][0]
            self._seen_ns += gap_ns if 0 < gap_ns <= _GAP_NS else 0
        self._targets.append((t_ns, pose))

    @property
    def seen_s(self) -> float:
        """Seconds with the target in sight."""
        return self._seen_ns / 1e9

    def advise(self, step: Step, session: HandEyeSession) -> Step:
        """The step with advice for recording streams. The deviation does not count, because it contains the
        unknown offset."""
        if not session.varied:
            return replace(step, enough=False)
        left_s = MIN_SECONDS - self.seen_s
        if left_s <= 0.0:
            return replace(step, enough=True, advice="enough")
        return replace(step, enough=False, advice=f"keep moving, irregularly, the target in sight: {left_s:.0f} s more")

    def flange(self) -> Track:
        """The flange's stream. Raises CalibrationError for fewer than two poses."""
        return _track(self._flanges, "joint states")

    def target(self) -> Track:
        """The target's stream. Raises CalibrationError for fewer than two poses."""
        return _track(self._targets, "sightings of the target")


def _track(rows: list[tuple[int, Array]], what: str) -> Track:
    rows = list(rows)
    return sorted_track([t_ns for t_ns, _ in rows], [pose for _, pose in rows], what)
