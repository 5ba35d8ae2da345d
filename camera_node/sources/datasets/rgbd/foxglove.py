"""Recordings in MCAP by any tool, in Foxglove's protobuf messages; those of one camera have its ``frame_id``.

    foxglove.CompressedImage, RawImage (rgb8, bgr8)  images
    foxglove.RawImage (16UC1, 32FC1)                 depth, registered to the images: millimeters, meters
    foxglove.CameraCalibration                       lens, OpenCV's pixel origin; distortion none or plumb_bob
    foxglove.FrameTransform                          poses: ``child_frame_id`` is the camera, its parent the world

An image gets the depth nearest in time, within 20 ms, and a pose between the two around it, within 50 ms; a camera with
one transform stands still. Needs the extra ``mcap``.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.pose.pairing import PoseGapError, SampleBuffer
from camera_node.pose.providers import FixedPose, PoseProvider
from camera_node.sources.datasets.imaging import as_image, resize, shrink
from camera_node.sources.datasets.lens import Lens, pinhole, undistort
from camera_node.sources.datasets.photo import FULL_SIZE, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, Image, PosedImage, errors_at
from camera_node.sources.datasets.rgbd.depth_file import registered, to_counts
from freshfield.depth import DepthImage
from freshfield.geometry import Pose, quaternion_normalize
from freshfield.session import INSTALL

FILES = ("*.mcap",)
_CALIBRATION, _COMPRESSED, _RAW, _TRANSFORM = "CameraCalibration", "CompressedImage", "RawImage", "FrameTransform"
_COLORS = ("rgb8", "bgr8")
_DEPTHS: dict[str, np.dtype[Any]] = {"16UC1": np.dtype("<u2"), "32FC1": np.dtype("<f4")}
_NEAR_NS = 20_000_000
_POSE_NEAR_NS = 50_000_000


@dataclass
class _Camera:
    """What a file holds of one camera. images, depths: stamp (ns), topic and log time, by which it is read again; in
    the order of time."""

    images: list[tuple[int, str, int]] = field(default_factory=list)
    depths: list[tuple[int, str, int]] = field(default_factory=list)
    poses: list[tuple[int, Pose]] = field(default_factory=list)
    lens: Lens | None = None


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The images of a file's cameras that have a lens and a pose. Raises DatasetError."""
    file = next(iter(sorted(path.glob(FILES[0]))), path) if path.is_dir() else path
    found = {name: camera for name, camera in _index(file).items() if camera.images}
    start_ns = min((camera.images[0][0] for camera in found.values()), default=0)
    images: list[PosedImage] = []
    notes = []
    for name, camera in found.items():
        if camera.lens is None or not camera.poses:
            notes.append(f"{name} has no {'CameraCalibration' if camera.lens is None else 'FrameTransform'}: left out")
            continue
        small, track, unposed = shrink(pinhole(camera.lens), options.scale), _track(camera.poses), 0
        for n, (t_ns, *at) in enumerate(camera.images):
            try:
                matrix = track.at(t_ns)[0].matrix()
            except PoseGapError:
                unposed += 1
                continue
            read = partial(_read_image, file, at, camera.lens, options)
            depth, near = None, _nearest(camera.depths, t_ns)
            if near is not None and abs(near[0] - t_ns) <= _NEAR_NS:
                depth = partial(_read_depth, file, near[1:], camera.lens, options, near[0] - t_ns)
            t_s = (t_ns - start_ns) / 1e9
            images.append(PosedImage(f"{name}/{n:06d}", name, t_s, matrix, small, read, depth=depth))
        if unposed:
            notes.append(f"{unposed} images of {name} have no pose within 50 ms: left out")
    if not images:
        raise DatasetError(f"{file}: no image in Foxglove's messages that has a lens and a pose: {'; '.join(notes)}")
    return Dataset(tuple(images), notes=tuple(notes))


def _index(file: Path) -> dict[str, _Camera]:
    """The cameras by ``frame_id``."""
    cameras: dict[str, _Camera] = {}
    for kind, message, topic, log_ns in _messages(file):
        stamp_ns = message.timestamp.ToNanoseconds() if message.HasField("timestamp") else log_ns
        if kind == _TRANSFORM:
            moved, turned = message.translation, message.rotation
            with errors_at(f"{file}: {topic}"):
                q = quaternion_normalize((turned.w, turned.x, turned.y, turned.z))
            pose = Pose(tuple(map(float, q)), (moved.x, moved.y, moved.z))  # type: ignore[arg-type]
            cameras.setdefault(message.child_frame_id, _Camera()).poses.append((stamp_ns, pose))
            continue
        camera = cameras.setdefault(message.frame_id, _Camera())
        if kind == _CALIBRATION:
            camera.lens = camera.lens or _lens(message, f"{file}: {topic}")
        elif kind == _RAW and message.encoding in _DEPTHS:
            camera.depths.append((stamp_ns, topic, log_ns))
        elif kind == _COMPRESSED or message.encoding in _COLORS:
            camera.images.append((stamp_ns, topic, log_ns))
    for camera in cameras.values():
        camera.images.sort()
        camera.depths.sort()
    return cameras


