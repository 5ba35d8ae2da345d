"""Posed images of a recording of messages. ``foxglove`` and ``rosbag`` decode their formats to the records below.
Cameras have the name of their frame (``frame_id``).

An image gets the depth nearest in time, within 20 ms, and the pose that the transforms from its frame up to the root
give at its stamp. A transform is interpolated between the two samples around it; one with a single sample stands still.
Of images of a frame with the same stamp one is taken: uncompressed before compressed before gray, then by topic.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial, reduce
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.pose.pairing import PoseGapError, SampleBuffer
from camera_node.pose.providers import FixedPose, PoseProvider
from camera_node.sources.datasets.image_reading import as_image, resize, shrink
from camera_node.sources.datasets.lens import Lens, pinhole, undistort
from camera_node.sources.datasets.photo import ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, Image, PosedImage, errors_at
from camera_node.sources.datasets.rgbd.depth_file import registered, to_counts
from camera_node.sources.source_constants import (
    RECORDING_DEPTH_NEAR_NS,
    RECORDING_PARENTS_NEAR_NS,
    RECORDING_POSE_NEAR_NS,
)
from freshfield.depth import DepthImage
from freshfield.geometry import Pose, quaternion_normalize

# Encoding of raw images -> channels, and OpenCV's conversion to RGB; those of one channel are gray.
_COLORS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
}
_GRAY = ("mono8", "8UC1")
_DEPTHS: dict[str, np.dtype[Any]] = {"16UC1": np.dtype("<u2"), "32FC1": np.dtype("<f4")}
COMPRESSED, COMPRESSED_DEPTH = "compressed", "compressedDepth"
_DEPTH_HEAD_BYTES = 12  # before the PNG of compressed_depth_image_transport: its format and two parameters
_TERMS = {"": 5, "plumb_bob": 5, "rational_polynomial": 5, "equidistant": 4, "fisheye": 4, "kannala_brandt": 4}


@dataclass(frozen=True)
class Picture:
    """An image or depth image. encoding: as ROS names it, COMPRESSED or COMPRESSED_DEPTH; of these two ``form`` is the
    file format, and the sizes are 0. step: bytes a row."""

    frame: str
    stamp_ns: int
    encoding: str
    data: Any
    form: str = ""
    width: int = 0
    height: int = 0
    step: int = 0
    big_endian: bool = False

    @property
    def depth(self) -> bool:
        return self.encoding in _DEPTHS or self.encoding == COMPRESSED_DEPTH

    @property
    def rank(self) -> int:
        """Which of several images of one instant is taken: the lowest."""
        return 2 if self.encoding in _GRAY else int(self.encoding == COMPRESSED)


@dataclass(frozen=True)
class Calibration:
    """A lens. k: 3 x 3, p: 3 x 4 (of rectified images), row by row, OpenCV's pixel origin; d: distortion terms."""

    frame: str
    width: int
    height: int
    model: str
    k: Sequence[float]
    d: Sequence[float]
    p: Sequence[float] = ()


@dataclass(frozen=True)
class Transform:
    """Pose of ``child`` in ``parent``: translation (3,) in meters, rotation (w, x, y, z). static: for ever."""

    parent: str
    child: str
    stamp_ns: int
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    static: bool = False


Record = Picture | Calibration | Transform


class Messages(ABC):
    """What decodes a format. where: its file; name: of its messages; needs: what it calls a lens and a pose; all for
    error messages."""

    where: Path
    name: ClassVar[str]
    needs: ClassVar[tuple[str, str]]

    @abstractmethod
    def read(self, topic: str | None = None, log_ns: int = 0) -> Iterator[tuple[str, int, Record]]:
        """Topic, log time and record of every message, or of those at a topic and log time. Raises DatasetError."""


@dataclass
class _Camera:
    """What a recording holds of a frame. images, depths: stamp (ns), rank, topic and log time, by which it is read
    again; in the order of time. rectified: the lens of topics that are called so."""

    images: list[tuple[int, int, str, int]] = field(default_factory=list)
    depths: list[tuple[int, int, str, int]] = field(default_factory=list)
    lens: Lens | None = None
    rectified: Lens | None = None

    def lens_of(self, topic: str) -> Lens:
        lens = self.rectified if self.rectified is not None and "image_rect" in topic else self.lens
        assert lens is not None
        return lens


