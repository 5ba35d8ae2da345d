"""Cameras of a scenario and their shots as they are sent: compressed once, cached while there is room."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from camera_node.capture_schedule import CaptureSchedule, RateSchedule, ScheduledSource
from camera_node.clocks import ClockError, NodeClock
from camera_node.config import SourceConfig
from camera_node.sources.base import Source
from camera_node.sources.registry import open_sources
from camera_node.sources.with_effects import camera_effects
from freshfield import payload
from freshfield.clock import Clock
from freshfield.geometry import Pinhole, Pose
from freshfield.scenario import Scenario


@dataclass(frozen=True)
class EncodedShot:
    """A compressed shot: all of a frame but the instant it was due. captured_ns: see ``Shot``."""

    payload: bytes
    pose: Pose
    intrinsics: Pinhole
    pose_gap_ns: int
    captured_ns: int | None = None


class ShotCache:
    """Compressed shots by (camera, content), up to ``max_bytes``. Nothing is evicted.

    Shots repeat in a fixed order, so the oldest is the one that is needed next: a full cache that keeps what
    it has still serves its share of every round.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.bytes = 0
        self._shots: dict[tuple[str, int], EncodedShot] = {}
        self._lock = threading.Lock()

    def get(self, camera: str, content: int) -> EncodedShot | None:
        return self._shots.get((camera, content))

    def put(self, camera: str, content: int, shot: EncodedShot) -> None:
        """Keep a shot if it fits."""
        with self._lock:
            fits = self.bytes + len(shot.payload) <= self.max_bytes
            if fits and (camera, content) not in self._shots:
                self._shots[camera, content] = shot
                self.bytes += len(shot.payload)


class Camera:
    """A source with the scenario's codec and the process's cache behind it."""

    def __init__(
        self, source: Source, config: SourceConfig, cache: ShotCache, clock_error: ClockError | None = None
    ) -> None:
        self.name = source.camera
        self.fps = source.fps
        self.source = source
        # What is replayed has been compressed already.
        self.codec = source.codec if isinstance(source, ScheduledSource) else config.codec
        self._quality = config.quality
        self._cache = cache
        self._clock_error = clock_error

    def clock(self, true: Clock) -> NodeClock:
        """The clock this camera stamps with, given the true time."""
        return NodeClock(true, self._clock_error)

    def schedule(self, start_ns: int) -> CaptureSchedule:
        """When it captures; a recording that is played once begins at ``start_ns``."""
        source = self.source
        return source.schedule(start_ns) if isinstance(source, ScheduledSource) else self.rate_schedule

    @property
    def rate_schedule(self) -> RateSchedule:
        """The ticks of its rate, at its phase."""
        return RateSchedule(self.fps, self.source.phase_ns)

    def cached(self, tick: int) -> EncodedShot | None:
        """The tick's shot if it is in the cache."""
        if self.source.contents is None:
            return None
        return self._cache.get(self.name, self.source.content(tick))

    def capture(self, tick: int) -> EncodedShot:
        """The tick's shot, made if need be: milliseconds, so not on the event loop.

        Raises ValueError if the source has no such shot or it cannot be sent, OSError if its file is gone.
        """
        return self.shot(self.source.content(tick))

    def shot(self, content: int) -> EncodedShot:
        """One of the source's shots, from the cache or else made; a shot that repeats is kept while there is
        room. Raises as ``capture``."""
        if self.source.contents is None:
            return self._encode(content)
        shot = self._cache.get(self.name, content)
        if shot is None:
            shot = self._encode(content)
            self._cache.put(self.name, content, shot)
        return shot

    def fits(self) -> bool:
        """Whether all shots will fit into the cache, judged by the size of the first, which is made."""
        contents = self.source.contents
        if contents is None:
            return False
        try:
            shot = self.shot(0)
        except (ValueError, OSError):
            return False
        return self._cache.bytes + (contents - 1) * len(shot.payload) <= self._cache.max_bytes

    def _encode(self, content: int) -> EncodedShot:
        shot = self.source.read(content)
        data = shot.image
        if not isinstance(data, bytes):
            data = payload.encode(data, self.codec, self._quality)
        payload.check(data, self.codec, shot.intrinsics.width, shot.intrinsics.height)
        return EncodedShot(data, shot.pose, shot.intrinsics, shot.pose_gap_ns, shot.captured_ns)


def build_cameras(
    scenario: Scenario,
    config: SourceConfig,
    cameras: Sequence[str],
    data: Path | None = None,
    cache_bytes: int = 64 * 2**20,
) -> list[Camera]:
    """Open the sources of ``cameras``, in the scenario's order, with one cache for all.

    data: folder of the data sets, else $FRESHFIELD_DATA.
    cache_bytes: bound on compressed shots kept.

    Raises ScenarioError, DatasetError, CameraError or ArmError, each with one line for a person.
    """
    effects = {camera: camera_effects(scenario, config, camera) for camera in cameras}
    sources = open_sources(scenario, config, cameras, data, effects)
    cache = ShotCache(cache_bytes)
    clock_errors = {c: made for c, made in effects.items() if made is not None and made.clock}
    return [Camera(sources[c], config, cache, clock_errors.get(c)) for c in scenario.cameras if c in sources]


def prepare(cameras: Sequence[Camera], stopped: Callable[[], bool]) -> None:
    """Fill the cache with the shots of each camera whose shots all fit, and free what made them.

    Shots that do not all fit are made as they are captured: making a part of them now would delay the first
    frame and save little.
    """
    for camera in cameras:
        camera.source.prepare(stopped)
        contents = camera.source.contents
        if contents is None or not camera.fits():
            continue
        for content in range(contents):
            if stopped():
                return
            try:
                camera.shot(content)
            except (ValueError, OSError):
                continue  # counted when the capture is due
        camera.source.release()
    return_memory()


def return_memory() -> None:
    """Hand freed memory back to the system where the C library can (glibc keeps it otherwise)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
