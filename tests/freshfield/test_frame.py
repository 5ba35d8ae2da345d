"""Frames to the wire and back, and every reason for which one is refused."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from google.protobuf.internal import api_implementation
from hypothesis import given, settings
from hypothesis import strategies as st

from freshfield import payload
from freshfield.depth import DepthImage
from freshfield.frame import Frame, FrameRejected, checksum, counted_ids, from_request, parse, to_request, valid_id
from freshfield.geometry import Pinhole, Pose, quaternion_normalize
from freshfield.v1 import frames_pb2 as pb
from tests.conftest import data_dir
from tests.support import lines_run

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
    camera=ids,
    session=ids,
    sequence=st.integers(0, 2**64 - 1),
    generated_ns=INT64,
    q=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: max(map(abs, q)) > 1e-3),
    t=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    codec=st.sampled_from(payload.CODECS),
    held_out=st.booleans(),
    offset_ns=INT64,
    uncertainty_ns=st.integers(0, 2**63 - 1),
    depth=st.sampled_from([None, DEPTH, replace(DEPTH, to_camera=None, after_image_ns=0)]),
)
def test_what_is_sent_is_what_arrives(
    camera, session, sequence, generated_ns, q, t, codec, held_out, offset_ns, uncertainty_ns, depth
):
    sent = frame(
        camera=camera,
        session=session,
        sequence=sequence,
        generated_ns=generated_ns,
        pose=Pose(tuple(map(float, quaternion_normalize(q))), t),
        codec=codec,
        payload=DATA[codec],
        held_out=held_out,
        clock_offset_ns=offset_ns,
        clock_uncertainty_ns=uncertainty_ns,
        depth=None if held_out else depth,
    )
    wire = to_request(sent).SerializeToString()
    back = from_request(pb.PushRequest.FromString(wire))
    np.testing.assert_allclose(back.pose.quaternion, sent.pose.quaternion, atol=1e-15)
    assert back.pose.translation_m == sent.pose.translation_m
    assert back == frame(**{**sent.__dict__, "pose": back.pose})
    assert back.generated_edge_ns == generated_ns + offset_ns


def test_without_depth_a_frame_is_the_bytes_that_it_always_was():
    """As of the version before depth, so that nodes and edges of both understand each other."""
    request = to_request(frame(codec="jpeg", payload=b"what a camera saw"))
    wire = request.SerializeToString(deterministic=True)
    assert request.crc32c == 0x9A231BEE and len(wire) == 206
    assert hashlib.sha256(wire).hexdigest() == "3dbb1fc20dcfebe6806afbc1cf133122550fdb60b19b5bf23de974e866ab1afa"


def changed(change, checksummed: bool = True, **values) -> pb.PushRequest:
    """A request that somebody altered, with a checksum that fits unless told otherwise."""
    request = to_request(frame(**values))
    change(request)
    if checksummed:
        request.crc32c = checksum(request)
    return request


def setter(part):
    """Changes of a request's header or depth, by paths of their fields."""

    def to(**values):
        def change(request):
            for path, value in values.items():
                *parents, name = path.split("__")
                setattr(reduce(getattr, parents, getattr(request, part)), name, value)

        return change

    return to


set_header, set_depth = setter("header"), setter("depth")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (set_header(camera_id=""), "bad_id"),
        (set_header(camera_id="../../etc"), "bad_id"),
        (set_header(session_id="s s"), "bad_id"),
        (set_header(codec=99), "unknown_codec"),
        (set_header(codec=pb.CODEC_UNSPECIFIED), "unknown_codec"),
        (set_header(role=pb.ROLE_UNSPECIFIED), "bad_header"),
        (set_header(codec=-1), "unknown_codec"),
        (set_header(role=-7), "bad_header"),
        (set_header(clock_uncertainty_ns=-1), "bad_header"),
        (set_header(pose_gap_ns=-1), "bad_header"),
        (set_header(pose__qw=math.nan), "bad_pose"),
        (set_header(pose__tx_m=math.inf), "bad_pose"),
        (set_header(pose__ty_m=1e7), "bad_pose"),
        (set_header(pose__qw=0.6), "bad_pose"),
        (set_header(pose__qw=0.0, pose__qx=0.0, pose__qy=0.0, pose__qz=0.0), "bad_pose"),
        (set_header(intrinsics__fx=math.nan), "bad_intrinsics"),
        (set_header(intrinsics__fx=0.0), "bad_intrinsics"),
        (set_header(intrinsics__fy=-20.0), "bad_intrinsics"),
        (set_header(intrinsics__fx=1e7), "bad_intrinsics"),
        (set_header(intrinsics__cx=1e5), "bad_intrinsics"),
        (set_header(intrinsics__k1=1e3), "bad_intrinsics"),
        (set_header(width=0), "too_large"),
        (set_header(height=5000), "too_large"),
        (set_header(width=17), "size_mismatch"),
        (set_header(codec=pb.CODEC_JPEG), "bad_payload"),
        (lambda r: setattr(r, "payload", b""), "bad_payload"),
    ],
)
def test_each_refusal_has_its_reason(change, reason):
    with pytest.raises(FrameRejected) as error:
        from_request(changed(change))
    assert error.value.reason == reason and str(error.value)