@dataclass
class _Index:
    """cameras: by frame. moved: samples of each frame's transform, by stamp. parents, fixed: of each frame."""

    cameras: dict[str, _Camera] = field(default_factory=dict)
    moved: dict[str, dict[int, Pose]] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)
    fixed: dict[str, Pose] = field(default_factory=dict)
    unread: Counter[str] = field(default_factory=Counter)


def load(messages: Messages, options: ImageOptions) -> Dataset:
    """The images of a recording's cameras that have a lens and a pose. Raises DatasetError."""
    index, where = _index(messages), messages.where
    found = {name: camera for name, camera in index.cameras.items() if camera.images}
    notes = [f"{count} images of encoding {name} are not read" for name, count in index.unread.items()]
    chains: dict[str, list[PoseProvider]] = {}
    roots: dict[str, str] = {}
    for name, camera in found.items():
        notes += _one_of_each_instant(name, camera)
        if camera.lens is None or name not in index.parents:
            notes.append(f"{name} has no {messages.needs[camera.lens is not None]}: left out")
            continue
        chains[name], roots[name] = _chain(index, name, where)
    notes += [f"depth of {name} is in no image's frame: left out" for name, c in index.cameras.items() if not c.images]
    per_root = Counter({root: 0 for root in roots.values()})
    for name, root in roots.items():
        per_root[root] += len(found[name].images)
    world = max(per_root, key=per_root.__getitem__, default="")
    start_ns = min((camera.images[0][0] for camera in found.values()), default=0)
    images: list[PosedImage] = []
    for name, tracks in chains.items():
        if roots[name] != world:
            notes.append(f"{name} hangs on {roots[name]}, which no transform joins to {world}: left out")
            continue
        images += _posed(messages, name, found[name], tracks, options, start_ns, notes)
    if not images:
        why = "; ".join(notes) or "there is no image"
        raise DatasetError(f"{where}: no image in {messages.name} that has a lens and a pose: {why}")
    apart = any(not np.array_equal(image.camera_to_world, images[0].camera_to_world) for image in images)
    carried = apart and len({image.camera for image in images}) == 1
    return Dataset(tuple(images), carried=carried, notes=tuple(notes))


def _index(messages: Messages) -> _Index:
    index = _Index()
    for topic, log_ns, record in messages.read():
        where = f"{messages.where}: {topic}"
        if isinstance(record, Transform):
            _add_transform(index, record, where)
            continue
        if isinstance(record, Picture) and not (record.depth or record.encoding in {*_COLORS, COMPRESSED}):
            index.unread[record.encoding] += 1
            continue
        if isinstance(record, Calibration) and not any(record.k[:1]):
            continue  # ROS: a camera that is not calibrated says so by a K that begins with 0
        camera = index.cameras.setdefault(record.frame, _Camera())
        if isinstance(record, Calibration):
            camera.lens = camera.lens or _lens(record, record.k, record.d, where)
            if camera.rectified is None and len(record.p) == 12 and any(record.p):
                camera.rectified = _lens(record, [*record.p[:3], *record.p[4:7], *record.p[8:11]], (), where)
        else:
            (camera.depths if record.depth else camera.images).append((record.stamp_ns, record.rank, topic, log_ns))
    for camera in index.cameras.values():
        camera.images.sort()
        camera.depths.sort()
    return index


def _add_transform(index: _Index, record: Transform, where: str) -> None:
    child, parent = record.child, record.parent
    if index.parents.setdefault(child, parent) != parent:
        raise DatasetError(f"{where}: {child} hangs on {index.parents[child]} and on {parent}: keep one of the two")
    with errors_at(where):
        q = quaternion_normalize(record.rotation)
    if not np.isfinite(record.translation).all():
        raise DatasetError(f"{where}: the translation of {child} is not finite")
    pose = Pose(tuple(map(float, q)), record.translation)  # type: ignore[arg-type]
    if record.static:
        index.fixed[child] = pose
    else:
        index.moved.setdefault(child, {})[record.stamp_ns] = pose


