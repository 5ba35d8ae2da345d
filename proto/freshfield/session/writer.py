"""Writes a session."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from freshfield.frame import CODEC_NAMES
from freshfield.session import (
    CALIBRATION,
    DEPTH,
    HEADER,
    IMAGE,
    INSTALL,
    POSE,
    TRANSFORMS,
    WORLD,
    SessionError,
    topic_of,
)
from freshfield.v1 import frames_pb2 as pb

try:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from mcap.well_known import MessageEncoding, SchemaEncoding
    from mcap.writer import CompressionType, Writer
    from mcap_protobuf.schema import register_schema
except ImportError:
    raise SessionError(INSTALL) from None

# A killed process loses at most one chunk, and what its writing thread had not handed over yet.
_CHUNK_BYTES = 256 * 1024


class SessionWriter:
    """A session being written; not thread-safe. messages: number of messages written."""

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        """path: file that must not exist yet. about: metadata of the session.

        Raises OSError if the file exists or cannot be written.
        """
        self.messages = 0
        self._file = path.open("xb")
        self._mcap = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.NONE)
        self._mcap.start(profile="", library="freshfield")
        self._mcap.add_metadata("session", dict(about))
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._lenses: dict[str, bytes] = {}

    def frame(self, request: pb.PushRequest, arrived_ns: int) -> None:
        """Write all messages of a frame that arrived at ``arrived_ns`` on the edge's clock."""
        header = request.header
        camera, captured_ns = header.camera_id, header.generated_ns + header.clock_offset_ns
        times = (arrived_ns, max(0, captured_ns), header.sequence & 0xFFFFFFFF)
        size = b"%d %d" % (header.width, header.height)
        lens = size + header.intrinsics.SerializeToString(deterministic=True)
        if self._lenses.get(camera) != lens:
            self._lenses[camera] = lens
            self._proto(topic_of(camera, CALIBRATION), _calibration(header, captured_ns), *times)
        transform = FrameTransform(parent_frame_id=WORLD, child_frame_id=camera)
        pose = PoseInFrame(frame_id=WORLD)
        for position, rotation in (
            (transform.translation, transform.rotation),
            (pose.pose.position, pose.pose.orientation),
        ):
            position.x, position.y, position.z = header.pose.tx_m, header.pose.ty_m, header.pose.tz_m
            q = header.pose
            rotation.w, rotation.x, rotation.y, rotation.z = q.qw, q.qx, q.qy, q.qz
        image = CompressedImage(frame_id=camera, data=request.payload, format=CODEC_NAMES[header.codec])
        for message in (transform, pose, image):
            message.timestamp.FromNanoseconds(captured_ns)
        self._proto(TRANSFORMS, transform, *times)
        self._proto(topic_of(camera, POSE), pose, *times)
        self._proto(topic_of(camera, HEADER), header, *times)
        if request.HasField("depth"):
            self._proto(topic_of(camera, DEPTH), request.depth, *times)
        self._proto(topic_of(camera, IMAGE), image, *times)

    def data(self, topic: str, name: str, schema: Mapping[str, Any], values: Mapping[str, Any], t_ns: int) -> None:
        """Write a JSON message.

        name, schema: name and JSON schema of the topic's messages.
        t_ns: log and publish time.
        Raises ValueError for NaN or infinity.
        """
        self._register(
            topic,
            name,
            MessageEncoding.JSON,
            lambda: self._mcap.register_schema(name, SchemaEncoding.JSONSchema, json.dumps(schema).encode()),
        )
        self._add(topic, json.dumps(values, allow_nan=False).encode(), t_ns, t_ns, 0)

    def flush(self) -> None:
        """Hand finished chunks to the operating system."""
        self._file.flush()

    def close(self, counts: Mapping[str, int]) -> None:
        """Write the index and ``counts`` (as metadata), and close the file. Raises OSError."""
        try:
            self._mcap.add_metadata("counts", {name: str(count) for name, count in counts.items()})
            self._mcap.finish()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file without an index."""
        with suppress(OSError):
            self._file.close()

    def _proto(self, topic: str, message: Any, log_ns: int, publish_ns: int, sequence: int) -> None:
        name = message.DESCRIPTOR.full_name
        self._register(topic, name, MessageEncoding.Protobuf, lambda: register_schema(self._mcap, type(message)))
        self._add(topic, message.SerializeToString(), log_ns, publish_ns, sequence)

    def _register(self, topic: str, name: str, encoding: str, new_schema: Callable[[], int]) -> None:
        """Register the channel of a new topic, and the schema of a new ``name``."""
        if topic not in self._channels:
            if name not in self._schemas:
                self._schemas[name] = new_schema()
            self._channels[topic] = self._mcap.register_channel(topic, encoding, self._schemas[name])

    def _add(self, topic: str, data: bytes, log_ns: int, publish_ns: int, sequence: int) -> None:
        self._mcap.add_message(self._channels[topic], log_ns, data, publish_ns, sequence)
        self.messages += 1


def _calibration(header: pb.FrameHeader, captured_ns: int) -> CameraCalibration:
    k = header.intrinsics
    cx, cy = k.cx - 0.5, k.cy - 0.5  # OpenCV and ROS count from pixel centers
    message = CameraCalibration(
        frame_id=header.camera_id,
        width=header.width,
        height=header.height,
        distortion_model="plumb_bob",
        D=[k.k1, k.k2, k.p1, k.p2, 0.0],
        K=[k.fx, 0, cx, 0, k.fy, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[k.fx, 0, cx, 0, 0, k.fy, cy, 0, 0, 0, 1, 0],
    )
    message.timestamp.FromNanoseconds(captured_ns)
    return message
