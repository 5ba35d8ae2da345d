"""A recorded session: what is read is what was written, from whole files and cut ones, here and by MCAP."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import zstandard

from freshfield import frame as wire
from freshfield import payload
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield.limits import MAX_CHUNK_BYTES
from freshfield.session import DECISIONS, SessionError
from tests.support import MOST_MS, work_ms

pytest.importorskip("mcap", reason="MCAP is not installed (extra mcap)")

import lz4.frame
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from freshfield.session import reader
from freshfield.session.reader import Session
from freshfield.session.writer import SessionWriter

LENS = Pinhole(32, 24, 40.1, 41.3, 15.7, 12.2, (0.01, -0.002, 0.0003, 0.0))
SCHEMA = {"type": "object", "properties": {"number": {"type": "integer"}}}
START_NS = 1_763_000_000_123_456_789


def requests(count: int = 12, cameras: tuple[str, ...] = ("cam00", "cam01")):
    """Frames with a picture and a pose each, as they come over the wire, with the times they arrive at."""
    rng = np.random.default_rng(1)
    for k in range(count):
        for number, camera in enumerate(cameras):
            pose = Pose.from_matrix(look_at(rng.normal(size=3), [0, 0, 5]))
            data = payload.encode(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8))
            captured = START_NS + k * 33_333_333 + number
            frame = wire.Frame(
                camera,
                "s1",
                k,
                captured,
                pose,
                LENS,
                "jpeg",
                data,
                held_out=number == 0,
                clock_offset_ns=-1_234_567,
                clock_uncertainty_ns=1000,
                pose_gap_ns=7,
            )
            yield wire.to_request(frame), captured + 2_000_000


def write(path: Path, sent, decisions: int = 3) -> None:
    writer = SessionWriter(path, {"scenario": "test"})
    for request, arrived_ns in sent:
        writer.frame(request, arrived_ns)
    for number in range(decisions):
        writer.data(DECISIONS, "freshfield.Decision", SCHEMA, {"number": number}, START_NS + number)
    writer.close({"dropped": 0})


def test_frames_are_read_as_they_were_sent(tmp_path):
    sent = list(requests())
    write(tmp_path / "a.mcap", sent)
    session = Session(tmp_path / "a.mcap")
    assert session.cut is None and set(session.frames) == {"cam00", "cam01"}
    for camera, found in session.frames.items():
        expected = [(r, t) for r, t in sent if r.header.camera_id == camera]
        assert len(found) == len(expected)
        for frame, (request, arrived_ns) in zip(found, expected):
            assert frame.header == request.header and frame.arrived_ns == arrived_ns
            assert session.payload(frame) == request.payload
    session.close()


def test_viewers_find_what_they_know(tmp_path):
    sent = list(requests(3))
    write(tmp_path / "a.mcap", sent)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics.message_count == 4 * 6 + 2 + 3
        found: dict[str, list] = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages(
            topics=[c.topic for c in summary.channels.values() if c.message_encoding == "protobuf"]
        ):
            found.setdefault(channel.topic, []).append((schema.name, message, decoded))
        decisions = [json.loads(m.data) for _, _, m in reader.iter_messages(topics=[DECISIONS])]
    assert decisions == [{"number": 0}, {"number": 1}, {"number": 2}]
    kinds = {topic: rows[0][0] for topic, rows in found.items()}
    assert kinds["/cam00/image"] == "foxglove.CompressedImage"
    assert kinds["/cam00/calibration"] == "foxglove.CameraCalibration" and len(found["/cam00/calibration"]) == 1
    assert kinds["/cam00/pose"] == "foxglove.PoseInFrame" and kinds["/tf"] == "foxglove.FrameTransform"
    assert kinds["/cam00/header"] == "freshfield.v1.FrameHeader"
    request, arrived_ns = sent[0]
    h, (_, message, image) = request.header, found["/cam00/image"][0]
    assert (image.format, image.data, image.frame_id) == ("jpeg", request.payload, "cam00")
    captured_ns = h.generated_ns + h.clock_offset_ns
    assert (message.log_time, message.publish_time) == (arrived_ns, captured_ns)
    assert image.timestamp.ToNanoseconds() == captured_ns
    transform = next(d for _, _, d in found["/tf"] if d.child_frame_id == "cam00")
    pose = found["/cam00/pose"][0][2].pose
    for turn, place in ((transform.rotation, transform.translation), (pose.orientation, pose.position)):
        assert (turn.w, turn.x, turn.y, turn.z) == (h.pose.qw, h.pose.qx, h.pose.qy, h.pose.qz)
        assert (place.x, place.y, place.z) == (h.pose.tx_m, h.pose.ty_m, h.pose.tz_m)
    calibration = found["/cam00/calibration"][0][2]
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


@pytest.mark.parametrize("how", [CompressionType.ZSTD, CompressionType.LZ4])
def test_files_that_another_program_compressed_are_read(tmp_path, how):
    """As MCAP's own tools rewrite them."""
    sent = list(requests())
    write(tmp_path / "a.mcap", sent)
    with (tmp_path / "a.mcap").open("rb") as old, (tmp_path / "b.mcap").open("wb") as new:
        writer = Writer(new, chunk_size=4096, compression=how)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(old).iter_messages(log_time_order=False):
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            times = message.log_time, message.data, message.publish_time
            writer.add_message(channels[channel.id], *times)
        writer.finish()
    session = Session(tmp_path / "b.mcap")
    assert session.cut is None
    found = sorted((f.arrived_ns, session.payload(f)) for frames in session.frames.values() for f in frames)
    assert found == [(t, r.payload) for r, t in sent]


