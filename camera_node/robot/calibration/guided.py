"""What both guided sessions (``calibrate ... --live``) share: the scenario's camera, its images, progress, preview."""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.config import LiveConfig, SourceConfig
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.targets import Corners, to_gray
from camera_node.sources.base import Shot, Source, rate
from camera_node.sources.devices.feed import as_camera_error
from camera_node.sources.devices.live import DEFAULT_FPS, open_feed
from camera_node.sources.registry import open_sources
from freshfield import files, payload, scenario
from freshfield.clock import WallClock

Image = NDArray[np.uint8]

KEPT = "kept"
_GRAB_S = 1.0
_GREEN, _ORANGE = (0, 158, 115), (213, 94, 0)


@dataclass(frozen=True)
class Step:
    """Result of one image.

    outcome: ``kept``, or why not.
    progress: what there is so far.
    enough: whether to stop.
    advice: what to do next.
    """

    outcome: str
    progress: str
    enough: bool
    advice: str

    @property
    def line(self) -> str:
        return f"{self.progress}; {self.outcome}: {self.advice}"


def guide(offered: Iterable[tuple[Image, Corners | None, Step]], preview: Path | None) -> None:
    """Report the steps of a session until it has enough, its images end, or Ctrl-C.

    offered: each image, the corners found in it, and its step.
    preview: file that keeps the newest image with its corners; None: not written.
    Raises OSError if that cannot be written.
    """
    try:
        for image, corners, step in offered:
            _report(step)
            if preview is not None:
                _write_image(preview, draw_step(image, corners, step))
            if step.enough:
                return
    except KeyboardInterrupt:
        print("\nstopped; what there is:", file=sys.stderr)


def load_scenario(args: argparse.Namespace) -> scenario.Scenario:
    """The scenario ``--live``, which must have ``--camera``. Raises CalibrationError and ScenarioError."""
    if args.seconds is not None and not args.seconds > 0:
        raise CalibrationError("--seconds: expected a positive number")
    loaded = scenario.load(args.live)
    if args.camera not in loaded.cameras:
        raise CalibrationError(f"--camera: {loaded.path} has {', '.join(loaded.cameras)}, got {args.camera}")
    return loaded


def open_source(loaded: scenario.Scenario, config: SourceConfig, args: argparse.Namespace) -> Source:
    """The source of ``--camera``. Raises as ``open_sources``."""
    return open_sources(loaded, config, [args.camera], args.data)[args.camera]


def read_shots(source: Source, codec: str, pace: Callable[[int], bool]) -> Iterator[tuple[int, Shot, Image]]:
    """Read (stamp in ns, shot, decoded image) until ``pace`` returns False or a recording ends. A shot that cannot
    be read is reported and skipped.

    codec: of images that are encoded.
    pace: called with the number of ticks so far.
    """
    # A source that never repeats follows the time of day, as in a node.
    first = 0 if source.contents is not None else round(WallClock().now_ns() * source.fps / 10**9)
    for tick in itertools.count():
        if (source.contents is not None and tick >= source.contents) or not pace(tick):
            return
        try:
            shot = source.read(source.content(first + tick))
        except ValueError as error:
            print(f"\n{error}", file=sys.stderr)
            continue
        image = shot.image
        if isinstance(image, bytes):
            image = payload.decode(image, codec, shot.intrinsics.width, shot.intrinsics.height)
        tick_ns = round((first + tick) * 10**9 / source.fps)
        yield tick_ns if shot.captured_ns is None else shot.captured_ns, shot, image


def read_images(loaded: scenario.Scenario, config: SourceConfig, args: argparse.Namespace) -> Iterator[Image]:
    """Images (H, W, 3) uint8 RGB of ``--camera``, whose lens need not be known, until time is over or a recording
    ends. Raises as ``open_source``."""
    if not isinstance(config, LiveConfig):
        source = open_source(loaded, config, args)
        try:
            for _, _, image in read_shots(source, config.codec, Pace(float(source.fps), args.seconds)):
                yield image
        finally:
            source.release()
        return
    # Not from its source, which would require the lens.
    fps = rate(config.fps or DEFAULT_FPS)
    feed = open_feed(args.camera, config, fps, WallClock())
    pace = Pace(float(fps), args.seconds)
    try:
        for tick in itertools.count():
            if not pace(tick):
                return
            taken = feed.grab(config.first_frame_s if tick == 0 else _GRAB_S)
            if taken is not None:
                yield taken[1]
    except Exception as error:  # drivers raise what they like
        print(f"\n{as_camera_error(args.camera, error)}; what there is:", file=sys.stderr)
    finally:
        feed.close()


class Pace:
    """Waits for the time of each tick. Returns False once ``seconds`` have passed."""

    def __init__(self, fps: float, seconds: float | None) -> None:
        self._fps, self._seconds = fps, seconds
        self._start = time.monotonic()

    def __call__(self, tick: int) -> bool:
        at_s = tick / self._fps
        if self._seconds is not None and at_s > self._seconds:
            return False
        time.sleep(max(0.0, self._start + at_s - time.monotonic()))
        return True


def draw_step(image: Image, corners: Corners | None, step: Step) -> Image:
    """An image as (H + 40, W, 3) RGB, gray, with circles at the corners found, and the step below it."""
    gray = to_gray(image)
    out = np.zeros((gray.shape[0] + 40, max(gray.shape[1], 320), 3), dtype=np.uint8)
    out[: gray.shape[0], : gray.shape[1]] = gray[..., None]
    for x, y in () if corners is None else corners.pixels:
        cv2.circle(out, (round(x - 0.5), round(y - 0.5)), 4, _GREEN, 1, cv2.LINE_AA)
    color = _GREEN if step.outcome == KEPT else _ORANGE
    for line, text in enumerate((step.progress, f"{step.outcome}: {step.advice}")):
        at = (6, gray.shape[0] + 15 + 17 * line)
        cv2.putText(out, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, 1, cv2.LINE_AA)
    return out


def _report(step: Step) -> None:
    """Print a step: on a terminal every one, on the same line; elsewhere only those that kept an image."""
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns - 1
        print(f"\r{step.line[:width]:{width}}", end="\n" if step.outcome == KEPT else "", file=sys.stderr)
    elif step.outcome == KEPT:
        print(step.line, file=sys.stderr)


def _write_image(path: Path, image: Image) -> None:
    """Write an RGB image (H, W, 3) atomically. Raises OSError."""
    done, data = cv2.imencode(path.suffix or ".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise OSError(f"{path}: not a kind of picture")
    files.write_bytes(path, data.tobytes())
