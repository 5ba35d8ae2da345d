"""A recorded session: what is read is what was written, from whole files and cut ones, here and by MCAP."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard

from freshfield import frame as wire
from freshfield import payload
from freshfield.depth import DepthImage, EncodedDepth
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield.session import DECISIONS, SessionError

pytest.importorskip("mcap", reason="MCAP is not installed (extra mcap)")

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC
from mcap_protobuf.decoder import DecoderFactory

from freshfield.session.reader import Session
from freshfield.session.writer import SessionWriter
from tests.support import refused

LENS = Pinhole(32, 24, 40.1, 41.3, 15.7, 12.2, (0.01, -0.002, 0.0003, 0.0))
SCHEMA = {"type": "object", "properties": {"number": {"type": "integer"}}}
START_NS = 1_763_000_000_123_456_789


def depth_of(rng: np.random.Generator) -> EncodedDepth:
    """Depth of a sensor beside the camera."""
    lens, beside = Pinhole(16, 12, 20.0, 20.0, 8.0, 6.0), Pose((1.0, 0.0, 0.0, 0.0), (0.05, 0.0, 0.0))
    return DepthImage(rng.integers(0, 9000, (12, 16), np.uint16), 0.001, lens, beside, -5_000_000).encode()


def requests(count: int = 12, cameras: tuple[str, ...] = ("cam00", "cam01")):
    """Frames with a picture and a pose each, as they come over the wire, with the times they arrive at."""
    rng = np.random.default_rng(1)
    for k in range(count):
        for number, camera in enumerate(cameras):
            pose = Pose.from_matrix(look_at(rng.normal(size=3), [0, 0, 5]))
            data = payload.encode(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8))
            captured = START_NS + k * 33_333_333 + number
            frame = wire.Frame(camera, "s1", k, captured, pose, LENS, "jpeg", data, number == 0, -1_234_567, 1000, 7)
            if number and k % 3 == 0:
                frame = replace(frame, depth=depth_of(rng))
            yield wire.to_request(frame), captured + 2_000_000


def write(path: Path, sent, decisions: int = 3) -> None:
    writer = SessionWriter(path, {"scenario": "test"})
    for request, arrived_ns in sent:
        writer.frame(request, arrived_ns)
    for number in range(decisions):
        writer.data(DECISIONS, "freshfield.Decision", SCHEMA, {"number": number}, START_NS + number)
    writer.close({"dropped": 0})


def test_viewers_find_what_they_know(tmp_path):
    sent = list(requests(3))
    write(tmp_path / "a.mcap", sent)
    found: dict[str, list] = {}
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        topics = [c.topic for c in reader.get_summary().channels.values() if c.message_encoding == "protobuf"]
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=topics):
            found.setdefault(f"{channel.topic} {schema.name}", []).append((message, decoded))
        decisions = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=[DECISIONS])]
    assert decisions == [{"number": 0}, {"number": 1}, {"number": 2}]
    (request, arrived_ns), h = sent[0], sent[0][0].header
    message, image = found["/cam00/image foxglove.CompressedImage"][0]
    assert (image.format, image.data, image.frame_id) == ("jpeg", request.payload, "cam00")
    captured_ns = h.generated_ns + h.clock_offset_ns
    assert (message.log_time, message.publish_time) == (arrived_ns, captured_ns)
    assert image.timestamp.ToNanoseconds() == captured_ns
    assert found["/cam00/header freshfield.v1.FrameHeader"][0][1].SerializeToString() == h.SerializeToString()
    transform = next(d for _, d in found["/tf foxglove.FrameTransform"] if d.child_frame_id == "cam00")
    pose = found["/cam00/pose foxglove.PoseInFrame"][0][1].pose
    for turn, place in ((transform.rotation, transform.translation), (pose.orientation, pose.position)):
        assert (turn.w, turn.x, turn.y, turn.z) == (h.pose.qw, h.pose.qx, h.pose.qy, h.pose.qz)
        assert (place.x, place.y, place.z) == (h.pose.tx_m, h.pose.ty_m, h.pose.tz_m)
    ((_, calibration),) = found["/cam00/calibration foxglove.CameraCalibration"]
    assert list(calibration.K) == [LENS.fx, 0, LENS.cx - 0.5, 0, LENS.fy, LENS.cy - 0.5, 0, 0, 1]
    assert list(calibration.D) == [*LENS.distortion, 0.0]


def test_every_cut_leaves_every_complete_message(tmp_path):
    sent = list(requests(40))
    write(tmp_path / "a.mcap", sent)
    whole = (tmp_path / "a.mcap").read_bytes()
    assert len(whole) > 50_000
    # Where each image ends, found by its payload: before that it is not complete, from there on it is.
    ends = [whole.index(request.payload) + len(request.payload) for request, _ in sent]
    assert ends == sorted(ends)
    rng = np.random.default_rng(4)
    cuts = {8, 30, 200, len(whole) - 1, len(whole) - 30, *map(int, rng.integers(9, len(whole), 30))}
    cuts |= {ends[7] - 1, ends[7] + 40}
    for cut in sorted(cuts):
        (tmp_path / "cut.mcap").write_bytes(whole[:cut])
        session = Session(tmp_path / "cut.mcap")
        found = [f for frames in session.frames.values() for f in frames]
        # After the payload come only the image's other few fields.
        sure, possible = (sum(end <= cut - slack for end in ends) for slack in (40, 0))
        assert sure <= len(found) <= possible, cut
        in_file = sorted(found, key=lambda f: f.location)
        assert [session.payload(f) for f in in_file] == [r.payload for r, _ in sent[: len(found)]]
        said = session.cut or ""
        if cut < len(whole) - 40:  # the last bytes say only that it is whole
            assert f" {cut}: {session.messages.total()} complete messages are used" in said
            assert "\n" not in said
        session.close()


def test_damage_is_left_out_and_said(tmp_path):
    sent = list(requests(400))
    write(tmp_path / "a.mcap", sent)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    data[data.index(sent[3][0].payload) + 9] ^= 0x10
    (tmp_path / "a.mcap").write_bytes(data)
    session = Session(tmp_path / "a.mcap")
    assert session.cut is not None and "1 damaged chunks or records left out" in session.cut
    left = [session.payload(f) for frames in session.frames.values() for f in frames]
    assert 0 < len(left) < len(sent) and set(left) < {r.payload for r, _ in sent}


def test_what_is_no_recording_says_so_and_one_is_never_overwritten(tmp_path):
    for data in (b"", b"\x89MCAP0", b"not an MCAP file at all"):
        (tmp_path / "x.mcap").write_bytes(data)
        refused(SessionError, r"x\.mcap: is not an MCAP file", Session, tmp_path / "x.mcap")
    refused(FileExistsError, "", SessionWriter, tmp_path / "x.mcap", {})


def test_compressed_chunks_are_left_out_unopened_and_said(tmp_path):
    """Whatever they claim to hold."""
    body = struct.pack("<QQQI", 0, 0, 2**28, 0) + struct.pack("<I", 4) + b"zstd"
    body += struct.pack("<Q", 100) + zstandard.compress(bytes(2**20))
    (tmp_path / "a.mcap").write_bytes(MCAP0_MAGIC + struct.pack("<BQ", Opcode.CHUNK, len(body)) + body)
    session = Session(tmp_path / "a.mcap")
    assert "1 compressed chunks left out (`mcap decompress` rewrites them)" in session.cut and not session.frames
