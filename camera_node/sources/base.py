"""The interface of frame sources: one camera, which returns the shot of a tick; and which camera of the data it is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from camera_node.capture_schedule import CaptureSchedule, RateSchedule
from freshfield import payload
from freshfield.depth import DepthImage, EncodedDepth
from freshfield.geometry import Pinhole, Pose
from freshfield.scenario import Scenario, ScenarioError


@dataclass(frozen=True)
class Shot:
    """What a camera saw at one instant.

    image: uint8 (H, W, 3) RGB or (H, W, 4) RGBA, or an encoded image (bytes) in the camera's codec; its size
        is that of ``intrinsics``.
    pose: camera-to-world.
    pose_gap_ns: time between the exposure and the pose sample that it was paired with.
    captured_ns: when a real camera exposed it, on the node's clock; None: at the tick's instant.
    depth: what a depth sensor measured with it, of sources that have it at hand; else ``Source.depth`` makes it.
    encoded_depth: the same as it is sent, once the shot is encoded.
    """

    image: NDArray[np.uint8] | bytes
    pose: Pose
    intrinsics: Pinhole
    pose_gap_ns: int = 0
    captured_ns: int | None = None
    depth: DepthImage | None = None
    encoded_depth: EncodedDepth | None = None

    @property
    def payload(self) -> bytes:
        """The image of an encoded shot."""
        assert isinstance(self.image, bytes)
        return self.image


def pixels(shot: Shot, codec: str) -> NDArray[np.uint8]:
    """The shot's image, decoded if need be: uint8 (H, W, 3) or (H, W, 4). codec: of encoded shots."""
    if isinstance(shot.image, bytes):
        return payload.decode(shot.image, codec, shot.intrinsics.width, shot.intrinsics.height)
    return shot.image


def rate(fps: float) -> Fraction:
    """A frame rate as a fraction with a denominator up to 1001: 29.97 is 2997/100, 33.3333 is 100/3."""
    return Fraction(fps).limit_denominator(1001)


class Source(ABC):
    """One camera. Tick k is the instant k / fps + phase_ns since the epoch, so cameras in different processes
    see the same world.

    camera: id in the scenario.
    intrinsics: of the shots; a shot's own hold if they differ.
    contents: number of different shots before they repeat; None if they never repeat.
    repeats_after: number of ticks after which the scene and the camera's path repeat, errors of sensors apart; None if
        they do not, or it is not known.
    recorded_codec: of images that are sent as they were recorded, with their depth; None: they have the scenario's.
    timed: its shots were taken at known times, so that a tracker gave their poses; False for photos, whose poses were
        computed from them.
    measures: whether depth may come with its shots; False: known to be of none.

    A source from outside (``camera_node.settings.own_class``) is constructed with (scenario, config,
    camera). Config: its keys in the scenario, a subclass of ``camera_node.settings.SourceConfig``, whose ``waits`` says
    that it is hardware; None: the keys of every kind.
    """

    camera: str
    fps: Fraction
    intrinsics: Pinhole
    contents: int | None = None
    repeats_after: int | None = None
    recorded_codec: str | None = None
    timed: bool = True
    measures: bool = True
    phase_ns: int = 0
    Config: ClassVar[Any] = None

    def content(self, tick: int) -> int:
        """Number of the shot that a tick shows: 0 to contents - 1, or the tick itself if shots never
        repeat."""
        return tick

    @property
    def poses_refused(self) -> int:
        """Number of lines so far that a tracker wrote and that are no pose."""
        return 0

    def rate_schedule(self) -> RateSchedule:
        """The instants of its ticks."""
        return RateSchedule(self.fps, self.phase_ns)

    def schedule(self, start_ns: int) -> CaptureSchedule:
        """The instants at which a node captures. start_ns: the same for all of its cameras, when a recording that is
        played once begins."""
        return self.rate_schedule()

    @abstractmethod
    def read(self, content: int) -> Shot:
        """Render, read or decode shot number ``content``. Raises ValueError (DatasetError, PoseGapError) if
        it is not available; other shots may still be."""

    def depth(self, content: int, shot: Shot) -> DepthImage | None:
        """What a depth sensor measured with ``shot``, which ``read(content)`` gave; None without a sensor. To be
        asked only for frames that carry depth: it may have to be rendered or decoded. Raises as ``read``."""
        return shot.depth

    def encoded_depth(self, content: int) -> EncodedDepth | None:
        """The depth that came with shot ``content``, as it came, where images have a ``recorded_codec``. Raises
        ValueError for damaged depth."""
        return None

    def prepare(self, stopped: Callable[[], bool]) -> None:  # noqa: B027
        """Render or decode ahead, so that ``read`` is fast. Returns early once ``stopped()`` is true."""

    def release(self) -> None:  # noqa: B027
        """Free decoders and renderers; ``read`` opens them again."""


class Derived(Source):
    """Another source's shots, some of them or changed."""

    def __init__(self, source: Source, camera: str) -> None:
        self.camera, self.intrinsics, self.contents = camera, source.intrinsics, source.contents
        self.fps, self.phase_ns = source.fps, source.phase_ns
        self._source = source

    @property
    def poses_refused(self) -> int:
        return self._source.poses_refused

    def read(self, content: int) -> Shot:
        return self._source.read(content)

    def depth(self, content: int, shot: Shot) -> DepthImage | None:
        return self._source.depth(content, shot)

    def prepare(self, stopped: Callable[[], bool]) -> None:
        self._source.prepare(stopped)

    def release(self) -> None:
        self._source.release()


def assign_cameras(
    scenario: Scenario, assignment: Mapping[str, str], cameras: Sequence[str], available: Sequence[str]
) -> dict[str, str]:
    """The data set camera of each of ``cameras``.

    assignment: scenario camera to data set camera; cameras that it lacks have the same name in both.
    available: names of the data set's cameras.
    Raises ScenarioError if a camera does not exist, or two of the scenario's cameras would show the same one.
    """
    where = f"{scenario.path}: source.assignment"
    for camera in assignment:
        if camera not in scenario.cameras:
            raise ScenarioError(f"{where}.{camera}: not a camera of this scenario")
    names = {camera: assignment.get(camera, camera) for camera in scenario.cameras}
    doubles = {n for n in names.values() if list(names.values()).count(n) > 1}
    if doubles:
        raise ScenarioError(f"{where}: more than one camera shows {', '.join(sorted(doubles))}")
    for camera in cameras:
        if names[camera] not in available:
            raise ScenarioError(
                f"{where}: the data has no camera {names[camera]!r} (it has {', '.join(available)}); name it "
                f"in cameras.ids, or here as {camera}: NAME"
            )
    return {camera: names[camera] for camera in cameras}
