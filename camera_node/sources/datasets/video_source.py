"""Video files with a calibration JSON, streamed by live cameras at the videos' own pace."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

from camera_node.config import RecordedConfig, SourceConfig, TrajectoryConfig, VideoConfig, find_data
from camera_node.pose.providers import FixedPose, PoseProvider, TrajectoryError, read_tum
from camera_node.sources import Shot, Source
from camera_node.sources.assignment import assigned
from camera_node.sources.datasets.imaging import shrink
from camera_node.sources.datasets.records import DatasetError, Image
from camera_node.sources.datasets.video import VideoRig, load_rig, open_clip
from camera_node.sources.datasets.video_clip import Clip
from camera_node.sources.playback import Playback, rate
from freshfield.geometry import Pinhole
from freshfield.scenario import Scenario, ScenarioError

# Videos only decode forwards: on the way back, this many (shrunk) frames are decoded at once.
_BLOCK = 12


class VideoSource:
    """One camera of a video rig."""

    def __init__(
        self, camera: str, rig: VideoRig, name: str, scale: float, playback: Playback, poses: PoseProvider
    ) -> None:
        self.camera = camera
        self.fps = playback.fps
        self.contents: int | None = playback.count
        self.intrinsics: Pinhole = shrink(rig.cameras[name].intrinsics, scale)
        self._rig, self._name = rig, name
        self._playback = playback
        self._poses = poses
        self._clip: Clip | None = None
        self._last = -1
        self._block: OrderedDict[int, Image] = OrderedDict()

    def content(self, tick: int) -> int:
        return self._playback.frame(tick)

    def read(self, content: int) -> Shot:
        t_ns = (
            content * 10**9 * self._playback.recorded_fps.denominator // self._playback.recorded_fps.numerator
        )
        paired = self._poses.at(t_ns)
        return Shot(self._image(content), paired.pose, self.intrinsics, paired.gap_ns)

    def prepare(self, stopped: Callable[[], bool]) -> None:
        """Nothing beyond the shots themselves can be made ahead."""

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


def open_sources(
    scenario: Scenario, config: SourceConfig, cameras: Sequence[str], data: Path | None
) -> dict[str, Source]:
    """See ``camera_node.sources.open_sources``."""
    config = cast(VideoConfig, config)
    folder = find_data(config.data, scenario, data)
    rig = load_rig(folder, config.files)
    return rig_sources(
        scenario, config, cameras, rig, folder,
        lambda camera, name: _poses(scenario, config, folder, rig, camera, name),
    )  # fmt: skip


def rig_sources(
    scenario: Scenario,
    config: RecordedConfig,
    cameras: Sequence[str],
    rig: VideoRig,
    folder: Path,
    poses: Callable[[str, str], PoseProvider],
) -> dict[str, Source]:
    """Live ``cameras`` that show a rig's videos. poses: of a scenario's camera, played by a rig's. Raises
    ScenarioError or DatasetError."""
    names = assigned(scenario, config.assignment, cameras, list(rig.cameras))
    clips = {name: open_clip(rig, name) for name in rig.cameras}
    # All cameras turn round at the same frame, or they would drift apart at every turn.
    count = min(clip.count for clip in clips.values())
    rates = {rate(clip.fps) for clip in clips.values()}
    for clip in clips.values():
        clip.close()
    if len(rates) != 1:
        raise DatasetError(f"{folder}: the videos differ in frame rate: {', '.join(map(str, sorted(rates)))}")
    recorded = rates.pop()
    fps = rate(config.fps) if config.fps else recorded
    playback = Playback(count, fps, recorded, config.loop == "back-and-forth")
    return {
        camera: VideoSource(camera, rig, name, config.scale, playback, poses(camera, name))
        for camera, name in names.items()
    }


def _poses(
    scenario: Scenario, config: VideoConfig, folder: Path, rig: VideoRig, camera: str, name: str
) -> PoseProvider:
    where = f"{scenario.path}: source.trajectory"
    wanted: TrajectoryConfig | None = config.trajectory
    if wanted is not None and camera in wanted.files:
        base = folder if folder.is_dir() else folder.parent
        gap_ns = round(wanted.max_gap_ms * 1e6)
        try:
            track = read_tum(base / wanted.files[camera], wanted.pairing == "interpolated", gap_ns)
        except TrajectoryError as error:
            raise ScenarioError(f"{where}.files.{camera}: {error}") from None
        shifted = _Shifted(track, round(wanted.start_s * 1e9))
        return _mounted(shifted, base / wanted.hand_eye, where) if wanted.hand_eye else shifted
    pose = rig.cameras[name].pose
    if pose is None:
        raise ScenarioError(f"{where}.files.{camera}: missing, and the calibration has no pose for {name}")
    return FixedPose(pose)


def _mounted(hand: PoseProvider, file: Path, where: str) -> PoseProvider:
    from camera_node.robot.arm.hand_eye_mount import HandEyeError, read_hand_eye

    try:
        return read_hand_eye(file).camera_poses(hand)
    except HandEyeError as error:
        raise ScenarioError(f"{where}.hand_eye: {error}") from None


class _Shifted:
    """A trajectory on its own clock, asked in clip time."""

    def __init__(self, track: PoseProvider, start_ns: int) -> None:
        self._track = track
        self._start_ns = start_ns

    def at(self, t_ns: int):  # type: ignore[no-untyped-def]
        return self._track.at(t_ns + self._start_ns)
