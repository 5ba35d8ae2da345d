"""The guided session ``calibrate hand-eye --live``: it says where to move next, and ends with enough.

It is offered images one by one, keeps those that add something, and is read until it has enough, the time is over, a
recording ends, or Ctrl-C.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from camera_node.robot.arm.camera_poses import base_matrix
from camera_node.robot.arm.settings import ArmConfig
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration import calibration_constants as tuned
from camera_node.robot.calibration.hand_eye.refinement import refine
from camera_node.robot.calibration.hand_eye.samples import (
    Array,
    Samples,
    angle_deg,
    distance_mm,
    diversity,
    rotation_vectors,
)
from camera_node.robot.calibration.targets import WHICH_PRINT, Target, estimate_pose, to_gray
from camera_node.settings import source_config
from camera_node.sources.base import Source, pixels
from camera_node.sources.devices.feed import Image
from camera_node.sources.registry import open_sources
from freshfield import scenario
from freshfield.clock import WallClock
from freshfield.geometry import Pinhole, se3_inverse

KEPT = "kept"


@dataclass(frozen=True)
class Step:
    """Result of one image. outcome: ``kept``, or why not. progress: what there is. advice: what to do next.
    enough: whether to stop."""

    outcome: str
    progress: str
    advice: str
    enough: bool


def live_samples(args: argparse.Namespace, board: Target, lens: Pinhole | None, setup: str) -> Samples:
    """Samples from a scenario's camera, whose poses are the flange's. lens: replaces the camera's own.

    Raises CalibrationError, and the errors of what it opens: scenario, files, camera, arm."""
    if args.seconds is not None and not args.seconds > 0:
        raise CalibrationError("--seconds: expected a positive number")
    loaded = scenario.load(args.live)
    if args.camera not in loaded.cameras:
        raise CalibrationError(f"--camera: {loaded.path} has {', '.join(loaded.cameras)}, got {args.camera}")
    config = source_config(loaded)
    arm: ArmConfig | None = getattr(config, "arm", None)
    to_base = np.eye(4) if arm is None else _base_from_world(loaded, arm, args.camera)
    session = HandEyeSession(board, setup)
    source = open_sources(loaded, config, [args.camera], args.data)[args.camera]
    try:
        shots = _shots(source, config.codec, args.seconds)
        _guide(session.offer(image, lens or own, to_base @ flange) for image, own, flange in shots)
    finally:
        source.release()
    return session.samples


def _base_from_world(loaded: scenario.Scenario, arm: ArmConfig, camera: str) -> Array:
    """Base-from-world (4, 4), because the arm's poses are in the world and the calibration needs them in its
    base. Raises CalibrationError."""
    if camera not in arm.cameras or arm.cameras[camera] is not None:
        raise CalibrationError(
            f"{loaded.path}: source.arm.cameras: set {camera}: null for the calibration (also for a camera "
            "that stands): its poses are then the flange's"
        )
    return se3_inverse(base_matrix(arm))


def _shots(source: Source, codec: str, seconds: float | None) -> Iterator[tuple[Image, Pinhole, Array]]:
    """Images, lenses and poses (4, 4) of a source. A shot that cannot be read is reported and skipped."""
    # A source that never repeats follows the time of day, as in a node.
    first = 0 if source.contents is not None else round(WallClock().now_ns() * source.fps / 10**9)
    start_s, fps = time.monotonic(), float(source.fps)
    for tick in itertools.count() if source.contents is None else range(source.contents):
        if seconds is not None and tick / fps > seconds:
            return
        time.sleep(max(0.0, start_s + tick / fps - time.monotonic()))
        try:
            shot = source.read(source.content(first + tick))
        except ValueError as error:
            print(f"\n{error}", file=sys.stderr)
            continue
        yield pixels(shot, codec), shot.intrinsics, shot.pose.matrix()


def _guide(steps: Iterable[Step]) -> None:
    """Report steps until there is enough: on a terminal each on the same line; elsewhere those that kept an image."""
    try:
        for step in steps:
            line = f"{step.progress}; {step.outcome}: {step.advice}"
            if sys.stderr.isatty():
                width = shutil.get_terminal_size().columns - 1
                print(f"\r{line[:width]:{width}}", end="\n" if step.outcome == KEPT else "", file=sys.stderr)
            elif step.outcome == KEPT:
                print(line, file=sys.stderr)
            if step.enough:
                return
    except KeyboardInterrupt:
        print("\nstopped; what there is:", file=sys.stderr)


class HandEyeSession:
    """Collects samples of an arm at rest until the standard deviation of the translation is at most GOOD_MM."""

    def __init__(self, target: Target, setup: str) -> None:
        self.samples = Samples(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), setup)
        self._target = target
        self._last: Array | None = None
        self._spread_deg, self._std_mm = 0.0, float("inf")
        self._missed, self._why = 0, ""

    def offer(self, image: Image, lens: Pinhole, flange: Array) -> Step:
        """Process an image (H, W) or (H, W, 3) taken with the flange at ``flange`` (4, 4), in base."""
        last, self._last = self._last, flange
        if last is None or distance_mm(last, flange) > tuned.STILL_MM or angle_deg(last, flange) > tuned.STILL_DEG:
            return self._step("arm moving", "hold still")
        gray = to_gray(image)
        corners = self._target.find(gray)
        if corners is None:
            self._missed += 1
            if self._missed % tuned.EXPLAIN_EVERY == 1:  # it takes a second
                self._why = self._target.explain(gray)
            return self._step("target not found", self._why or "bring all of it into the picture, well lit")
        if not self._target.decided():
            return self._step("target unclear", WHICH_PRINT)
        turned_deg = angle_deg(self.samples.flange, flange)
        if len(turned_deg) and turned_deg.min() < tuned.NEW_DEG:
            return self._step(f"like pose {int(np.argmin(turned_deg)) + 1}")
        try:
            seen = estimate_pose(corners, lens)
        except CalibrationError as error:
            return self._step("target unclear", str(error))
        both = ((self.samples.flange, flange), (self.samples.target, seen))
        flanges, targets = (np.concatenate([earlier, new[None]]) for earlier, new in both)
        self.samples = replace(self.samples, flange=flanges, target=targets)
        found = diversity(self.samples)
        self._spread_deg = found.axis_spread_deg
        if found.reason is None and len(self.samples) >= tuned.MIN_TO_SOLVE:
            self._std_mm = refine(self.samples).std_mm
        return self._step(KEPT)

    def _step(self, outcome: str, advice: str | None = None) -> Step:
        progress = f"{len(self.samples)} poses, axes spread by {self._spread_deg:.0f} degrees"
        if np.isfinite(self._std_mm):
            progress += f", sure to {self._std_mm:.2f} mm"
        varied = len(self.samples) >= tuned.GOOD_POSES and self._spread_deg >= tuned.GOOD_SPREAD_DEG
        enough = varied and self._std_mm <= tuned.GOOD_MM
        return Step(outcome, progress, advice or ("enough" if enough else missing_turn(self.samples.flange)), enough)


def missing_turn(flanges: Array) -> str:
    """Instruction to an operator: the axis about which poses (N, 4, 4) differ least from the first."""
    if not len(flanges):
        return "bring the target into the picture"
    turns = rotation_vectors(flanges[0, :3, :3].T @ flanges[:, :3, :3])
    axis = int(np.argmin((turns**2).sum(axis=0)))
    sign = "-" if turns[:, axis].sum() > 0 else "+"
    return f"turn the flange by 20 to 40 degrees about its {sign}{'xyz'[axis]}, the target in sight"
