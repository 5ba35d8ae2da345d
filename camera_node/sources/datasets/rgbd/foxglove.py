"""Recordings in MCAP by any tool, in Foxglove's protobuf messages; see ``recording``. Needs the extra ``mcap``.

    foxglove.CompressedImage, RawImage (rgb8, bgr8)  images
    foxglove.RawImage (16UC1, 32FC1)                 depth, registered to the images: millimeters, meters
    foxglove.CameraCalibration                       lens, OpenCV's pixel origin
    foxglove.FrameTransform                          poses: the camera is a ``child_frame_id``

A file of ROS 2 messages is read by ``rosbag``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.photo import FULL_SIZE, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, find_files
from camera_node.sources.datasets.rgbd.recorded_messages import (
    COMPRESSED,
    Calibration,
    Messages,
    Picture,
    Record,
    Transform,
    load,
)
from freshfield.session import INSTALL

FILES = ("*.mcap",)
_CALIBRATION, _COMPRESSED, _RAW, _TRANSFORM = "CameraCalibration", "CompressedImage", "RawImage", "FrameTransform"
_PROFILE_AT = 21  # after magic, opcode and size of the header record, and the length of its first string
_ROS = (b"ros2", b"ros1")


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The images of a file's cameras that have a lens and a pose. Raises DatasetError."""
    found = find_files(path, FILES) if path.is_dir() else [path]
    if len(found) != 1:
        names = ", ".join(each.name for each in found) or "none"
        raise DatasetError(f"{path}: expected one {FILES[0]}, found {names}; name the file itself")
    file = found[0]
    if _of_ros(file):
        from camera_node.sources.datasets.rgbd import rosbag

        return rosbag.load_dataset(file, options)
    return load(FoxgloveMessages(file), options)


@dataclass(frozen=True)
class FoxgloveMessages(Messages):
    where: Path
    name = "Foxglove's messages"
    needs = (f"{_CALIBRATION} of a calibrated camera (whose K is not 0)", _TRANSFORM)

    def read(self, topic: str | None = None, log_ns: int = 0) -> Iterator[tuple[str, int, Record]]:
        try:
            from mcap.reader import make_reader

            kinds = (_CALIBRATION, _COMPRESSED, _RAW, _TRANSFORM)
            classes = {k: getattr(import_module(f"foxglove_schemas_protobuf.{k}_pb2"), k) for k in kinds}
        except ImportError:
            raise DatasetError(INSTALL) from None
        chosen: Any = {} if topic is None else {"topics": [topic], "starting_at": log_ns, "ending_at": log_ns}
        try:
            with self.where.open("rb") as stream:
                for schema, channel, message in make_reader(stream).iter_messages(**chosen):
                    kind, t_ns = "" if schema is None else schema.name.removeprefix("foxglove."), message.log_time
                    if kind in classes:
                        yield channel.topic, t_ns, _record(kind, classes[kind].FromString(message.data), t_ns)
        except Exception as error:  # of damaged files its readers raise nearly anything
            why = " ".join(str(error).split()) or type(error).__name__
            raise DatasetError(f"{self.where}: cannot be read as MCAP: {why}; cut short? (`mcap recover`)") from None


def _of_ros(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            return stream.read(_PROFILE_AT + len(_ROS[0]))[_PROFILE_AT:] in _ROS
    except OSError:
        return False


def _record(kind: str, message: Any, log_ns: int) -> Record:
    stamp_ns = message.timestamp.ToNanoseconds() if message.HasField("timestamp") else log_ns
    if kind == _TRANSFORM:
        moved, turned = message.translation, message.rotation
        position, rotation = (moved.x, moved.y, moved.z), (turned.w, turned.x, turned.y, turned.z)
        return Transform(message.parent_frame_id, message.child_frame_id, stamp_ns, position, rotation)
    if kind == _CALIBRATION:
        size = (message.width, message.height)
        return Calibration(message.frame_id, *size, message.distortion_model, [*message.K], [*message.D], [*message.P])
    if kind == _COMPRESSED:
        return Picture(message.frame_id, stamp_ns, COMPRESSED, message.data, message.format)
    size = (message.width, message.height)
    return Picture(message.frame_id, stamp_ns, message.encoding, message.data, "", *size, message.step)