def _lens(record: Calibration, k: Sequence[float], terms: Sequence[float], where: str) -> Lens:
    """The lens of numbers K (9,) and distortion terms. Raises DatasetError."""
    most = _TERMS.get(record.model, 0)
    d = [*map(float, terms), *[0.0] * 8]
    if len(k) != 9 or not most or any(d[most:]):
        raise DatasetError(
            f"{where}: expected nine numbers K, and plumb_bob's k1 k2 p1 p2 k3 or equidistant's k1 to k4, got the "
            f"model {record.model!r:.30} with {len(terms)} terms: undistort the images"
        )
    fisheye = most == 4
    radial = tuple(d[:4]) if fisheye else (d[0], d[1], d[4])
    tangential = (0.0, 0.0) if fisheye else (d[2], d[3])
    with errors_at(where):
        return Lens(record.width, record.height, k[0], k[4], k[2] + 0.5, k[5] + 0.5, radial, tangential, fisheye)


def _one_of_each_instant(name: str, camera: _Camera) -> list[str]:
    """Keep one image of each stamp; notes on what was left out."""
    before = Counter(topic for _, _, topic, _ in camera.images)
    camera.images = list({image[0]: image for image in reversed(camera.images)}.values())[::-1]
    after = Counter(topic for _, _, topic, _ in camera.images)
    taken = ", ".join(sorted(after))
    same = f"are of the same instants as those of {taken}: left out"
    return [f"{count} images of {topic} {same}" for topic, count in (before - after).items()]


def _chain(index: _Index, name: str, where: Path) -> tuple[list[PoseProvider], str]:
    """The transforms from the root to a frame, and the root's name. Raises DatasetError for a circle."""
    frames = [name]
    while (parent := index.parents.get(frames[-1])) is not None:
        if parent in frames:
            raise DatasetError(f"{where}: the transforms of {', '.join([*frames, parent])} form a circle")
        frames.append(parent)
    *chain, root = frames
    tracks = [_track(index, frame, frame == name) for frame in chain]
    return tracks[::-1], root


def _track(index: _Index, frame: str, own: bool) -> PoseProvider:
    samples = dict(sorted(index.moved.get(frame, {}).items()))
    if frame in index.fixed or len(samples) == 1:
        return FixedPose(index.fixed[frame] if frame in index.fixed else next(iter(samples.values())))
    near_ns = RECORDING_POSE_NEAR_NS if own else RECORDING_PARENTS_NEAR_NS
    track = SampleBuffer(Pose.interpolate, near_ns, max(samples) - min(samples) + 1)
    for t_ns, pose in samples.items():
        track.add(t_ns, pose)
    return track


def _posed(
    messages: Messages,
    name: str,
    camera: _Camera,
    tracks: Sequence[PoseProvider],
    options: ImageOptions,
    start_ns: int,
    notes: list[str],
) -> Iterator[PosedImage]:
    """The images of a camera that have a pose; a note on the others. tracks: from the root to the camera."""
    unposed = 0
    for n, (t_ns, _, topic, log_ns) in enumerate(camera.images):
        try:
            matrix = reduce(np.matmul, [track.at(t_ns)[0].matrix() for track in tracks])
        except PoseGapError:
            unposed += 1
            continue
        lens = camera.lens_of(topic)
        read, depth = partial(_read_image, messages, (name, t_ns, topic, log_ns), lens, options), None
        near = _nearest(camera.depths, t_ns)
        if near is not None and abs(near[0] - t_ns) <= RECORDING_DEPTH_NEAR_NS:
            depth = partial(_read_depth, messages, (name, near[0], *near[2:]), lens, options, near[0] - t_ns)
        t_s, small = (t_ns - start_ns) / 1e9, shrink(pinhole(lens), options.scale)
        yield PosedImage(f"{name}/{n:06d}", name, t_s, matrix, small, read, depth=depth)
    if unposed:
        notes.append(f"{unposed} images of {name} have no pose within {RECORDING_POSE_NEAR_NS // 10**6} ms: left out")