@pytest.mark.stability
@pytest.mark.parametrize("axis", ["cx", "cy"])
def test_a_principal_point_lies_at_most_one_image_outside(axis):
    """A crop may put it outside, by no more than the image itself."""
    lens = frame().intrinsics
    side = lens.width if axis == "cx" else lens.height
    for center, taken in ((-side, True), (-side - 1e-6, False), (2 * side, True), (2 * side + 1e-6, False)):
        request = changed(set_header(**{f"intrinsics__{axis}": center}))
        with contextlib.nullcontext() if taken else pytest.raises(FrameRejected, match="principal point"):
            assert getattr(from_request(request).intrinsics, axis) == center


@pytest.mark.stability
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (set_depth(codec=pb.DEPTH_CODEC_UNSPECIFIED), "depth_unknown_codec"),
        (set_depth(codec=99), "depth_unknown_codec"),
        (set_depth(codec=-1), "depth_unknown_codec"),
        (set_depth(width=0), "depth_too_large"),
        (set_depth(width=9), "depth_size_mismatch"),
        (set_depth(payload=b""), "depth_bad_payload"),
        (set_depth(payload=payload.encode(IMAGE, "zstd")), "depth_size_mismatch"),
        (set_depth(meters_per_count=math.nan), "depth_bad_header"),
        (set_depth(meters_per_count=math.inf), "depth_bad_header"),
        (set_depth(meters_per_count=-1.0), "depth_bad_header"),
        (set_depth(after_image_ns=-(2**63)), "depth_bad_header"),
        (set_depth(intrinsics__fx=math.nan), "depth_bad_intrinsics"),
        (set_depth(intrinsics__fx=0.0), "depth_bad_intrinsics"),
        (set_depth(intrinsics__k1=-30.0), "depth_bad_intrinsics"),
        (set_depth(to_camera__qw=0.5), "depth_bad_pose"),
        (set_depth(to_camera__tx_m=math.inf), "depth_bad_pose"),
        (lambda r: r.depth.ClearField("intrinsics"), "depth_bad_header"),
        (lambda r: r.depth.Clear(), "depth_unknown_codec"),
        (lambda r: setattr(r.header, "role", pb.ROLE_HELD_OUT), "depth_bad_header"),
    ],
)
def test_depth_is_refused_for_its_own_reasons(change, reason):
    with pytest.raises(FrameRejected) as error:
        from_request(changed(change, held_out=False, depth=DEPTH))
    assert error.value.reason == reason and str(error.value).startswith("depth: ")


def fields(message) -> list[str]:
    """Paths of every field of a message, those of pose and intrinsics among them."""
    paths = []
    for field in message.DESCRIPTOR.fields:
        inner = field.type == field.TYPE_MESSAGE
        paths += [f"{field.name}__{path}" for path in fields(getattr(message, field.name))] if inner else [field.name]
    return paths


def test_there_are_this_many_fields():
    assert (len(fields(pb.FrameHeader())), len(fields(pb.Depth()))) == (26, 21)


@pytest.mark.parametrize(
    ("part", "path"), [*(("header", p) for p in fields(pb.FrameHeader())), *(("depth", p) for p in fields(pb.Depth()))]
)
def test_the_checksum_covers_every_field(part, path):
    """Each value altered by the least that its type can be: had it no part in the checksum, the frame would pass."""

    def alter(request):
        *parents, name = path.split("__")
        target = reduce(getattr, parents, getattr(request, part))
        value = getattr(target, name)
        more = {str: "x", bytes: b"x", int: 1, float: 1e-9}[type(value)]
        setattr(target, name, value + more)

    with pytest.raises(FrameRejected) as error:
        from_request(changed(alter, checksummed=False, held_out=False, depth=DEPTH))
    assert error.value.reason == "crc_mismatch"


