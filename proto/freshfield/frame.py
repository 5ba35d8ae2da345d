"""The frame in Python, its conversion to and from the wire message, and all stateless checks.

Checks that need state (sequence numbers, clocks) are made by the edge's ingest.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Container
from dataclasses import dataclass, field, replace
from operator import attrgetter

import google_crc32c
from google.protobuf.message import DecodeError

from freshfield import limits, payload
from freshfield.depth import EncodedDepth
from freshfield.geometry import Pinhole, Pose, invertible, quaternion_normalize
from freshfield.v1 import frames_pb2 as pb

OTHER = "?"
_ID = re.compile(rf"[A-Za-z0-9._-]{{1,{limits.MAX_ID_CHARS}}}")
_CODECS = {"jpeg": pb.CODEC_JPEG, "png": pb.CODEC_PNG, "zstd": pb.CODEC_ZSTD}
CODEC_NAMES = {number: name for name, number in _CODECS.items()}
_UINT32 = 0xFFFFFFFF  # an enum on the wire may be negative
_PACKED = struct.Struct("<QqqqqIIII7d8d")
_DEPTH_PACKED = struct.Struct("<IIIdq??8d7d")
_COUNTS = attrgetter("sequence", "generated_ns", "clock_offset_ns", "clock_uncertainty_ns", "pose_gap_ns")
_POSE_FIELDS = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_LENS_FIELDS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
_POSE, _LENS = attrgetter(*_POSE_FIELDS), attrgetter(*_LENS_FIELDS)


class FrameRejected(ValueError):
    """A frame that is refused on arrival. reason: short name, for the counts; the message is for people."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True)
class Frame:
    """One captured image with its pose.

    camera, session: ids of the camera and of its node's run. sequence: number of the frame in the session.
    generated_ns: capture time on the node's clock.
    codec: of CODEC_NAMES' values. payload: the encoded image.
    held_out: never trained on; fidelity is measured against it.
    clock_offset_ns: edge clock minus node clock, as the node estimates it.
    clock_uncertainty_ns: bound of the estimate's error.
    pose_gap_ns: time between the capture and the pose sample that it was paired with.
    depth: measured with the image; None: this frame brings none.
    received_ns: arrival on the edge's clock, once it has arrived; not on the wire.
    """

    camera: str
    session: str
    sequence: int
    generated_ns: int
    pose: Pose
    intrinsics: Pinhole
    codec: str
    payload: bytes
    held_out: bool = False
    clock_offset_ns: int = 0
    clock_uncertainty_ns: int = 0
    pose_gap_ns: int = 0
    depth: EncodedDepth | None = None
    received_ns: int = field(default=0, compare=False)

    @property
    def generated_edge_ns(self) -> int:
        """Capture time on the edge's clock."""
        return self.generated_ns + self.clock_offset_ns

    def age_ms(self, now_ns: int) -> float:
        """Time since the capture. now_ns: on the edge's clock."""
        return (now_ns - self.generated_edge_ns) / 1e6


def valid_id(text: str) -> bool:
    """Whether ``text`` may be a camera or session id: 1 to 64 letters, digits, '.', '_', '-'."""
    return _ID.fullmatch(text) is not None


def counted_ids(header: pb.FrameHeader, cameras: Container[str]) -> tuple[str, str]:
    """Camera and session under which a refused frame is counted and logged.

    Both are ``?`` for a camera that is not one of ``cameras``, since counts of made-up ids would pile up; the
    session is ``?`` if it is not a valid id.
    """
    camera, session = header.camera_id, header.session_id
    if camera not in cameras:
        return OTHER, OTHER
    return camera, session if valid_id(session) else OTHER


def checksum(request: pb.PushRequest) -> int:
    """CRC32C over the header's fields, packed in a fixed order, and the payload; then over those of the depth, if any.
    It covers the header because a flipped bit must not become a wrong pose."""
    header = request.header
    numbers = (*_COUNTS(header), header.codec & _UINT32, header.width, header.height, header.role & _UINT32)
    packed = _PACKED.pack(*numbers, *_POSE(header.pose), *_LENS(header.intrinsics))
    crc = google_crc32c.value(header.camera_id.encode() + b"\0" + header.session_id.encode() + packed)
    crc = google_crc32c.extend(crc, request.payload)
    if not request.HasField("depth"):
        return crc
    depth = request.depth
    own = depth.HasField("intrinsics"), depth.HasField("to_camera")
    sizes = depth.codec & _UINT32, depth.width, depth.height, depth.meters_per_count, depth.after_image_ns
    packed = _DEPTH_PACKED.pack(*sizes, *own, *_LENS(depth.intrinsics), *_POSE(depth.to_camera))
    return google_crc32c.extend(google_crc32c.extend(crc, packed), depth.payload)


