"""Sources that stream a recorded data set of any format as if live.

A recording of several cameras is played back at its own rate. Photos of a static scene are split: every
eighth goes to the held-out cameras, the others round-robin to the training cameras, and each camera steps
through its photos back and forth, like a moving camera.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from camera_node.config import FPS_RANGE, RecordedConfig, TrajectoryConfig, VideoConfig, errors_of, find_data
from camera_node.pose.providers import FixedPose, PoseProvider, read_tum
from camera_node.sources.assignment import assign_cameras
from camera_node.sources.base import Shot, Source, rate
from camera_node.sources.datasets.formats import open_configured
from camera_node.sources.datasets.imaging import shrink
from camera_node.sources.datasets.records import Dataset, DatasetError, Image, PosedImage
from camera_node.sources.datasets.video import VideoRig, open_clip
from camera_node.sources.datasets.video_clip import Clip
from freshfield import payload
from freshfield.geometry import Pose
from freshfield.scenario import Scenario, ScenarioError

HOLD_OUT_EVERY = 8
PHOTO_FPS = 10.0
# Videos decode only forwards: for backward playback, this many (shrunk) frames are decoded at once.
_BLOCK = 12
_SUFFIXES = {"jpeg": (".jpg", ".jpeg")}


@dataclass(frozen=True)
class Playback:
    """Maps ticks to frames.

    count: number of frames. fps: rate of the ticks. recorded_fps: rate of the frames.
    back_and_forth: 0 1 2 3 2 1 0 1 ..., so that motion never jumps; otherwise 0 1 2 3 0 1 ...
    """

    count: int
    fps: Fraction
    recorded_fps: Fraction
    back_and_forth: bool = True

    def frame(self, tick: int) -> int:
        """Number of the frame nearest to the tick's instant."""
        position = (2 * tick * self.recorded_fps + self.fps) // (2 * self.fps)  # rounds half up, exactly
        if not self.back_and_forth:
            return int(position % self.count)
        period = max(1, 2 * (self.count - 1))
        place = int(position % period)
        return place if place < self.count else period - place


def open_recorded(
    scenario: Scenario, config: RecordedConfig, cameras: Sequence[str], data: Path | None
) -> dict[str, Source]:
    """See ``camera_node.sources.registry.open_sources``."""
    path = find_data(config.data, scenario, data)
    found = open_configured(path, config)
    if isinstance(found, VideoRig):
        return _video_sources(scenario, config, cameras, found, path)
    if found.moving or found.per_camera:
        names = assign_cameras(scenario, config.assignment, cameras, found.cameras)
        shown = {camera: found.of(name) for camera, name in names.items()}
        recorded = {camera: _recorded_fps(found, shown[camera], path) for camera in cameras}
    else:
        shares = split_photos(len(found), scenario.training, scenario.held_out)
        shown = {camera: tuple(found[i] for i in shares[camera]) for camera in cameras}
        recorded = {camera: rate(config.fps or PHOTO_FPS) for camera in cameras}
    return {
        camera: ImageSource(camera, shown[camera], _playback(config, len(shown[camera]), fps), config.codec)
        for camera, fps in recorded.items()
    }


def split_photos(count: int, training: Sequence[str], held_out: Sequence[str]) -> dict[str, list[int]]:
    """Image indices of each camera. Images with index % 8 == 0 go to the held-out cameras in turn (if there
    are any), the others to the training cameras in turn. Raises DatasetError if a camera would get none."""
    truth = [i for i in range(count) if i % HOLD_OUT_EVERY == 0] if held_out else []
    rest = [i for i in range(count) if i not in set(truth)]
    shares = {camera: truth[k :: len(held_out)] for k, camera in enumerate(held_out)}
    shares |= {camera: rest[k :: len(training)] for k, camera in enumerate(training)}
    empty = [camera for camera, share in shares.items() if not share]
    if empty:
        raise DatasetError(f"{count} images are too few: none is left for {', '.join(empty)}; use fewer cameras")
    return shares


def _playback(config: RecordedConfig, count: int, recorded: Fraction) -> Playback:
    fps = rate(config.fps) if config.fps else recorded
    return Playback(count, fps, recorded, config.loop == "back-and-forth")


def _recorded_fps(dataset: Dataset, images: Sequence[PosedImage], path: Path) -> Fraction:
    if dataset.fps is not None:
        return _recorded_rate(dataset.fps, path)
    times = [image.time_s for image in images if image.time_s is not None]
    if len(times) < 2 or times[-1] <= times[0]:
        return rate(PHOTO_FPS)
    return _recorded_rate((len(times) - 1) / (times[-1] - times[0]), path)


