"""Sources that stream a recorded data set of any format as if live.

A recording of several cameras is played back at its own rate. Photos of a static scene are split: the data set's own
test images, else every eighth, go to the held-out cameras, the others round-robin to the training cameras, and each
camera steps through its photos back and forth, like a moving camera.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera_node.pose.providers import PoseGapError, PoseProvider
from camera_node.pose.trajectories import trajectory_poses
from camera_node.settings import FPS_RANGE, PHOTO_FPS, RecordedConfig, VideoConfig, find_data
from camera_node.sources.base import Shot, Source, assign_cameras, rate
from camera_node.sources.datasets.formats import open_configured
from camera_node.sources.datasets.records import Dataset, DatasetError, PosedImage
from camera_node.sources.held_out_captures import split_photos, without_held_out_images
from freshfield import payload
from freshfield.depth import DepthImage
from freshfield.geometry import Pose
from freshfield.scenario import Scenario, ScenarioError

log = logging.getLogger("camera-node")

_SUFFIXES = {"jpeg": (".jpg", ".jpeg")}


@dataclass(frozen=True)
class Playback:
    """Maps ticks to frames.

    count: number of frames, which are shown back and forth, 0 1 2 3 2 1 0 1 ..., so that motion never jumps.
    fps: rate of the ticks. recorded_fps: rate of the frames.
    """

    count: int
    fps: Fraction
    recorded_fps: Fraction

    def frame(self, tick: int) -> int:
        """Number of the frame nearest to the tick's instant."""
        position = (2 * tick * self.recorded_fps + self.fps) // (2 * self.fps)  # rounds half up, exactly
        place = int(position % self.period)
        return place if place < self.count else self.period - place

    @property
    def period(self) -> int:
        """Number of frames after which they repeat."""
        return max(1, 2 * (self.count - 1))

    def whole_groups(self, size: int) -> list[int]:
        """The frames of the ticks of one pass, the last few left out so that ticks whose number is a multiple of
        ``size`` show the same frames in every later pass, too. Raises DatasetError for a pass of fewer ticks."""
        ticks = int((self.count - 1) * self.fps / self.recorded_fps) + 1
        kept = (ticks - 1) // size * size + 1
        if kept < size:
            raise DatasetError(f"of every {size} captures one is held out: {ticks} are too few")
        return [self.frame(tick) for tick in range(kept)]


def open_recorded(
    scenario: Scenario, config: RecordedConfig, cameras: Sequence[str], data: Path | None
) -> dict[str, Source]:
    """See ``camera_node.sources.registry.open_sources``."""
    path = find_data(config.data, scenario, data)
    found = open_configured(path, config)
    for note in found.notes:
        log.warning("%s: %s", path, note)
    if any(image.weight for image in found):
        raise DatasetError(
            f"{path}: has masks of pixels that must not be learned from, which a stream cannot carry: use edge-server "
            "fit, or leave the masks out"
        )
    named = [config.assignment[camera] for camera in cameras if camera in config.assignment]
    if wrong := [name for name in named if name not in found.cameras]:
        there = ", ".join(found.cameras) or "none that has a name"
        raise ScenarioError(f"{scenario.path}: source.assignment: the data has no camera {wrong[0]!r} (it has {there})")
    path_of_one = len(scenario.cameras) == 1 == len(found.cameras) and all(image.time_s is not None for image in found)
    if found.moving or found.per_camera or path_of_one:
        names = {cameras[0]: found.cameras[0]} if path_of_one else {}
        names = names or assign_cameras(scenario, config.assignment, cameras, found.cameras)
        shown = {camera: _shown(found, name, camera in scenario.held_out) for camera, name in names.items()}
        recorded = {camera: _recorded_fps(found, shown[camera], path) for camera in cameras}
        used = [config.assignment.get(camera, camera) for camera in scenario.cameras]
        timeline = Timeline.of(found, found.cameras if path_of_one else used, path)
        order = {camera: timeline.nearest(images) for camera, images in shown.items()}
    else:
        own = [i for i, image in enumerate(found) if image.name in found.held_out]
        shares = split_photos(len(found), scenario.training, scenario.held_out, own)
        shown = {camera: tuple(found[i] for i in shares[camera]) for camera in cameras}
        recorded = {camera: rate(config.fps or PHOTO_FPS) for camera in cameras}
        timeline, order = Timeline(0.0, 0, rate(config.fps or PHOTO_FPS)), {}
    poses: dict[str, PoseProvider] = {}
    if isinstance(config, VideoConfig) and config.trajectory is not None:
        base = path if path.is_dir() else path.parent
        poses = trajectory_poses(scenario, config.trajectory, cameras, base)
        for camera in poses:
            if not any(_has_pose(poses[camera], image) for image in shown[camera]):
                raise ScenarioError(
                    f"{scenario.path}: source.trajectory.files.{camera}: no frame is within max_gap_ms of a pose: give "
                    "the trajectory's time at the clip's first frame as start_s"
                )
    sources: dict[str, Source] = {}
    for camera, fps in recorded.items():
        if camera not in poses and np.isnan(shown[camera][0].camera_to_world).any():
            raise ScenarioError(
                f"{scenario.path}: source.trajectory.files.{camera}: missing, and the calibration has no pose for "
                f"{shown[camera][0].camera}"
            )
        shots = order.get(camera, range(len(shown[camera])))
        ticks_per_s = rate(config.fps) if config.fps else fps
        # Photos have no rate of their own: each tick shows the next one.
        playback = Playback(len(shots), ticks_per_s, timeline.fps if timeline.count else ticks_per_s)
        if scenario.held_out_every:
            every = scenario.held_out_every
            shots = without_held_out_images([shots[n] for n in playback.whole_groups(every)], every)
            playback = Playback(len(shots), playback.fps, playback.fps)
        sources[camera] = ImageSource(camera, shown[camera], shots, playback, config.codec, poses.get(camera))
    return sources