@pytest.mark.parametrize(
    ("alter", "depth"),
    [
        (lambda r: r.ClearField("depth"), DEPTH),
        (lambda r: r.depth.ClearField("intrinsics"), DEPTH),
        (lambda r: r.depth.ClearField("to_camera"), DEPTH),
        (lambda r: r.depth.SetInParent(), None),
        (lambda r: setattr(r, "payload", r.payload[:-1] + b"\0"), None),
    ],
    ids=["no depth", "no lens", "no pose", "depth added", "payload"],
)
def test_the_checksum_covers_what_is_left_out_or_added_and_the_payload(alter, depth):
    with pytest.raises(FrameRejected) as error:
        from_request(changed(alter, checksummed=False, held_out=False, depth=depth))
    assert error.value.reason == "crc_mismatch"


def sent_through(camera: Pinhole) -> Pinhole:
    """The lens as it is admitted; size and payload are those of a real frame."""
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    return from_request(to_request(frame(intrinsics=camera, payload=payload.encode(image, "png")))).intrinsics


def nine_points(camera: Pinhole) -> np.ndarray:
    u, v = np.meshgrid([0, camera.width / 2, camera.width], [0, camera.height / 2, camera.height])
    return np.stack([u.ravel(), v.ravel()], -1)


def test_a_lens_whose_rays_are_finite_but_wrong_is_refused():
    camera = Pinhole(64, 64, 40.0, 40.0, 32.0, 32.0, (-0.9, 0.0, 0.0, 0.0))
    points = nine_points(camera)
    assert np.isfinite(camera.rays(points)).all()
    assert np.abs(camera.project(camera.rays(points)) - points).max() > 1
    with pytest.raises(FrameRejected) as error:
        sent_through(camera)
    assert error.value.reason == "bad_intrinsics"


@settings(max_examples=300)
@given(
    f=st.floats(4, 200),
    center=st.tuples(st.floats(-64, 128), st.floats(-48, 96)),
    k=st.tuples(*[st.one_of(st.floats(-0.1, 0.1), st.floats(-100, 100))] * 4),
)
def test_every_admitted_lens_has_rays(f, center, k):
    camera = Pinhole(64, 48, f, f, *center, k)
    try:
        admitted = sent_through(camera)
    except FrameRejected as error:
        assert error.reason == "bad_intrinsics"
        return
    points = nine_points(camera)
    rays = admitted.rays(points)
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(admitted.project(rays), points, atol=1.0)


def test_the_fox_lens_is_admitted():
    k = json.loads((data_dir("fox") / "transforms_2.json").read_text())
    coefficients = tuple(k[name] for name in ("k1", "k2", "p1", "p2"))
    camera = Pinhole(int(k["w"]), int(k["h"]), k["fl_x"], k["fl_y"], k["cx"], k["cy"], coefficients)
    assert camera.distorted and sent_through(camera) == camera


@given(st.text(max_size=70))
def test_valid_ids_are_safe_in_file_names_and_ledgers(text):
    assert valid_id(text) == (1 <= len(text) <= 64 and all(c.isascii() and (c.isalnum() or c in "._-") for c in text))


RAW = to_request(frame()).SerializeToString()


@pytest.mark.parametrize("raw", [RAW + b"\0\0", RAW[:-1], b"\xff" * 9, b"\x0b"], ids=bytes.hex)
def test_bytes_that_are_no_message_are_refused(raw):
    with pytest.raises(FrameRejected) as error:
        parse(raw)
    assert error.value.reason == "unparsable"


@pytest.mark.parametrize("field", [b"\x78\0", b"\x0a\0"], ids=["unknown fields", "headers"])
def test_four_million_fields_are_read_at_once(field):
    """At some 15 ns a field; Python's share does not grow with their number."""
    raw = RAW + field * (4 * 2**20 - 1000)
    assert api_implementation.Type() == "upb"
    assert parse(raw).header.camera_id == "cam07"
    assert lines_run(lambda: parse(raw)) == lines_run(lambda: parse(RAW)) < 10


def test_refusals_of_strangers_are_counted_together():
    def ids(camera, session):
        return counted_ids(pb.FrameHeader(camera_id=camera, session_id=session), ["cam07"])

    assert ids("cam07", "s1") == ("cam07", "s1")
    assert ids("cam07", "a\tb") == ("cam07", "?")
    assert ids("cam08", "s1") == ids("made-up", "s2") == ("?", "?")
