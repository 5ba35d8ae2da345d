"""Writes a session as a ROS 2 bag, a folder with MCAP inside (extra ``ros``), with the same calls as ``SessionWriter``.

    /CAMERA/image/compressed  sensor_msgs/CompressedImage  jpeg, png; zstd becomes /CAMERA/image, sensor_msgs/Image
    /CAMERA/camera_info       sensor_msgs/CameraInfo       with each image
    /CAMERA/depth/image       sensor_msgs/Image            16UC1 where a count is a millimeter, else 32FC1 in meters
    /CAMERA/depth/camera_info sensor_msgs/CameraInfo       of depth with a lens of its own
    /tf                       tf2_msgs/TFMessage           world -> CAMERA, CAMERA -> CAMERA_depth; axes as OpenCV's
    /decisions, /scores       std_msgs/String              JSON

Frames are the cameras' ids; topics replace what ROS does not allow by an underscore and put camera_ before a digit.
A message's time in the bag is its arrival at the edge, its stamp the capture, both on the edge's clock.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np

from freshfield import payload
from freshfield.depth import DepthImage
from freshfield.frame import CODEC_NAMES, depth_of, pose_and_lens
from freshfield.geometry import Pinhole, Pose
from freshfield.session import INSTALL_ROS, TRANSFORMS, WORLD, SessionError
from freshfield.v1 import frames_pb2 as pb

try:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore
except ImportError:
    raise SessionError(INSTALL_ROS) from None

_VERSION: Literal[9] = 9  # of the bag's metadata: ROS 2 Jazzy
_VIEWED = ("jpeg", "png")
_MILLIMETER = 0.001
_NOT_A_ROS_NAME = re.compile(r"[^A-Za-z0-9]+")  # repeated underscores are not allowed either


class BagWriter:
    """A bag being written; not thread-safe. messages: number of messages written."""

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        """path: folder that must not exist yet. about: custom data of the bag. Raises OSError if it cannot be made."""
        self.messages = 0
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._bag = Writer(path, version=_VERSION, storage_plugin=StoragePlugin.MCAP)
        for name, value in about.items():
            self._bag.set_custom_data(name, value)
        self._bag.open()
        self._topics: dict[str, Any] = {}
        self._names: dict[str, str] = {}  # of cameras in topics

    def frame(self, request: pb.PushRequest, arrived_ns: int) -> None:
        """Write all messages of a frame that arrived at ``arrived_ns`` on the edge's clock. Raises ValueError for an
        image or depth that cannot be decoded."""
        header = request.header
        camera, codec = header.camera_id, CODEC_NAMES[header.codec]
        pose, lens = pose_and_lens(header)
        stamp_ns = max(0, header.generated_ns + header.clock_offset_ns)
        at = f"/{self._name(camera)}"
        head = self._header(stamp_ns, camera)
        moved = [self._transform(stamp_ns, WORLD, camera, pose)]
        depth = depth_of(request.depth).decode() if request.HasField("depth") else None
        if depth is not None:
            of, depth_ns = camera, max(0, stamp_ns + depth.after_image_ns)
            if depth.intrinsics is not None:
                of = f"{camera}_depth"
                to_camera = depth.to_camera or Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
                moved.append(self._transform(depth_ns, camera, of, to_camera))
                self._info(f"{at}/depth/camera_info", self._header(depth_ns, of), depth.intrinsics, arrived_ns)
            self._image(f"{at}/depth/image", self._header(depth_ns, of), *_measured(depth), arrived_ns)
        self._add(TRANSFORMS, self._make("tf2_msgs/msg/TFMessage", moved), arrived_ns)
        self._info(f"{at}/camera_info", head, lens, arrived_ns)
        if codec in _VIEWED:
            data = np.frombuffer(request.payload, np.uint8)
            image = self._make("sensor_msgs/msg/CompressedImage", head, codec, data)
            self._add(f"{at}/image/compressed", image, arrived_ns)
        else:
            pixels = payload.decode(request.payload, codec, lens.width, lens.height)
            self._image(f"{at}/image", head, "rgb8", pixels, arrived_ns)

    def data(self, topic: str, name: str, schema: Mapping[str, Any], values: Mapping[str, Any], t_ns: int) -> None:
        """Write a JSON message; see ``SessionWriter.data``. Raises ValueError for NaN or infinity."""
        self._add(topic, self._make("std_msgs/msg/String", json.dumps(values, allow_nan=False)), t_ns)

    def flush(self) -> None:
        """Nothing: the library hands over whole chunks."""

    def close(self, counts: Mapping[str, int]) -> None:
        """Write the index, ``counts`` as custom data, and metadata.yaml. Raises OSError."""
        for name, count in counts.items():
            self._bag.set_custom_data(name, str(count))
        self._bag.close()

    def abandon(self) -> None:
        """Close the file without an index."""
        with suppress(OSError):
            self._bag.abort()

    def _name(self, camera: str) -> str:
        """The camera's unique name in topics. It does not begin with a digit, which ROS 2 does not allow."""
        if camera not in self._names:
            allowed = re.sub(r"^(?=\d)", "camera_", _NOT_A_ROS_NAME.sub("_", camera))
            names = (allowed, *(f"{allowed}_{k}" for k in range(2, len(self._names) + 3)))
            self._names[camera] = next(name for name in names if name not in self._names.values())
        return self._names[camera]

    def _make(self, name: str, *values: Any) -> Any:
        return self._types.types[name](*values)

    def _header(self, t_ns: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", t_ns // 10**9, t_ns % 10**9)
        return self._make("std_msgs/msg/Header", stamp, frame)

    def _transform(self, t_ns: int, parent: str, child: str, pose: Pose) -> Any:
        w, *xyz = pose.quaternion
        moved = self._make("geometry_msgs/msg/Vector3", *pose.translation_m)
        turned = self._make("geometry_msgs/msg/Quaternion", *xyz, w)
        transform = self._make("geometry_msgs/msg/Transform", moved, turned)
        return self._make("geometry_msgs/msg/TransformStamped", self._header(t_ns, parent), child, transform)

    def _info(self, topic: str, head: Any, lens: Pinhole, arrived_ns: int) -> None:
        k, (k1, k2, p1, p2) = lens.opencv()
        whole = self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        d, p = np.array([k1, k2, p1, p2, 0.0]), np.hstack([k, np.zeros((3, 1))])
        numbers = (d, k.ravel(), np.eye(3).ravel(), p.ravel())
        size = (lens.height, lens.width)
        info = self._make("sensor_msgs/msg/CameraInfo", head, *size, "plumb_bob", *numbers, 0, 0, whole)
        self._add(topic, info, arrived_ns)

    def _image(self, topic: str, head: Any, encoding: str, values: np.ndarray, arrived_ns: int) -> None:
        values = np.ascontiguousarray(values)
        data, step = values.reshape(-1).view(np.uint8), values.strides[0]
        image = self._make("sensor_msgs/msg/Image", head, *values.shape[:2], encoding, False, step, data)
        self._add(topic, image, arrived_ns)

    def _add(self, topic: str, message: Any, t_ns: int) -> None:
        kind = message.__msgtype__
        if topic not in self._topics:
            self._topics[topic] = self._bag.add_connection(topic, kind, typestore=self._types)
        self._bag.write(self._topics[topic], max(0, t_ns), self._types.serialize_cdr(message, kind))
        self.messages += 1


def _measured(depth: DepthImage) -> tuple[str, np.ndarray]:
    """Encoding and values of a depth image in ROS's convention (REP 118)."""
    if math.isclose(depth.meters_per_count, _MILLIMETER, rel_tol=1e-6):  # librealsense reports a 32-bit float
        return "16UC1", depth.counts.astype("<u2")
    return "32FC1", np.where(depth.counts > 0, depth.meters(), np.nan).astype("<f4")
