"""Frames to the wire and back, every reason for which one is refused, and the bounds of what is accepted."""

import hashlib
import math
import sys
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from google.protobuf.internal import api_implementation
from hypothesis import given, settings
from hypothesis import strategies as st

from freshfield import limits, payload
from freshfield.depth import DepthImage
from freshfield.frame import Frame, FrameRejected, checksum, from_request, parse, to_request, valid_id
from freshfield.geometry import Pinhole, Pose, quaternion_normalize
from freshfield.v1 import frames_pb2 as pb
from tests.support import refused

IMAGE = np.arange(16 * 12 * 3, dtype=np.uint8).reshape(12, 16, 3)
DATA = {codec: payload.encode(IMAGE, codec) for codec in payload.CODECS}
DEPTH_LENS = Pinhole(8, 5, 9.0, 9.5, 4.0, 2.5, (0.01, 0.0, 0.0, 0.0))
DEPTH = DepthImage(
    np.arange(40, dtype=np.uint16).reshape(5, 8), 0.001, DEPTH_LENS, Pose((1.0, 0.0, 0.0, 0.0), (0.05, 0.0, 0.0)), -9
).encode()
INT64 = st.integers(-(2**63), 2**63 - 1)


def frame(**changes) -> Frame:
    values = {
        "camera": "cam07",
        "session": "12-ab",
        "sequence": 5,
        "generated_ns": 1_700_000_000_123_456_789,
        "pose": Pose((0.5, 0.5, -0.5, 0.5), (1.0, -2.0, 3.0)),
        "intrinsics": Pinhole(16, 12, 20.0, 21.0, 8.0, 6.0, (0.1, -0.01, 0.001, 0.0)),
        "codec": "png",
        "payload": DATA["png"],
        "held_out": True,
        "clock_offset_ns": -5,
        "clock_uncertainty_ns": 7,
        "pose_gap_ns": 11,
    }
    return Frame(**{**values, **changes})


ids = st.from_regex(r"[A-Za-z0-9._-]{1,64}", fullmatch=True)


@given(
    changes=st.fixed_dictionaries(
        {
            "camera": ids,
            "session": ids,
            "sequence": st.integers(0, 2**64 - 1),
            "generated_ns": INT64,
            "held_out": st.booleans(),
            "clock_offset_ns": INT64,
            "clock_uncertainty_ns": st.integers(0, 2**63 - 1),
        }
    ),
    q=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: max(map(abs, q)) > 1e-3),
    t=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    codec=st.sampled_from(payload.CODECS),
    depth=st.sampled_from([None, DEPTH, replace(DEPTH, to_camera=None, after_image_ns=0)]),
)
def test_what_is_sent_is_what_arrives(changes, q, t, codec, depth):
    pose = Pose(tuple(map(float, quaternion_normalize(q))), t)
    depth = None if changes["held_out"] else depth
    sent = frame(**changes, pose=pose, codec=codec, payload=DATA[codec], depth=depth)
    back = from_request(pb.PushRequest.FromString(to_request(sent).SerializeToString()))
    np.testing.assert_allclose(back.pose.quaternion, sent.pose.quaternion, atol=1e-15)
    assert back.pose.translation_m == sent.pose.translation_m
    assert replace(back, pose=sent.pose) == sent
    assert back.generated_edge_ns == sent.generated_ns + sent.clock_offset_ns


def test_without_depth_a_frame_is_the_bytes_that_it_always_was():
    """As of the version before depth, so that nodes and edges of both understand each other."""
    request = to_request(frame(codec="jpeg", payload=b"what a camera saw"))
    wire = request.SerializeToString(deterministic=True)
    assert request.crc32c == 0x9A231BEE and len(wire) == 206
    assert hashlib.sha256(wire).hexdigest() == "3dbb1fc20dcfebe6806afbc1cf133122550fdb60b19b5bf23de974e866ab1afa"


def place(request: pb.PushRequest, path: str) -> tuple:
    """The message that holds a field, and the field's name."""
    *parents, name = path.split(".")
    return reduce(getattr, parents, request), name


