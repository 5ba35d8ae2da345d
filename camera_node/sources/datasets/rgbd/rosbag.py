"""ROS bags, read without ROS (extra ``ros``); see ``recording``: a ROS 2 bag's folder, its one .mcap or .db3 file, or a
ROS 1 .bag.

    sensor_msgs/Image, CompressedImage               images; 8-bit color, gray and Bayer, jpeg and png
    sensor_msgs/Image (16UC1, 32FC1), compressedDepth (16UC1)
                                                     depth, registered to the images: millimeters, meters
    sensor_msgs/CameraInfo                           lens; of topics called image_rect it is P
    tf2_msgs/TFMessage on /tf, /tf_static            poses, along the chain from the camera's frame to the root

Messages are known by their type, whatever their topics are called.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.photo import FULL_SIZE, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError
from camera_node.sources.datasets.rgbd.recorded_messages import (
    COMPRESSED,
    COMPRESSED_DEPTH,
    Calibration,
    Messages,
    Picture,
    Record,
    Transform,
    load,
)
from freshfield.session import INSTALL_ROS

FILES = ("metadata.yaml", "*.db3", "*.bag")
_IMAGE, _COMPRESSED_IMAGE, _INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The images of a bag's cameras that have a lens and a pose. Raises DatasetError."""
    return load(BagMessages(path.parent if path.name == FILES[0] else path), options)


class BagMessages(Messages):
    """The bag stays open: images are read when they are needed, by any thread."""

    name = "ROS messages"
    needs = ("CameraInfo of a calibrated camera (whose K is not 0)", "tf")

    def __init__(self, where: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise DatasetError(INSTALL_ROS) from None
        self.where = where
        self._lock = threading.Lock()
        try:
            self._bag = AnyReader([where], default_typestore=get_typestore(Stores.LATEST))
            self._bag.open()
        except Exception as error:  # of damaged files its readers raise nearly anything
            raise self._unreadable(error) from None

    def read(self, topic: str | None = None, log_ns: int = 0) -> Iterator[tuple[str, int, Record]]:
        kinds = (_IMAGE, _COMPRESSED_IMAGE, _INFO, *_TRANSFORMS)
        bag = self._bag
        wanted = [c for c in bag.connections if _kind(c.msgtype) in kinds and topic in (None, c.topic)]
        between = {} if topic is None else {"start": log_ns, "stop": log_ns + 1}
        with self._lock:
            try:
                for connection, t_ns, data in bag.messages(wanted, **between) if wanted else ():
                    kind = _kind(connection.msgtype)
                    message: Any = bag.deserialize(data, kind)
                    for record in _records(message, kind, connection.topic, t_ns):
                        yield connection.topic, t_ns, record
            except Exception as error:
                raise self._unreadable(error) from None

    def _unreadable(self, error: Exception) -> DatasetError:
        text = " ".join(str(error).split()) or type(error).__name__
        return DatasetError(f"{self.where}: cannot be read as a ROS bag: {text}; cut short? (MCAP: `mcap recover`)")


def _kind(name: str) -> str:
    """A message's type; some writers of ROS 2 bags name it as ROS 1 does, without ``msg``."""
    return name if name.count("/") != 1 else name.replace("/", "/msg/")


def _records(message: Any, kind: str, topic: str, log_ns: int) -> Iterator[Record]:
    if kind in _TRANSFORMS:
        for each in message.transforms:
            moved, turned = each.transform.translation, each.transform.rotation
            position, rotation = (moved.x, moved.y, moved.z), (turned.w, turned.x, turned.y, turned.z)
            frames = (each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/"))
            yield Transform(*frames, _stamp_ns(each.header, log_ns), position, rotation, topic.endswith("tf_static"))
        return
    frame, stamp_ns = message.header.frame_id.lstrip("/"), _stamp_ns(message.header, log_ns)
    if kind == _INFO:
        k, d, p = (getattr(message, n, getattr(message, n.upper(), ())) for n in "kdp")  # ROS 1 has capitals
        yield Calibration(frame, message.width, message.height, message.distortion_model, [*k], [*d], [*p])
    elif kind == _COMPRESSED_IMAGE:
        encoding = COMPRESSED_DEPTH if COMPRESSED_DEPTH in message.format else COMPRESSED
        yield Picture(frame, stamp_ns, encoding, message.data, message.format)
    else:
        size = (message.width, message.height, message.step, bool(message.is_bigendian))
        yield Picture(frame, stamp_ns, message.encoding, message.data, "", *size)


def _stamp_ns(header: Any, log_ns: int) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec or log_ns