def _recorded_rate(fps: float, path: Path) -> Fraction:
    """A recording's rate as a fraction. Raises DatasetError if it is outside FPS_RANGE."""
    lowest, highest = FPS_RANGE
    if not lowest <= fps <= highest:
        raise DatasetError(
            f"{path}: recorded {fps:g} frames a second, as its fps or times say: expected {lowest:g} to "
            f"{highest:g}, with times in seconds"
        )
    return rate(fps)


class ImageSource(Source):
    """A camera that shows image files one after the other."""

    def __init__(self, camera: str, images: Sequence[PosedImage], playback: Playback, codec: str) -> None:
        self.camera, self.fps = camera, playback.fps
        self.contents = len(images)
        self.intrinsics = images[0].intrinsics
        self._images, self._playback, self._codec = images, playback, codec

    def content(self, tick: int) -> int:
        return self._playback.frame(tick)

    def read(self, content: int) -> Shot:
        shown = self._images[content]
        image = self._as_stored(shown) or shown.read()
        return Shot(image, Pose.from_matrix(shown.camera_to_world), shown.intrinsics)

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


class VideoSource(Source):
    """One camera of a video rig."""

    def __init__(
        self, camera: str, rig: VideoRig, name: str, scale: float, playback: Playback, poses: PoseProvider
    ) -> None:
        self.camera, self.fps = camera, playback.fps
        self.contents = playback.count
        self.intrinsics = shrink(rig.cameras[name].intrinsics, scale)
        self._rig, self._name = rig, name
        self._playback, self._poses = playback, poses
        self._clip: Clip | None = None
        self._last = -1
        self._block: OrderedDict[int, Image] = OrderedDict()

    def content(self, tick: int) -> int:
        return self._playback.frame(tick)

    def read(self, content: int) -> Shot:
        fps = self._playback.recorded_fps
        pose, gap_ns = self._poses.at(content * 10**9 * fps.denominator // fps.numerator)
        return Shot(self._image(content), pose, self.intrinsics, gap_ns)

    def release(self) -> None:
        if self._clip is not None:
            self._clip.close()
        self._clip = None
        self._block.clear()

    def _image(self, index: int) -> Image:
        backwards, self._last = index < self._last, index
        if index in self._block:
            return self._block[index]
        if self._clip is None:
            self._clip = open_clip(self._rig, self._name)
        self._block.clear()
        width, height = self.intrinsics.width, self.intrinsics.height
        if not backwards:
            return self._clip.frame(index, width, height)
        for i in range(max(0, index - _BLOCK + 1), index + 1):
            self._block[i] = self._clip.frame(i, width, height)
        return self._block[index]


def _video_sources(
    scenario: Scenario, config: RecordedConfig, cameras: Sequence[str], rig: VideoRig, path: Path
) -> dict[str, Source]:
    names = assign_cameras(scenario, config.assignment, cameras, list(rig.cameras))
    clips = {name: open_clip(rig, name) for name in rig.cameras}
    # All cameras turn back at the same frame; otherwise they would drift apart at every turn.
    count = min(clip.count for clip in clips.values())
    rates = {_recorded_rate(clip.fps, clip.path) for clip in clips.values()}
    for clip in clips.values():
        clip.close()
    if len(rates) != 1:
        raise DatasetError(f"{path}: the videos differ in frame rate: {', '.join(map(str, sorted(rates)))}")
    playback = _playback(config, count, rates.pop())
    trajectory = config.trajectory if isinstance(config, VideoConfig) else None
    base = path if path.is_dir() else path.parent
    where = f"{scenario.path}: source.trajectory"
    sources: dict[str, Source] = {}
    for camera, name in names.items():
        pose = rig.cameras[name].pose
        if trajectory is not None and camera in trajectory.files:
            poses = _trajectory_poses(trajectory, camera, base, where)
        elif pose is not None:
            poses = FixedPose(pose)
        else:
            raise ScenarioError(f"{where}.files.{camera}: missing, and the calibration has no pose for {name}")
        sources[camera] = VideoSource(camera, rig, name, config.scale, playback, poses)
    return sources


def _trajectory_poses(config: TrajectoryConfig, camera: str, base: Path, where: str) -> PoseProvider:
    """Poses of one camera, on the clip's time scale, from the TUM file that the scenario names."""
    with errors_of(f"{where}.files.{camera}"):
        poses = read_tum(
            base / config.files[camera],
            config.pairing == "interpolated",
            round(config.max_gap_ms * 1e6),
            round(config.start_s * 1e9),
        )
    if not config.hand_eye:
        return poses
    from camera_node.robot.arm.hand_eye_mount import read_hand_eye

    with errors_of(f"{where}.hand_eye"):
        return read_hand_eye(base / config.hand_eye).camera_poses(poses)
