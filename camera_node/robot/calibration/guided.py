"""Guided sessions (``calibrate ... --live``): they say what to show or where to move next, and end with enough.

A session is offered images one by one, keeps those that add something, and is read until it has enough, the time is
over, a recording ends, or Ctrl-C.
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
from numpy.typing import NDArray

from camera_node.config import ArmConfig, LiveConfig, SourceConfig, source_config
from camera_node.robot.arm.camera_poses import base_matrix
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.refinement import refine
from camera_node.robot.calibration.hand_eye.samples import (
    Array,
    Samples,
    angle_deg,
    distance_mm,
    diversity,
    rotation_vectors,
)
from camera_node.robot.calibration.lens_calibration import (
    MIN_CORNERS,
    MIN_VIEWS,
    LensCalibration,
    calibrate_lens,
    coverage_grid,
)
from camera_node.robot.calibration.targets import Corners, Target, estimate_pose, to_gray
from camera_node.sources.base import Source, rate
from camera_node.sources.devices.feed import as_camera_error
from camera_node.sources.devices.live import DEFAULT_FPS, open_feed
from camera_node.sources.registry import open_sources
from freshfield import payload, scenario
from freshfield.clock import WallClock
from freshfield.geometry import Pinhole, se3_inverse

Image = NDArray[np.uint8]

# A hand-eye session ends with so many poses, axes spread so far, and this standard deviation of the translation.
GOOD_POSES, GOOD_SPREAD_DEG, GOOD_MM = 10, 15.0, 0.5
# A pose rotated by less from a kept one adds little. Stamps matter beyond these motions between two frames.
NEW_DEG, STILL_MM, STILL_DEG = 8.0, 0.5, 0.1
# A lens session ends with so many images, share of the image covered, tilt, and deviation of the focal length.
GOOD_IMAGES, GOOD_COVERED, GOOD_TILT_DEG, GOOD_F = 10, 0.8, 30.0, 0.003
# Corner motion as a share of the image's width: the largest at rest, and the least that makes an image new.
STILL, NEW = 0.003, 0.06
KEPT = "kept"
_GRAB_S = 1.0
_MIN_TO_SOLVE = 4
_ROWS, _COLUMNS = ("top", "middle", "bottom"), ("left", "middle", "right")


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
    loaded, config = _load(args)
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


def live_lens(args: argparse.Namespace, board: Target) -> LensCalibration:
    """A lens from the images of a scenario's real camera. Raises as ``live_samples``."""
    loaded, config = _load(args)
    if not isinstance(config, LiveConfig):
        raise CalibrationError(f"--live: {loaded.path} has no real camera; give the FOLDER of its pictures")
    session = LensSession(board)
    _guide(map(session.offer, _images(args.camera, config, args.seconds)))
    return session.lens()


def _load(args: argparse.Namespace) -> tuple[scenario.Scenario, SourceConfig]:
    if args.seconds is not None and not args.seconds > 0:
        raise CalibrationError("--seconds: expected a positive number")
    loaded = scenario.load(args.live)
    if args.camera not in loaded.cameras:
        raise CalibrationError(f"--camera: {loaded.path} has {', '.join(loaded.cameras)}, got {args.camera}")
    return loaded, source_config(loaded)


def _base_from_world(loaded: scenario.Scenario, arm: ArmConfig, camera: str) -> Array:
    """Base-from-world (4, 4), because the arm's poses are in the world and the calibration needs them in its
    base. Raises CalibrationError."""
    if camera not in arm.cameras or arm.cameras[camera] is not None:
        raise CalibrationError(
            f"{loaded.path}: source.arm.cameras: set {camera}: null for the calibration (also for a camera "
            "that stands): its poses are then the flange's"
        )
    return se3_inverse(base_matrix(arm))


def _ticks(fps: float, seconds: float | None) -> Iterator[int]:
    """Ticks of a frame rate, each at its time, until ``seconds`` are over."""
    start = time.monotonic()
    for tick in itertools.count():
        if seconds is not None and tick / fps > seconds:
            return
        time.sleep(max(0.0, start + tick / fps - time.monotonic()))
        yield tick


def _shots(source: Source, codec: str, seconds: float | None) -> Iterator[tuple[Image, Pinhole, Array]]:
    """Images, lenses and poses (4, 4) of a source. A shot that cannot be read is reported and skipped."""
    # A source that never repeats follows the time of day, as in a node.
    first = 0 if source.contents is not None else round(WallClock().now_ns() * source.fps / 10**9)
    for tick in _ticks(float(source.fps), seconds):
        if source.contents is not None and tick >= source.contents:
            return
        try:
            shot = source.read(source.content(first + tick))
        except ValueError as error:
            print(f"\n{error}", file=sys.stderr)
            continue
        image, lens = shot.image, shot.intrinsics
        if isinstance(image, bytes):
            image = payload.decode(image, codec, lens.width, lens.height)
        yield image, lens, shot.pose.matrix()


