"""The images of a data set, streamed by live cameras.

A recording of several cameras plays back at its own pace. A set of photos of something still is dealt out:
every eighth image to the held-out cameras, the others round-robin to the training cameras, and each camera
steps through its images back and forth, as a moving camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction

from camera_node.config import RecordedConfig
from camera_node.sources import Shot, Source
from camera_node.sources.assignment import assigned
from camera_node.sources.datasets.records import Dataset, DatasetError, Record
from camera_node.sources.playback import Playback, rate
from freshfield import payload
from freshfield.geometry import Pose
from freshfield.scenario import Scenario

HOLD_OUT_EVERY = 8
PHOTO_FPS = 10.0


class RecordsSource:
    """A camera that shows records one after the other."""

    def __init__(self, camera: str, records: Sequence[Record], playback: Playback, codec: str) -> None:
        self.camera = camera
        self.fps = playback.fps
        self.contents: int | None = len(records)
        self.intrinsics = records[0].intrinsics
        self._records = records
        self._playback = playback
        self._codec = codec

    def content(self, tick: int) -> int:
        return self._playback.frame(tick)

    def read(self, content: int) -> Shot:
        record = self._records[content]
        image = self._as_stored(record) or record.read()
        return Shot(image, Pose.from_matrix(record.camera_to_world), record.intrinsics)

    def prepare(self, stopped: Callable[[], bool]) -> None:
        """Nothing beyond the shots themselves can be made ahead."""

    def release(self) -> None:
        """Nothing is held between reads."""

    def _as_stored(self, record: Record) -> bytes | None:
        """The file itself where it is what would be sent: compressing twice costs quality for nothing."""
        if record.path is None or record.path.suffix.lower() not in _SUFFIXES.get(self._codec, ()):
            return None
        data = record.path.read_bytes()
        try:
            payload.check(data, self._codec, record.intrinsics.width, record.intrinsics.height)
        except payload.PayloadError:
            return None
        return data


_SUFFIXES = {"jpeg": (".jpg", ".jpeg")}


def streams(
    scenario: Scenario,
    config: RecordedConfig,
    cameras: Sequence[str],
    dataset: Dataset,
    by_camera: bool = False,
) -> dict[str, Source]:
    """Live ``cameras`` that show ``dataset``. by_camera: each image belongs to the camera that took it, also
    where nothing moves. Raises ScenarioError or DatasetError."""
    if dataset.moving or by_camera:
        return _recording(scenario, config, cameras, dataset)
    shares = deal(len(dataset), scenario.training, scenario.held_out)
    fps = rate(config.fps or PHOTO_FPS)
    return {
        camera: RecordsSource(
            camera,
            [dataset[i] for i in shares[camera]],
            Playback(len(shares[camera]), fps, fps, config.loop == "back-and-forth"),
            config.codec,
        )
        for camera in cameras
    }


def deal(count: int, training: Sequence[str], held_out: Sequence[str]) -> dict[str, list[int]]:
    """Image indices of each camera: index % 8 == 0 to the held-out cameras in turn (if there are any), the
    others to the training cameras in turn. Raises DatasetError if a camera would get none."""
    truth = [i for i in range(count) if i % HOLD_OUT_EVERY == 0] if held_out else []
    rest = [i for i in range(count) if i not in set(truth)]
    shares = {camera: truth[k :: len(held_out)] for k, camera in enumerate(held_out)}
    shares |= {camera: rest[k :: len(training)] for k, camera in enumerate(training)}
    empty = [camera for camera, share in shares.items() if not share]
    if empty:
        raise DatasetError(
            f"{count} images are too few: none is left for {', '.join(empty)}; use fewer cameras"
        )
    return shares


def _recording(
    scenario: Scenario, config: RecordedConfig, cameras: Sequence[str], dataset: Dataset
) -> dict[str, Source]:
    names = assigned(scenario, config.assignment, cameras, dataset.cameras)
    sources: dict[str, Source] = {}
    for camera, name in names.items():
        records = dataset.of(name)
        recorded = _recorded_fps(dataset, records)
        fps = rate(config.fps) if config.fps else recorded
        playback = Playback(len(records), fps, recorded, config.loop == "back-and-forth")
        sources[camera] = RecordsSource(camera, records, playback, config.codec)
    return sources


def _recorded_fps(dataset: Dataset, records: Sequence[Record]) -> Fraction:
    if dataset.fps:
        return rate(dataset.fps)
    times = [r.time_s for r in records if r.time_s is not None]
    if len(times) < 2 or times[-1] <= times[0]:
        return rate(PHOTO_FPS)
    return rate((len(times) - 1) / (times[-1] - times[0]))