def test_what_is_no_recording_says_so(tmp_path):
    for data in (b"", b"\x89MCAP0", b"not an MCAP file at all"):
        (tmp_path / "x.mcap").write_bytes(data)
        with pytest.raises(SessionError, match=r"x\.mcap: is no MCAP file"):
            Session(tmp_path / "x.mcap")


def test_a_recording_is_never_overwritten(tmp_path):
    write(tmp_path / "a.mcap", [])
    shutil.copy(tmp_path / "a.mcap", tmp_path / "b.mcap")
    with pytest.raises(FileExistsError):
        SessionWriter(tmp_path / "b.mcap", {})


def chunk_of(data: bytes, says: int, how: str) -> bytes:
    """A file of one compressed chunk that says how many bytes it has."""
    head = struct.pack("<QQQI", 0, 0, says, 0) + struct.pack("<I", len(how)) + how.encode()
    body = head + struct.pack("<Q", len(data)) + data
    return MCAP0_MAGIC + struct.pack("<BQ", Opcode.CHUNK, len(body)) + body


ZEROS = zstandard.ZstdCompressor(level=19).compress(bytes(2**28))
LZ4_ZEROS = lz4.frame.compress(bytes(2**28))
EMPTY_RECORDS = zstandard.compress(b"\x80" + bytes(8) + (b"\x80" + bytes(8)) * 1_000_000)
BOMBS = {
    "zstd": chunk_of(ZEROS, 2**28, "zstd"),
    "zstd that says less": chunk_of(ZEROS, 1000, "zstd"),
    "lz4": chunk_of(LZ4_ZEROS, 2**28, "lz4"),
    "lz4 that says less": chunk_of(LZ4_ZEROS, 1000, "lz4"),
    "no records": chunk_of(EMPTY_RECORDS, 9_000_009, "zstd"),
    "another method": chunk_of(b"x" * 100, 100, "rot13"),
    "damaged": chunk_of(ZEROS[:50], 2**28, "zstd"),
}


@pytest.mark.parametrize("data", BOMBS.values(), ids=BOMBS.keys())
def test_a_chunk_bomb_is_left_out_and_said(tmp_path, data):
    (tmp_path / "a.mcap").write_bytes(data)

    def read():
        session = Session(tmp_path / "a.mcap")
        assert "1 damaged chunks or records left out" in session.cut and not session.frames
        session.close()

    assert work_ms(read) < MOST_MS


def test_many_small_bombs_are_not_unpacked_one_after_the_other(tmp_path):
    data = zstandard.ZstdCompressor(level=19).compress(bytes(MAX_CHUNK_BYTES))
    one = chunk_of(data, MAX_CHUNK_BYTES, "zstd")
    (tmp_path / "a.mcap").write_bytes(one + one[len(MCAP0_MAGIC) :] * 500)
    unpacked = []
    with mock.patch.object(reader, "_unpack", side_effect=lambda chunk: unpacked.append(chunk) or b""):
        session = Session(tmp_path / "a.mcap")
    assert "501 damaged chunks" in session.cut and len(unpacked) == 1