def _has_pose(poses: PoseProvider, image: PosedImage) -> bool:
    try:
        poses.at(_time_ns(image))
    except PoseGapError:
        return False
    return True


def _time_ns(image: PosedImage) -> int:
    return round((image.time_s or 0.0) * 1e9)


def _shown(dataset: Dataset, name: str, held_out: bool) -> tuple[PosedImage, ...]:
    """The images of a camera of a recording; of one that is trained on without the data set's own test images, unless
    it has no others."""
    images = dataset.of(name)
    return tuple(image for image in images if held_out or image.name not in dataset.held_out) or images


@dataclass(frozen=True)
class Timeline:
    """Evenly spaced instants of a recording at which every camera shows its nearest image, so that cameras of different
    rates, or that dropped frames, stay together.

    first_s: the first one. count: number of them; 0: each image is an instant of its own. fps: their rate.
    """

    first_s: float
    count: int
    fps: Fraction

    @staticmethod
    def of(dataset: Dataset, used: Sequence[str], path: Path) -> Timeline:
        """From the first instant to the last that all cameras in use have, at the fastest one's rate. Raises
        DatasetError."""
        cameras = [dataset.of(camera) for camera in dataset.cameras if camera in used]
        fps = max(_recorded_fps(dataset, images, path) for images in cameras)
        times = [(images[0].time_s, images[-1].time_s) for images in cameras if len(images) > 1]
        known = [(first, last) for first, last in times if first is not None and last is not None]
        if not known:
            return Timeline(0.0, 0, fps)
        first_s, last_s = max(first for first, _ in known), min(last for _, last in known)
        if all(first == last for first, last in known):
            return Timeline(0.0, 0, fps)  # one instant: nothing moves
        if first_s > last_s:
            raise DatasetError(
                f"{path}: its cameras have no instant in common: one begins at {first_s:g} s, "
                f"another ends at {last_s:g} s"
            )
        return Timeline(first_s, max(1, round((last_s - first_s) * float(fps)) + 1), fps)

    def nearest(self, images: Sequence[PosedImage]) -> Sequence[int]:
        """Index of the image nearest to each instant."""
        if not self.count:
            return range(len(images))
        # Whole nanoseconds, so that rounding errors do not choose between two images that are equally near.
        instants = np.rint(1e9 * (self.first_s + np.arange(self.count) / float(self.fps))).astype(np.int64)
        times = np.rint([1e9 * (image.time_s or 0.0) for image in images]).astype(np.int64)
        after = np.searchsorted(times, instants).clip(max=len(times) - 1)
        before = (after - 1).clip(min=0)
        return [int(k) for k in np.where(instants - times[before] <= times[after] - instants, before, after)]


def _recorded_fps(dataset: Dataset, images: Sequence[PosedImage], path: Path) -> Fraction:
    """The rate of one camera's images. Raises DatasetError if it is outside FPS_RANGE."""
    fps = dataset.fps
    if fps is None:
        times = [image.time_s for image in images if image.time_s is not None]
        if len(times) < 2 or times[-1] <= times[0]:
            return rate(PHOTO_FPS)
        fps = 1.0 / (float(np.median(np.diff(times))) or (times[-1] - times[0]) / (len(times) - 1))
    lowest, highest = FPS_RANGE
    if not lowest <= fps <= highest:
        raise DatasetError(
            f"{path}: recorded {fps:g} frames a second, as its fps or times say: expected {lowest:g} to "
            f"{highest:g}, with times in seconds"
        )
    return rate(fps)


class ImageSource(Source):
    """A camera that shows images one after the other. order: indices of those that playback steps through. poses:
    replace those of the images; None: theirs."""

    def __init__(
        self,
        camera: str,
        images: Sequence[PosedImage],
        order: Sequence[int],
        playback: Playback,
        codec: str,
        poses: PoseProvider | None = None,
    ) -> None:
        self.camera, self.fps = camera, playback.fps
        self.contents, self.timed = len(images), images[0].time_s is not None
        self.intrinsics = images[0].intrinsics
        self.measures = any(image.depth is not None for image in images)
        self.repeats_after = playback.period if playback.fps == playback.recorded_fps else None
        self._images, self._order, self._playback = images, order, playback
        self._codec, self._poses = codec, poses
        self._whole: set[int] = set()

    def content(self, tick: int) -> int:
        return self._order[self._playback.frame(tick)]

    def read(self, content: int) -> Shot:
        shown = self._images[content]
        if self._poses is None:
            pose, gap_ns = Pose.from_matrix(shown.camera_to_world), 0
        else:
            pose, gap_ns = self._poses.at(_time_ns(shown))
        image: NDArray[np.uint8] | bytes | None = self._as_stored(shown)
        if image is None or content not in self._whole:
            decoded = shown.read()  # once also of what is sent as stored: a file that is cut short is refused by name
            self._whole.add(content)
        return Shot(decoded if image is None else image, pose, shown.intrinsics, gap_ns)

    def depth(self, content: int, shot: Shot) -> DepthImage | None:
        measured = self._images[content].depth
        return None if measured is None else measured()

    def release(self) -> None:
        self._images[0].release()

    def _as_stored(self, shown: PosedImage) -> bytes | None:
        """The file's bytes if they can be sent as they are, since compressing again would cost quality."""
        if shown.path is None or shown.path.suffix.lower() not in _SUFFIXES.get(self._codec, ()):
            return None
        data = shown.path.read_bytes()
        try:
            payload.check(data, self._codec, shown.intrinsics.width, shown.intrinsics.height)
        except payload.PayloadError:
            return None
        return data