def to_request(frame: Frame) -> pb.PushRequest:
    """The wire message of a frame, with its checksum."""
    k = frame.intrinsics
    header = pb.FrameHeader(
        camera_id=frame.camera,
        session_id=frame.session,
        sequence=frame.sequence,
        generated_ns=frame.generated_ns,
        clock_offset_ns=frame.clock_offset_ns,
        clock_uncertainty_ns=frame.clock_uncertainty_ns,
        pose=_pose_message(frame.pose),
        pose_gap_ns=frame.pose_gap_ns,
        intrinsics=_lens_message(k),
        codec=_CODECS[frame.codec],
        width=k.width,
        height=k.height,
        role=pb.ROLE_HELD_OUT if frame.held_out else pb.ROLE_TRAIN,
    )
    request = pb.PushRequest(header=header, payload=frame.payload)
    if frame.depth is not None:
        request.depth.CopyFrom(_depth_message(frame.depth))
    request.crc32c = checksum(request)
    return request


def pose_and_lens(h: pb.FrameHeader) -> tuple[Pose, Pinhole]:
    """Pose and intrinsics of a header, bit for bit and unchecked, for sending them again."""
    return _pose(h.pose), _lens(h.width, h.height, h.intrinsics)


def depth_of(message: pb.Depth) -> EncodedDepth:
    """Depth of a message, bit for bit and unchecked, for sending it again."""
    return EncodedDepth(
        payload=message.payload,
        width=message.width,
        height=message.height,
        meters_per_count=message.meters_per_count,
        intrinsics=_lens(message.width, message.height, message.intrinsics) if message.HasField("intrinsics") else None,
        to_camera=_pose(message.to_camera) if message.HasField("to_camera") else None,
        after_image_ns=message.after_image_ns,
    )


def _pose_message(pose: Pose) -> pb.Pose:
    return pb.Pose(**dict(zip(_POSE_FIELDS, (*pose.quaternion, *pose.translation_m))))


def _lens_message(k: Pinhole) -> pb.Intrinsics:
    return pb.Intrinsics(**dict(zip(_LENS_FIELDS, (k.fx, k.fy, k.cx, k.cy, *k.distortion))))


def _depth_message(depth: EncodedDepth) -> pb.Depth:
    return pb.Depth(
        codec=pb.DEPTH_CODEC_DELTA_ZSTD,
        width=depth.width,
        height=depth.height,
        meters_per_count=depth.meters_per_count,
        after_image_ns=depth.after_image_ns,
        intrinsics=None if depth.intrinsics is None else _lens_message(depth.intrinsics),
        to_camera=None if depth.to_camera is None else _pose_message(depth.to_camera),
        payload=depth.payload,
    )


def _pose(message: pb.Pose) -> Pose:
    qw, qx, qy, qz, *translation_m = _POSE(message)
    return Pose((qw, qx, qy, qz), tuple(translation_m))


def _lens(width: int, height: int, message: pb.Intrinsics) -> Pinhole:
    fx, fy, cx, cy, *distortion = _LENS(message)
    return Pinhole(width, height, fx, fy, cx, cy, tuple(distortion))


def parse(raw: bytes) -> pb.PushRequest:
    """Parse a wire message. Raises FrameRejected with reason unparsable."""
    try:
        return pb.PushRequest.FromString(raw)
    except DecodeError:
        raise FrameRejected("unparsable", f"{len(raw)} bytes that are no PushRequest") from None


