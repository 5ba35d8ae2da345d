"""Shots as they are sent: compressed once, cached while there is room."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from camera_node.capture_schedule import CaptureSchedule, RateSchedule, ScheduledSource
from camera_node.clocks import ClockError, NodeClock
from camera_node.config import SourceConfig
from camera_node.sources.base import Source
from freshfield import payload
from freshfield.clock import Clock
from freshfield.geometry import Pinhole, Pose


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
