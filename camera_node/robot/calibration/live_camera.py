"""The scenario's camera, its images and the progress display of both ``calibrate ... --live`` commands."""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.config import SourceConfig
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.session import KEPT
from camera_node.sources.base import Shot, Source
from camera_node.sources.registry import open_sources
from freshfield import files, payload, scenario
from freshfield.clock import WallClock

Image = NDArray[np.uint8]


def load_scenario(args: argparse.Namespace) -> scenario.Scenario:
    """The scenario ``--live``, which must have ``--camera``. Raises CalibrationError and ScenarioError."""
    loaded = scenario.load(args.live)
    if args.camera not in loaded.cameras:
        raise CalibrationError(f"--camera: {loaded.path} has {', '.join(loaded.cameras)}, got {args.camera}")
    return loaded


def open_source(loaded: scenario.Scenario, config: SourceConfig, args: argparse.Namespace) -> Source:
    """The source of ``--camera``. Raises as ``open_sources``."""
    return open_sources(loaded, config, [args.camera], args.data)[args.camera]


def first_tick(source: Source) -> int:
    """First tick to read. A source that never repeats follows the time of day, as in a node."""
    return 0 if source.contents is not None else round(WallClock().now_ns() * source.fps / 10**9)


def read_shots(
    source: Source, codec: str, pace: Callable[[int], bool], first: int
) -> Iterator[tuple[int, Shot, Image]]:
    """Read (tick, shot, decoded image) until ``pace`` returns False or a recording ends. A shot that cannot
    be read is reported and skipped.

    codec: of images that are encoded.
    pace: called with the number of ticks so far.
    first: tick to begin with.
    """
    for tick in itertools.count():
        if (source.contents is not None and tick >= source.contents) or not pace(tick):
            return
        try:
            shot = source.read(source.content(first + tick))
        except ValueError as error:
            report_skipped(error)
            continue
        image = shot.image
        if isinstance(image, bytes):
            image = payload.decode(image, codec, shot.intrinsics.width, shot.intrinsics.height)
        yield first + tick, shot, image


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


def report_skipped(error: Exception) -> None:
    print(f"\n{error}", file=sys.stderr)


def report_step(outcome: str, line: str) -> None:
    """Print a step: on a terminal every one, on the same line; elsewhere only those that kept an image."""
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns - 1
        print(f"\r{line[:width]:{width}}", end="\n" if outcome == KEPT else "", file=sys.stderr)
    elif outcome == KEPT:
        print(line, file=sys.stderr)


def write_image(path: Path, image: Image) -> None:
    """Write an RGB image (H, W, 3) atomically. Raises OSError."""
    done, data = cv2.imencode(path.suffix or ".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not done:
        raise OSError(f"{path}: not a kind of picture")
    files.write_bytes(path, data.tobytes())