def from_request(request: pb.PushRequest) -> Frame:
    """Check a message and return its frame, the payload still encoded.

    Raises FrameRejected with reason bad_id, bad_header, crc_mismatch, bad_pose, bad_intrinsics, or a reason
    of ``payload.check`` (too_large, unknown_codec, bad_payload, size_mismatch). Reasons of depth have the prefix
    ``depth_`` and include ``depth_bad_header``.
    """
    h = request.header
    if not valid_id(h.camera_id) or not valid_id(h.session_id):
        raise FrameRejected("bad_id", "camera and session ids are 1 to 64 letters, digits, '.', '_', '-'")
    if checksum(request) != request.crc32c:
        raise FrameRejected("crc_mismatch", f"frame {h.sequence} of {h.camera_id} was damaged on the way")
    codec = CODEC_NAMES.get(h.codec)
    if codec is None:
        raise FrameRejected("unknown_codec", f"codec number {h.codec} is not known here")
    if h.role not in (pb.ROLE_TRAIN, pb.ROLE_HELD_OUT):
        raise FrameRejected("bad_header", "role is neither train nor held-out")
    if h.clock_uncertainty_ns < 0 or h.pose_gap_ns < 0:
        raise FrameRejected("bad_header", "clock uncertainty and pose gap cannot be negative")
    pose, lens = pose_and_lens(h)
    frame = Frame(
        camera=h.camera_id,
        session=h.session_id,
        sequence=h.sequence,
        generated_ns=h.generated_ns,
        pose=_checked_pose(pose),
        intrinsics=_checked_lens(lens),
        codec=codec,
        payload=request.payload,
        held_out=h.role == pb.ROLE_HELD_OUT,
        clock_offset_ns=h.clock_offset_ns,
        clock_uncertainty_ns=h.clock_uncertainty_ns,
        pose_gap_ns=h.pose_gap_ns,
        depth=_checked_depth(request, lens) if request.HasField("depth") else None,
    )
    try:
        payload.check(frame.payload, codec, h.width, h.height)
    except payload.PayloadError as error:
        raise FrameRejected(error.reason, str(error)) from None
    return frame


def _checked_depth(request: pb.PushRequest, image: Pinhole) -> EncodedDepth:
    depth = depth_of(request.depth)
    try:
        if request.header.role == pb.ROLE_HELD_OUT:
            raise FrameRejected("bad_header", "a held-out camera sends none")
        if request.depth.codec != pb.DEPTH_CODEC_DELTA_ZSTD:
            raise FrameRejected("unknown_codec", f"codec number {request.depth.codec} is not known here")
        depth.check(image, len(request.payload))
        if depth.intrinsics is not None:
            _checked_lens(depth.intrinsics)
        if depth.to_camera is not None:
            depth = replace(depth, to_camera=_checked_pose(depth.to_camera))
    except (payload.PayloadError, FrameRejected) as error:
        raise FrameRejected(f"depth_{error.reason}", f"depth: {error}") from None
    return depth


def _checked_pose(pose: Pose) -> Pose:
    q, t = pose.quaternion, pose.translation_m
    if not all(math.isfinite(v) for v in (*q, *t)):
        raise FrameRejected("bad_pose", "pose is not finite")
    if abs(math.hypot(*q) - 1.0) > limits.MAX_QUATERNION_ERROR:
        raise FrameRejected("bad_pose", "pose quaternion is not of unit length")
    if max(abs(v) for v in t) > limits.MAX_TRANSLATION_M:
        raise FrameRejected("bad_pose", f"camera is more than {limits.MAX_TRANSLATION_M:g} m from the origin")
    unit = quaternion_normalize(q)
    return Pose(tuple(map(float, unit)), t)  # type: ignore[arg-type]


def _checked_lens(k: Pinhole) -> Pinhole:
    if not all(math.isfinite(v) for v in (k.fx, k.fy, k.cx, k.cy, *k.distortion)):
        raise FrameRejected("bad_intrinsics", "intrinsics are not finite")
    if not (0 < k.width <= limits.MAX_IMAGE_SIDE_PX and 0 < k.height <= limits.MAX_IMAGE_SIDE_PX):
        raise FrameRejected("too_large", f"{k.width} x {k.height} is not within 1..{limits.MAX_IMAGE_SIDE_PX}")
    if min(k.fx, k.fy) < max(k.width, k.height) * limits.MIN_FOCAL_PER_SIDE or max(k.fx, k.fy) > limits.MAX_FOCAL_PX:
        raise FrameRejected("bad_intrinsics", f"focal lengths {k.fx:g}, {k.fy:g} px do not fit the image size")
    if max(map(abs, k.distortion)) > limits.MAX_DISTORTION:
        raise FrameRejected("bad_intrinsics", "distortion coefficients are beyond any lens")
    sides = limits.MAX_CENTER_OUTSIDE_SIDES
    x_fits = -sides * k.width <= k.cx <= (1 + sides) * k.width
    if not (x_fits and -sides * k.height <= k.cy <= (1 + sides) * k.height):
        raise FrameRejected("bad_intrinsics", "principal point is far outside the image")
    if not invertible(k):
        raise FrameRejected(
            "bad_intrinsics", "distortion cannot be undone over the whole image: wrong coefficients or sizes?"
        )
    return k
