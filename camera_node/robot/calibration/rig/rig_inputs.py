"""What a rig saw of a target: a folder of pictures or a video a camera, or the cameras of a scenario, live."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.calibration_constants import (
    LIVE_WAIT_S,
    MOMENT_S,
    NEW_SHARE,
    STILL_PX,
    UNKNOWN_FOV_DEG,
)
from camera_node.robot.calibration.inputs import find_corners, list_images, show_progress
from camera_node.robot.calibration.targets import Corners, GrayImage, Target, to_gray
from camera_node.sources.datasets.video import Clip

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm")


@dataclass
class RigViews:
    """What was seen. corners: camera -> moment -> corners. sizes: width and height of each camera's images. unused:
    camera -> reason for each image without corners."""

    corners: dict[str, dict[str, Corners]] = field(default_factory=dict)
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    unused: dict[str, dict[str, str]] = field(default_factory=dict)


def read_folder(folder: Path, target: Target) -> RigViews:
    """Views of a folder with one folder of pictures (``cam00/0007.png``: pictures of one moment have one name) or one
    video (``cam00.mp4``; all begin at the same instant) a camera. Raises CalibrationError."""
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: no such folder")
    entries = sorted(e for e in folder.iterdir() if not e.name.startswith("."))
    cameras = [e for e in entries if e.is_dir() or e.suffix.lower() in VIDEOS]
    if len(cameras) < 2:
        raise CalibrationError(
            f"{folder}: expected a folder of pictures or a video for each of at least two cameras, found "
            f"{len(cameras)}: cam00/0001.png, cam01/0001.png, or cam00.mp4, cam01.mp4"
        )
    views = RigViews()
    for entry in cameras:
        name = entry.stem if entry.is_file() else entry.name
        if entry.is_file():
            views.corners[name], views.sizes[name] = _of_video(entry, target)
            continue
        found, views.unused[name], size = find_corners(list_images(entry), target)
        views.corners[name] = {Path(file).stem: corners for file, corners in found.items()}
        views.sizes[name] = size
    for name, seen in views.corners.items():
        if not seen:
            why = next(iter(views.unused.get(name, {}).values()), f"{target.name} not found")
            raise CalibrationError(f"{folder}: {name} never sees the target: {why}")
    return views


def _of_video(file: Path, target: Target) -> tuple[dict[str, Corners], tuple[int, int]]:
    """Corners by moment, each MOMENT_S, at which the target stood still between two frames; and the images' size."""
    found: dict[str, Corners] = {}
    with closing(Clip(file)) as clip:
        size, times_s = (clip.width, clip.height), clip.times_s - clip.times_s[0]
        for moment_s in np.arange(0.0, times_s[-1], MOMENT_S):
            first = int(np.abs(times_s[:-1] - moment_s).argmin())
            before, now = (target.find(to_gray(clip.frame(index, *size))) for index in (first, first + 1))
            show_progress(f"{file.name} {moment_s:.1f} s")
            if before is not None and now is not None and moved_px(before, now) < STILL_PX:
                found[f"{moment_s:.1f}s"] = now
    return found, size


def moved_px(before: Corners, now: Corners) -> float:
    """Largest motion of a corner that both have, pixels; infinite if they have none in common."""
    places = {tuple(point): pixel for point, pixel in zip(before.points, before.pixels)}
    both = [(places[tuple(point)], pixel) for point, pixel in zip(now.points, now.pixels) if tuple(point) in places]
    return max((float(np.abs(a - b).max()) for a, b in both), default=np.inf)


Grab = Callable[[], GrayImage | None]


def watch(cameras: Mapping[str, Grab], target: Target, seconds: float | None, tell: Callable[[str], None]) -> RigViews:
    """Views taken live while somebody moves the target about and holds it still, until ``seconds`` are over or Ctrl-C.

    cameras: name -> function that returns its newest image, None without one. tell: gets a line with the number of
    moments of each camera each time that one was kept, or that a camera went silent or came back.
    """
    views = RigViews({name: {} for name in cameras})
    before: dict[str, Corners | None] = dict.fromkeys(cameras)
    kept: dict[str, Corners | None] = dict.fromkeys(cameras)
    silent: list[str] = []
    began = time.monotonic()
    try:
        for moment in itertools.count(1):
            if seconds is not None and time.monotonic() - began > seconds:
                break
            now: dict[str, Corners | None] = {}
            images = {name: grab() for name, grab in cameras.items()}  # first: finding the target takes long
            for name, image in images.items():
                now[name] = None if image is None else target.find(image)
                if image is not None:
                    views.sizes[name] = (image.shape[1], image.shape[0])
            still = {n: c for n, c in now.items() if c and (b := before[n]) and moved_px(b, c) < 2 * STILL_PX}
            new = len(still) == sum(c is not None for c in now.values()) and any(
                (k := kept[n]) is None or moved_px(k, c) > NEW_SHARE * views.sizes[n][0] for n, c in still.items()
            )
            if new:
                for name, corners in still.items():
                    views.corners[name][f"{moment}"] = kept[name] = corners
            silent, before_silent = [name for name, image in images.items() if image is None], silent
            if new or silent != before_silent:
                counts = ", ".join(f"{name} {len(seen)}" for name, seen in views.corners.items())
                tell(counts + (f"; no picture of {', '.join(silent)}: unplugged?" if silent else ""))
            before = now
    except KeyboardInterrupt:
        print("stopped; what there is:", file=sys.stderr)
    return views


def open_cameras(scenario_file: str) -> tuple[dict[str, Grab], Callable[[], None]]:
    """The live cameras of a scenario, before they have a calibration: functions for ``watch``, and one that closes
    them. Raises ScenarioError, CameraError."""
    from camera_node.settings import LiveConfig, source_config
    from camera_node.sources.devices.feed import CameraError
    from camera_node.sources.devices.live import LiveSource, open_live
    from freshfield.scenario import load

    loaded = load(scenario_file)
    config = source_config(loaded)
    if not isinstance(config, LiveConfig):
        raise CalibrationError(f"{loaded.path}: source.kind {config.kind}: expected camera, oak or realsense")
    sources = open_live(loaded, config, loaded.cameras, UNKNOWN_FOV_DEG)

    def newest(source: LiveSource) -> GrayImage | None:
        until_s = time.monotonic() + LIVE_WAIT_S
        while time.monotonic() < until_s:
            with suppress(CameraError):  # no new frame yet
                return to_gray(np.asarray(source.read(0).image))
        return None

    def close() -> None:
        for source in sources.values():
            source.close()

    return {camera: partial(newest, source) for camera, source in sources.items()}, close