def _nearest(ordered: Sequence[tuple[int, int, str, int]], t_ns: int) -> tuple[int, int, str, int] | None:
    """Of messages in the order of time the one stamped nearest to ``t_ns``; of two as near the earlier."""
    after = bisect_left(ordered, (t_ns,))
    return min(ordered[max(0, after - 1) : after + 1], key=lambda message: abs(message[0] - t_ns), default=None)


_Place = tuple[str, int, str, int]  # frame and stamp of an image, topic and log time: several may have the same


def _again(messages: Messages, place: _Place) -> Picture:
    """The image at a place. Raises DatasetError."""
    *which, topic, log_ns = place
    for _, _, record in messages.read(topic, log_ns):
        if isinstance(record, Picture) and [record.frame, record.stamp_ns] == which:
            return record
    raise DatasetError(f"{messages.where}: {topic}: the message at {log_ns} ns is not there any more")


def _read_image(messages: Messages, place: _Place, lens: Lens, options: ImageOptions) -> Image:
    picture, where = _again(messages, place), f"{messages.where}: {place[2]}"
    if picture.encoding == COMPRESSED:
        # As stored, whatever EXIF says of its orientation: the lens is of the stored pixels.
        image = _decoded(picture, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, 0, where)[..., ::-1]
    else:
        channels, conversion = _COLORS[picture.encoding]
        image = _pixels(picture, np.dtype(np.uint8), channels, where)
        image = image if conversion is None else cv2.cvtColor(image, conversion)
    if image.shape[:2] != (lens.height, lens.width):
        raise DatasetError(f"{where}: image is {image.shape[1]} x {image.shape[0]}, its camera another size")
    small = shrink(pinhole(lens), options.scale)
    return resize(undistort(lens, as_image(np.ascontiguousarray(image))), small.width, small.height)


def _read_depth(messages: Messages, place: _Place, lens: Lens, options: ImageOptions, after_ns: int) -> DepthImage:
    picture, where = _again(messages, place), f"{messages.where}: {place[2]}"
    if picture.encoding == COMPRESSED_DEPTH:
        values = _decoded(picture, cv2.IMREAD_UNCHANGED, _DEPTH_HEAD_BYTES, where)
        if values.dtype != np.uint16 or values.ndim != 2 or not picture.form.startswith("16UC1"):
            raise DatasetError(f"{where}: compressed depth {picture.form!r:.40} is not read: of 16UC1 alone")
    else:
        values = _pixels(picture, _DEPTHS[picture.encoding], 1, where)[..., 0]
    counts, unit = to_counts(values, None, where)
    return DepthImage(registered(counts, lens, options.scale, where), unit, after_image_ns=after_ns)


def _decoded(picture: Picture, flags: int, skip: int, where: str) -> NDArray[Any]:
    data = np.frombuffer(picture.data, np.uint8)[skip:]
    decoded = cv2.imdecode(data, flags) if len(data) else None
    if decoded is None:
        raise DatasetError(f"{where}: an image of format {picture.form!r:.40} cannot be decoded")
    return decoded


def _pixels(picture: Picture, kind: np.dtype[Any], channels: int, where: str) -> NDArray[Any]:
    """The numbers of a raw image, (H, W, channels)."""
    row = picture.width * channels * kind.itemsize
    data = np.frombuffer(picture.data, np.uint8)
    if not row or picture.step < row or len(data) < picture.step * picture.height:
        raise DatasetError(f"{where}: {len(data)} bytes are no image of {picture.width} x {picture.height}")
    rows = data[: picture.step * picture.height].reshape(picture.height, -1)
    values = np.ascontiguousarray(rows[:, :row]).view(kind.newbyteorder(">") if picture.big_endian else kind)
    return values.reshape(picture.height, picture.width, channels).astype(kind, copy=False)