def _images(camera: str, config: LiveConfig, seconds: float | None) -> Iterator[Image]:
    """Images of a real camera; not from its source, which would require the lens."""
    fps = rate(config.fps or DEFAULT_FPS)
    feed = open_feed(camera, config, fps, WallClock())
    try:
        for tick in _ticks(float(fps), seconds):
            taken = feed.grab(config.first_frame_s if tick == 0 else _GRAB_S)
            if taken is not None:
                yield taken[1]
    except Exception as error:  # drivers raise what they like
        print(f"\n{as_camera_error(camera, error)}; what there is:", file=sys.stderr)
    finally:
        feed.close()


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

    def offer(self, image: Image, lens: Pinhole, flange: Array) -> Step:
        """Process an image (H, W) or (H, W, 3) taken with the flange at ``flange`` (4, 4), in base."""
        last, self._last = self._last, flange
        if last is None or distance_mm(last, flange) > STILL_MM or angle_deg(last, flange) > STILL_DEG:
            return self._step("arm moving", "hold still")
        corners = self._target.find(to_gray(image))
        if corners is None:
            return self._step("target not found", "bring all of it into the picture, well lit")
        turned_deg = angle_deg(self.samples.flange, flange)
        if len(turned_deg) and turned_deg.min() < NEW_DEG:
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
        if found.reason is None and len(self.samples) >= _MIN_TO_SOLVE:
            self._std_mm = refine(self.samples).std_mm
        return self._step(KEPT)

    def _step(self, outcome: str, advice: str | None = None) -> Step:
        progress = f"{len(self.samples)} poses, axes spread by {self._spread_deg:.0f} degrees"
        if np.isfinite(self._std_mm):
            progress += f", sure to {self._std_mm:.2f} mm"
        varied = len(self.samples) >= GOOD_POSES and self._spread_deg >= GOOD_SPREAD_DEG
        enough = varied and self._std_mm <= GOOD_MM
        return Step(outcome, progress, advice or ("enough" if enough else missing_turn(self.samples.flange)), enough)


def missing_turn(flanges: Array) -> str:
    """Instruction to an operator: the axis about which poses (N, 4, 4) differ least from the first."""
    if not len(flanges):
        return "bring the target into the picture"
    turns = rotation_vectors(flanges[0, :3, :3].T @ flanges[:, :3, :3])
    axis = int(np.argmin((turns**2).sum(axis=0)))
    sign = "-" if turns[:, axis].sum() > 0 else "+"
    return f"turn the flange by 20 to 40 degrees about its {sign}{'xyz'[axis]}, the target in sight"


class LensSession:
    """Collects images of a target at rest until they cover the image, tilted, and the focal length is known."""

    def __init__(self, target: Target) -> None:
        self._target = target
        self._corners: Corners | None = None
        self._kept: dict[str, Corners] = {}
        self._size = (0, 0)
        self._found: LensCalibration | None = None
        self._why = ""
        self._cells = np.zeros((6, 6), dtype=np.bool_)

    def lens(self) -> LensCalibration:
        """Calibrate from all kept images. Raises CalibrationError."""
        return calibrate_lens(self._kept, self._size, {})

    def offer(self, image: Image) -> Step:
        """Process an image (H, W) or (H, W, 3)."""
        self._size = image.shape[1], image.shape[0]
        last, self._corners = self._corners, self._target.find(to_gray(image))
        if self._corners is None:
            return self._step("target not found", "bring all of it into the picture, well lit")
        if len(self._corners.points) < MIN_CORNERS:
            return self._step("target unclear", "show more of it")
        if last is None or _distance(last, self._corners) > STILL * self._size[0]:
            return self._step("moving", "hold still")
        for name, kept in self._kept.items():
            if _distance(kept, self._corners) < NEW * self._size[0]:
                return self._step(f"like {name}")
        self._kept[f"picture {len(self._kept) + 1}"] = self._corners
        self._cells = coverage_grid(self._kept.values(), self._size)
        try:
            self._found, self._why = self.lens(), ""
        except CalibrationError as error:
            self._found, self._why = None, str(error)
        return self._step(KEPT)

    def _step(self, outcome: str, advice: str | None = None) -> Step:
        progress = f"{len(self._kept)} pictures, {100 * self._cells.mean():.0f} % of the picture covered"
        if self._found is not None:
            progress += (
                f", tilted by {self._found.tilt_deg:.0f} degrees, f {self._found.pinhole.fx:.1f} +- "
                f"{self._found.std[0]:.1f} px, reprojection {self._found.error_px:.2f} px"
            )
        missing = self._missing()
        return Step(outcome, progress, advice or missing or "enough", missing is None)

    def _missing(self) -> str | None:
        """What to do next; None if there is enough."""
        lens = self._found
        if self._cells.mean() < GOOD_COVERED:
            # 3 x 3 parts of 2 x 2 cells each: the emptiest first.
            parts = self._cells.reshape(3, 2, 3, 2).sum(axis=(1, 3))
            row, column = divmod(int(np.argmin(parts)), 3)
            where = "middle" if row == column == 1 else f"{_ROWS[row]} {_COLUMNS[column]}"
            return f"show it at the {where} of the picture, also tilted"
        if lens is None:
            return self._why if len(self._kept) >= MIN_VIEWS else "show it elsewhere, also tilted"
        if lens.tilt_deg < GOOD_TILT_DEG:
            return "tilt it more, about different axes"
        if len(lens.views) < GOOD_IMAGES or lens.std[0] > GOOD_F * lens.pinhole.fx:
            return "go on, nearer and tilted, everywhere"
        return None


def _distance(a: Corners, b: Corners) -> float:
    """Mean distance (pixels) of the common corners; infinite if these are less than half."""
    at = dict(zip(map(tuple, a.points.tolist()), a.pixels))
    pairs = [(at[key], pixel) for key, pixel in zip(map(tuple, b.points.tolist()), b.pixels) if key in at]
    if 2 * len(pairs) < max(len(a.points), len(b.points)):
        return float("inf")
    one, other = np.array(pairs).swapaxes(0, 1)
    return float(np.linalg.norm(one - other, axis=1).mean())