def _nearest(ordered: Sequence[tuple[int, str, int]], t_ns: int) -> tuple[int, str, int] | None:
    """Of messages in the order of time the one stamped nearest to ``t_ns``; of two as near the earlier."""
    after = bisect_left(ordered, (t_ns,))
    return min(ordered[max(0, after - 1) : after + 1], key=lambda message: abs(message[0] - t_ns), default=None)


def _messages(file: Path, **chosen: Any) -> Iterator[tuple[str, Any, str, int]]:
    """Foxglove's messages: kind, message, topic, log time. Raises DatasetError."""
    try:
        from google.protobuf.message import DecodeError
        from mcap.exceptions import McapError
        from mcap.reader import make_reader

        kinds = (_CALIBRATION, _COMPRESSED, _RAW, _TRANSFORM)
        classes = {k: getattr(import_module(f"foxglove_schemas_protobuf.{k}_pb2"), k) for k in kinds}
    except ImportError:
        raise DatasetError(INSTALL) from None
    try:
        with file.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages(**chosen):
                kind = "" if schema is None else schema.name.removeprefix("foxglove.")
                if kind in classes:
                    yield kind, classes[kind].FromString(message.data), channel.topic, message.log_time
    except (OSError, McapError, DecodeError, ValueError, EOFError) as error:
        raise DatasetError(f"{file}: cannot be read as MCAP: {error or type(error).__name__}; cut short?") from None


def _track(samples: list[tuple[int, Pose]]) -> PoseProvider:
    if len(samples) == 1:
        return FixedPose(samples[0][1])
    ordered = dict(sorted(samples, key=lambda sample: sample[0]))
    track = SampleBuffer(Pose.interpolate, _POSE_NEAR_NS, max(ordered) - min(ordered) + 1)
    for t_ns, pose in ordered.items():
        track.add(t_ns, pose)
    return track


def _lens(message: Any, where: str) -> Lens:
    k, d = [*message.K], [*message.D, 0.0, 0.0, 0.0, 0.0, 0.0]
    if len(k) != 9 or any(d[5:]) or message.distortion_model not in ("", "plumb_bob"):
        raise DatasetError(f"{where}: expected nine numbers K, and plumb_bob's k1 k2 p1 p2 k3: undistort the images")
    with errors_at(where):
        size = (message.width, message.height)
        return Lens(*size, k[0], k[4], k[2] + 0.5, k[5] + 0.5, (d[0], d[1], d[4]), (d[2], d[3]))


def _again(file: Path, at: Sequence[Any]) -> tuple[str, Any]:
    """Kind and message at a topic and log time."""
    topic, log_ns = at
    kind, message, *_ = next(_messages(file, topics=[topic], starting_at=log_ns, ending_at=log_ns))
    return kind, message


def _read_image(file: Path, at: Sequence[Any], lens: Lens, options: ImageOptions) -> Image:
    kind, message = _again(file, at)
    if kind == _RAW:
        image = _pixels(message, np.dtype(np.uint8), 3, f"{file}: {at[0]}")
        image = image if message.encoding == "rgb8" else image[..., ::-1]
    else:
        decoded = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR) if message.data else None
        if decoded is None:
            raise DatasetError(f"{file}: {at[0]}: an image of format {message.format!r:.20} cannot be decoded")
        image = decoded[..., ::-1]
    if image.shape[:2] != (lens.height, lens.width):
        raise DatasetError(f"{file}: {at[0]}: image is {image.shape[1]} x {image.shape[0]}, its camera another size")
    small = shrink(pinhole(lens), options.scale)
    return resize(undistort(lens, as_image(np.ascontiguousarray(image))), small.width, small.height)


def _read_depth(file: Path, at: Sequence[Any], lens: Lens, options: ImageOptions, after_ns: int) -> DepthImage:
    (_, message), where = _again(file, at), f"{file}: {at[0]}"
    counts, unit = to_counts(_pixels(message, _DEPTHS[message.encoding], 1, where)[..., 0], None, where)
    return DepthImage(registered(counts, lens, options.scale, where), unit, after_image_ns=after_ns)


def _pixels(message: Any, kind: np.dtype[Any], channels: int, where: str) -> NDArray[Any]:
    """The numbers of a raw image, (H, W, channels)."""
    row = message.width * channels * kind.itemsize
    if not row or message.step < row or len(message.data) < message.step * message.height:
        raise DatasetError(f"{where}: {len(message.data)} bytes are no image of {message.width} x {message.height}")
    rows = np.frombuffer(message.data, np.uint8)[: message.step * message.height].reshape(message.height, -1)
    return np.ascontiguousarray(rows[:, :row]).view(kind).reshape(message.height, message.width, channels)
