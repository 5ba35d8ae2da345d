"""The cameras of a scenario and their compressed shots, which are cached while there is room."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from camera_node import node_constants as tuned
from camera_node.clocks import ClockError, NodeClock
from camera_node.settings import SourceConfig
from camera_node.sources.base import Shot, Source
from camera_node.sources.registry import open_sources
from camera_node.sources.with_effects import camera_effects
from freshfield import payload
from freshfield.clock import Clock
from freshfield.depth import EncodedDepth
from freshfield.scenario import Scenario

log = logging.getLogger("camera-node")

# 2^32 by the golden ratio: shot k has depth if k * _DEPTH_STEP mod 2^32 is below 2^32 / depth_every. That is one in
# depth_every shots, spread evenly (for 5: 3, 5 or 8 apart), and also one in depth_every of every second, third, ...
# shot. With a fixed stride, a link that takes every n-th capture could miss all shots with depth.
_DEPTH_STEP = 0x9E3779B9


class ShotCache:
    """Compressed shots by (camera, content), up to ``max_bytes``. Thread-safe. Nothing is evicted.

    Shots repeat in a fixed order, so the oldest one is needed next. Without eviction, a full cache serves its
    share of every round.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes = max_bytes
        self.bytes = 0
        self._shots: dict[tuple[str, int], Shot] = {}
        self._lock = threading.Lock()

    def get(self, camera: str, content: int) -> Shot | None:
        return self._shots.get((camera, content))

    def put(self, camera: str, content: int, shot: Shot) -> None:
        """Keep a shot if it fits."""
        with self._lock:
            size = len(shot.payload) + _depth_bytes(shot)
            if self.bytes + size <= self.max_bytes and (camera, content) not in self._shots:
                self._shots[camera, content] = shot
                self.bytes += size


class Camera:
    """A source, with compression by the scenario's codec and the process's cache.

    waits: whether a capture may wait for hardware.

    config: gives codec and quality. cache: shared by the process's cameras.
    clock_error: error of the camera's clock; None: the clock is exact.
    depth_every: one in this many shots is sent with its depth, if the source has any; 0: none.

    depth_failed: number of shots that have no depth because it could not be made or sent.
    """

    def __init__(
        self,
        source: Source,
        config: SourceConfig,
        cache: ShotCache,
        clock_error: ClockError | None = None,
        depth_every: int = 0,
    ) -> None:
        self.name = source.camera
        self.fps = source.fps
        self.source = source
        self.codec = source.recorded_codec or config.codec
        # A camera that waits for a device or an arm must not delay the others.
        arm = getattr(config, "arm", None)
        self.waits = config.waits or (arm is not None and source.camera in arm.cameras)
        self._quality = config.quality
        self._cache = cache
        self._clock_error = clock_error
        self._depth_every = depth_every
        self.depth_failed = 0

    def clock(self, true: Clock) -> NodeClock:
        """The clock with which this camera stamps frames. true: a clock without error."""
        return NodeClock(true, self._clock_error)

    def cached(self, tick: int) -> Shot | None:
        """The tick's shot if it is cached, else None."""
        if self.source.contents is None:
            return None
        return self._cache.get(self.name, self.source.content(tick))

    def capture(self, tick: int) -> Shot:
        """The tick's shot, from the cache or newly made. Making it takes milliseconds: do not call this on
        the event loop.

        Raises ValueError if the source has no such shot or its image cannot be sent, OSError if its file is gone. A
        shot whose depth alone fails comes without depth.
        """
        return self.shot(self.source.content(tick))

    def shot(self, content: int) -> Shot:
        """The source's shot number ``content``, from the cache or newly made; a repeating shot is cached
        while there is room. Raises as ``capture``."""
        if self.source.contents is None:
            return self._encode(content)
        shot = self._cache.get(self.name, content)
        if shot is None:
            shot = self._encode(content)
            self._cache.put(self.name, content, shot)
        return shot

    def fits(self) -> bool:
        """Whether all shots will fit into the cache, estimated from the size of the first, which is made."""
        contents = self.source.contents
        if contents is None:
            return False
        try:
            shot = self.shot(0)
        except (ValueError, OSError):
            return False
        depths = -(-contents // self._depth_every) if self._depth_every else 0
        more = (contents - 1) * len(shot.payload) + (depths - 1) * _depth_bytes(shot)
        return self._cache.bytes + more <= self._cache.max_bytes

    def _encode(self, content: int) -> Shot:
        try:
            shot = self.source.read(content)
        except (ValueError, OSError):
            raise
        except Exception as error:  # a plug-in source may raise anything: only this shot is lost
            raise ValueError(repr(error)) from error
        data = shot.image
        if not isinstance(data, bytes):
            data = payload.encode(data, self.codec, self._quality)
        payload.check(data, self.codec, shot.intrinsics.width, shot.intrinsics.height)
        depth = self._depth_to_send(content, shot, len(data)) if self._depth_every else None
        return replace(shot, image=data, depth=None, encoded_depth=depth)

    def _depth_to_send(self, content: int, shot: Shot, image_bytes: int) -> EncodedDepth | None:
        """The shot's depth; None if it has none, or if it cannot be sent. The image is then sent alone; the failure is
        counted, and logged the first time."""
        try:
            depth = self._encode_depth(content, shot)
            if depth is not None:
                depth.check(shot.intrinsics, image_bytes)
        except Exception as error:  # a plug-in source may raise anything
            if not self.depth_failed:
                why = error if isinstance(error, ValueError | OSError) else repr(error)
                log.warning("%s: frame sent without depth: %s (further ones are only counted)", self.name, why)
            self.depth_failed += 1
            return None
        return depth

    def _encode_depth(self, content: int, shot: Shot) -> EncodedDepth | None:
        if self.source.recorded_codec is not None:
            return self.source.encoded_depth(content)
        wanted = content * _DEPTH_STEP % 2**32 * self._depth_every < 2**32
        measured = self.source.depth(content, shot) if wanted else None
        return None if measured is None else measured.encode()


def _depth_bytes(shot: Shot) -> int:
    return 0 if shot.encoded_depth is None else len(shot.encoded_depth.payload)


def build_cameras(
    scenario: Scenario,
    config: SourceConfig,
    cameras: Sequence[str],
    data: Path | None = None,
    cache_bytes: int = tuned.SHOT_CACHE_BYTES,
) -> list[Camera]:
    """Open the sources of ``cameras`` with one common cache. Returns them in the scenario's order.

    data: folder of the data sets; None: $FRESHFIELD_DATA.
    cache_bytes: bound on the cached payloads.
    Raises ScenarioError, DatasetError, CameraError or ArmError, each with a message of one line.
    """
    effects = {camera: camera_effects(scenario, config, camera) for camera in cameras}
    sources = open_sources(scenario, config, cameras, data, effects)
    cache = ShotCache(cache_bytes)
    clock_errors = {c: made for c, made in effects.items() if made is not None and made.clock}
    every = {c: 0 if c in scenario.held_out else config.depth_every for c in scenario.cameras}
    return [Camera(sources[c], config, cache, clock_errors.get(c), every[c]) for c in scenario.cameras if c in sources]


def prepare(cameras: Sequence[Camera], stopped: Callable[[], bool]) -> None:
    """Cache all shots of each camera whose shots fit as a whole, and free the resources that made them.

    Other cameras make their shots as they are captured: making a part of them now would delay the first frame
    and save little. Returns early once ``stopped()`` is true.
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
    """Return freed memory to the system if the C library can; glibc would keep it otherwise."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