def refusal(request: pb.PushRequest, checksum_fits: bool = True) -> FrameRejected:
    if checksum_fits:
        request.crc32c = checksum(request)
    return refused(FrameRejected, "", from_request, request)


def with_depth() -> pb.PushRequest:
    return to_request(frame(held_out=False, depth=DEPTH))


@pytest.mark.stability
@pytest.mark.parametrize(
    ("path", "value", "reason"),
    [
        ("header.camera_id", "../../etc", "bad_id"),
        ("header.session_id", "s s", "bad_id"),
        ("header.codec", 99, "unknown_codec"),
        ("header.role", pb.ROLE_UNSPECIFIED, "bad_header"),
        ("header.role", pb.ROLE_HELD_OUT, "depth_bad_header"),
        ("header.clock_uncertainty_ns", -1, "bad_header"),
        ("header.pose_gap_ns", -1, "bad_header"),
        ("header.pose.qw", math.nan, "bad_pose"),
        ("header.pose.ty_m", 1e7, "bad_pose"),
        ("header.pose.qw", 0.6, "bad_pose"),
        ("header.intrinsics.fx", math.nan, "bad_intrinsics"),
        ("header.intrinsics.fy", -20.0, "bad_intrinsics"),
        ("header.intrinsics.fx", 1e7, "bad_intrinsics"),
        ("header.intrinsics.k1", 1e3, "bad_intrinsics"),
        ("header.height", 5000, "too_large"),
        ("header.width", 17, "size_mismatch"),
        ("depth.codec", pb.DEPTH_CODEC_UNSPECIFIED, "depth_unknown_codec"),
        ("depth.meters_per_count", math.nan, "depth_bad_header"),
        ("depth.payload", b"", "depth_bad_payload"),
        ("depth.width", 0, "depth_too_large"),
        ("depth.width", 9, "depth_size_mismatch"),
        ("depth.intrinsics.fx", math.nan, "depth_bad_intrinsics"),
        ("depth.to_camera.qw", 0.5, "depth_bad_pose"),
    ],
)
def test_each_refusal_has_its_reason(path, value, reason):
    request = with_depth()
    setattr(*place(request, path), value)
    found = refusal(request)
    assert found.reason == reason and str(found).startswith("depth: ") == reason.startswith("depth_")


@pytest.mark.stability
@pytest.mark.parametrize("axis", ["cx", "cy"])
def test_a_principal_point_lies_at_most_one_image_outside(axis):
    """A crop may put it outside, by no more than the image itself."""
    lens = frame().intrinsics
    side = lens.width if axis == "cx" else lens.height
    for center, beyond in ((-side, -side - 1e-6), (2 * side, 2 * side + 1e-6)):
        taken = from_request(to_request(frame(intrinsics=replace(lens, **{axis: center}))))
        assert getattr(taken.intrinsics, axis) == center
        error = refusal(to_request(frame(intrinsics=replace(lens, **{axis: beyond}))))
        assert "principal point" in str(error)


def fields(message) -> list[str]:
    """Paths of every field of a message, those of its messages among them."""
    paths = []
    for field in message.DESCRIPTOR.fields:
        inner = field.type == field.TYPE_MESSAGE
        paths += [f"{field.name}.{path}" for path in fields(getattr(message, field.name))] if inner else [field.name]
    return paths


def test_the_checksum_covers_every_field():
    """Each value altered by the least that its type can be: had it no part in the checksum, the frame would pass."""
    paths = fields(pb.PushRequest())
    assert len(paths) == 26 + 21 + 2, "of header and depth, and payload and checksum"
    for path in paths:
        request = with_depth()
        holder, name = place(request, path)
        value = getattr(holder, name)
        setattr(holder, name, value + {str: "x", bytes: b"x", int: 1, float: 1e-9}[type(value)])
        assert refusal(request, checksum_fits=False).reason == "crc_mismatch", path


@pytest.mark.parametrize("part", ["depth", "depth.intrinsics", "depth.to_camera"])
def test_the_checksum_covers_what_is_left_out_or_added(part):
    less, more = with_depth(), to_request(frame(held_out=False))
    holder, name = place(less, part)
    holder.ClearField(name)
    more.depth.SetInParent()
    for request in (less, more):
        assert refusal(request, checksum_fits=False).reason == "crc_mismatch"


BLACK = payload.encode(np.zeros((48, 64, 3), np.uint8), "png")


@settings(max_examples=300)
@given(
    f=st.floats(4, 200),
    center=st.tuples(st.floats(-64, 128), st.floats(-48, 96)),
    k=st.tuples(*[st.one_of(st.floats(-0.1, 0.1), st.floats(-100, 100))] * 4),
)
def test_every_admitted_lens_has_rays(f, center, k):
    camera = Pinhole(64, 48, f, f, *center, k)
    try:
        admitted = from_request(to_request(frame(intrinsics=camera, payload=BLACK))).intrinsics
    except FrameRejected as error:
        assert error.reason == "bad_intrinsics"
        return
    u, v = np.meshgrid([0, camera.width / 2, camera.width], [0, camera.height / 2, camera.height])
    points = np.stack([u.ravel(), v.ravel()], -1)
    rays = admitted.rays(points)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(admitted.project(rays), points, atol=1.0)


@given(st.text(max_size=70))
def test_valid_ids_are_safe_in_file_names_and_ledgers(text):
    assert valid_id(text) == (1 <= len(text) <= 64 and all(c.isascii() and (c.isalnum() or c in "._-") for c in text))


RAW = to_request(frame()).SerializeToString()


def test_four_million_fields_are_read_at_once():
    """At some 15 ns a field; Python's share does not grow with their number."""
    raw, ran = RAW + b"\x0a\0" * (4 * 2**20 - 1000), list[str]()

    def trace(_frame, event, _arg):
        ran.append(event)
        return trace

    def lines_run(data):
        ran.clear()
        before = sys.gettrace()
        sys.settrace(trace)
        try:
            parse(data)
        finally:
            sys.settrace(before)
        return ran.count("line")

    assert api_implementation.Type() == "upb"
    assert parse(raw).header.camera_id == "cam07"
    assert lines_run(raw) == lines_run(RAW) < 10


# Part of the contract, since peers of other versions keep within them. Written out: tests of each bound import it.
AGREED = {
    "MAX_PAYLOAD_BYTES": 8_388_608,
    "MAX_MESSAGE_BYTES": 8_392_704,
    "MAX_IMAGE_SIDE_PX": 4096,
    "METERS_PER_COUNT": (1e-6, 1.0),
    "MAX_DEPTH_GAP_NS": 10_000_000_000,
    "MAX_ID_CHARS": 64,
    "MAX_CAPTURE_AHEAD_NS": 250_000_000,
    "MAX_CAPTURE_AGE_NS": 3_600_000_000_000,
    "MAX_CLOCK_UNCERTAINTY_NS": 1_000_000_000,
    "MAX_TRANSLATION_M": 1e6,
    "MAX_QUATERNION_ERROR": 1e-3,
    "MIN_FOCAL_PER_SIDE": 0.0625,
    "MAX_FOCAL_PX": 1e6,
    "MAX_DISTORTION": 100.0,
    "MAX_CENTER_OUTSIDE_SIDES": 1.0,
    "MAX_CAMERAS": 1000,
    "MAX_STREAMS_PER_CAMERA": 4,
    "MAX_SESSIONS_PER_CAMERA": 64,
    "SESSION_IDLE_NS": 2_000_000_000,
    "FIRST_MESSAGE_TIMEOUT_S": 10.0,
    "GRPC_IDLE_S": 60.0,
    "MAX_CALLS": 3000,
    "MAX_CONCURRENT_STREAMS": 1024,
}


def test_what_peers_may_send_is_what_was_agreed():
    for name, value in AGREED.items():
        assert getattr(limits, name) == value, name
