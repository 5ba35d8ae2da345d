"""Frames arrive: every refusal is named, counted and without effect on the next one; a camera's newest is kept."""

import dataclasses
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard

from edge_server.live.buffer import FrameBuffer
from edge_server.live.ingest import FrameAdmission, Ingest
from freshfield import payload
from freshfield.clock import VirtualClock
from freshfield.depth import DepthImage, EncodedDepth
from freshfield.frame import Frame, FrameRejected, checksum, to_request
from freshfield.geometry import Pinhole
from freshfield.ledger import Ledger, LedgerReader
from freshfield.v1 import frames_pb2 as pb
from tests.edge_server.frames import frame
from tests.freshfield.test_streams import Stream
from tests.support import refused

NOW = 10**18
MS = 1_000_000


@pytest.fixture
def ingest(tmp_path):
    held, ledger = [], Ledger(tmp_path, "edge", "edge", NOW)
    made = Ingest(VirtualClock(NOW), FrameBuffer(["cam01"]), ["cam00"], ledger, held.append, max_side_px=128)
    made.test_held, made.test_ledger = held, ledger
    yield made
    ledger.close(NOW)


def good(sequence: int = 0, **other):
    return frame(sequence=sequence, generated_ns=NOW - 50 * MS + sequence, **other)


def rejection(admission: FrameAdmission, item: Frame) -> str:
    return refused(FrameRejected, "", admission.admit, item, NOW).reason


def test_held_out_frames_never_reach_the_training_buffer(ingest):
    assert ingest.take(to_request(good(camera="cam00", held_out=True))).outcome == pb.OUTCOME_ACCEPTED
    assert [f.camera for f in ingest.test_held] == ["cam00"]
    assert ingest.buffer.newest() == {}


def sent(change: Callable[[pb.FrameHeader], None] = lambda header: None, **wrong: Any) -> pb.PushRequest:
    """A frame that is wrong, or whose header is changed, with a checksum that fits."""
    request = to_request(good(sequence=5, **wrong) if "generated_ns" not in wrong else frame(sequence=5, **wrong))
    change(request.header)
    request.crc32c = checksum(request)
    return request


DAMAGED = sent()
DAMAGED.payload = DAMAGED.payload[:-1] + b"\0"
LARGE = Pinhole.from_fov(4096, 4096, 60.0)
BAD = {
    "unparsable": to_request(good()).SerializeToString() + b"\0\0",
    "crc_mismatch": DAMAGED,
    "unknown_codec": sent(lambda header: setattr(header, "codec", -7)),  # an enum may be negative
    "unknown_camera": sent(camera="cam77"),
    "too_large": sent(intrinsics=LARGE, payload=payload.encode(np.zeros((4096, 4096, 3), np.uint8))),
    "wrong_role": sent(held_out=True),
    "from_future": sent(generated_ns=NOW + 3600 * 10**9),
    "too_old": sent(generated_ns=NOW - 2 * 3600 * 10**9),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_refusal_is_named_counted_and_loses_nothing_else(ingest, kind):
    answer = ingest.take(BAD[kind])
    assert (answer.outcome, answer.reason) == (pb.OUTCOME_REJECTED, kind)
    assert answer.detail
    assert ingest.rejected == {kind: 1}
    # The very next frame, with a sequence below the refused one's, is welcome.
    assert ingest.take(to_request(good(sequence=1)).SerializeToString()).outcome == pb.OUTCOME_ACCEPTED
    events = [(e.event, e.detail) for e in LedgerReader(ingest.test_ledger.path).events]
    assert events == [("rejected", kind), ("delivered", "")]


def test_a_thousand_made_up_cameras_are_counted_as_one(ingest):
    for i in range(1000):
        ingest.take(to_request(good(camera=f"made-up-{i}", session=f"s{i}")))
    assert ingest.rejected_by_camera == {"?": 1000}
    assert {(e.camera, e.session) for e in LedgerReader(ingest.test_ledger.path).events} == {("?", "?")}


def test_only_the_codec_that_the_scenario_names_is_taken():
    """A PNG costs its decoder more than a JPEG of as many bytes, so that a sender may not choose."""
    item = good(codec="png", payload=payload.encode(np.zeros((24, 32, 3), np.uint8), "png"))
    for codec in (None, "png"):
        FrameAdmission(["cam01"], [], codec=codec).admit(item, NOW)
    assert rejection(FrameAdmission(["cam01"], [], codec="jpeg"), item) == "unknown_codec"


def depth(width: int = 32, height: int = 24, **other) -> EncodedDepth:
    return DepthImage(np.ones((height, width), np.uint16), 0.001, **other).encode()


@pytest.mark.stability
def test_depth_may_be_larger_than_its_image_up_to_a_sensors_size(ingest):
    """The scenario's images have 128 pixels a side."""
    answers = []
    for k, side in enumerate((128, 1280, 1281)):
        sensor = Pinhole.from_fov(side, 24, 60.0)
        answers.append(ingest.take(to_request(good(k, depth=depth(side, intrinsics=sensor)))))
    assert [answer.reason for answer in answers] == ["", "", "depth_too_large"]
    assert ingest.delivered["cam01"] == 2 and ingest.rejected == {"depth_too_large": 1}


def test_depth_is_counted_by_camera_with_its_own_age(ingest):
    assert ingest.depth == {}
    for k, later_ns in enumerate((-100 * MS, 20 * MS, None)):
        sent = None if later_ns is None else depth(after_image_ns=later_ns)
        ingest.take(to_request(good(k, depth=sent)))
    (found,) = ingest.depth.items()
    assert found[0] == "cam01" and (found[1].frames, found[1].bytes) == (2, 2 * len(depth().payload))
    assert ingest.depth_ages_ms(NOW) == {"cam01": pytest.approx(30.0, abs=1e-3)}


@pytest.mark.stability
def test_a_bomb_of_depth_is_refused_and_loses_nothing_else(ingest):
    bomb = zstandard.ZstdCompressor().compress(bytes(2**28))
    answer = ingest.take(to_request(good(0, depth=dataclasses.replace(depth(), payload=bomb))))
    assert answer.reason == "depth_size_mismatch" and "depth: " in answer.detail
    assert ingest.take(to_request(good(1, depth=depth()))).outcome == pb.OUTCOME_ACCEPTED
    assert ingest.buffer.newest()["cam01"].depth == depth()


def test_another_stream_cannot_use_up_the_numbers_of_a_session(ingest):
    mine, spoofer = Stream(), Stream()
    assert ingest.take(to_request(good(1)), mine).outcome == pb.OUTCOME_ACCEPTED
    assert ingest.take(to_request(frame(sequence=2**63, generated_ns=NOW)), spoofer).reason == "session_in_use"
    assert ingest.take(to_request(good(2)), mine).outcome == pb.OUTCOME_ACCEPTED
    assert ingest.rejected == {"session_in_use": 1}


# Sessions and tenths of a second. Frames of a node's old session may still be on their way when it has restarted.
TWO_NODES = [("s1", 10), ("s1", 20), ("s1", 30), ("s2", 31), ("s1", 40), ("s2", 41), ("s1", 50), ("s2", 51)]
RESTARTED = [("s1", 0), ("s1", 1), ("s2", 20), ("s1", 2), ("s2", 21), ("s1", 3), ("s2", 40)]


# The edge has started again, and both nodes go on.
EDGE_RESTARTED = [("s1", 30), ("s2", 31), ("s1", 42)]
KNOWN = {"cam01": {"s1": (20, 0), "s2": (21, 0)}}


@pytest.mark.parametrize(
    ("arrivals", "doubled", "known"),
    [(TWO_NODES, {"cam01": 1}, {}), (RESTARTED, {}, {}), (EDGE_RESTARTED, {"cam01": 1}, KNOWN)],
)
def test_two_nodes_of_one_name_are_told_apart_and_said(arrivals, doubled, known, caplog):
    admission = FrameAdmission(["cam01"], [], known=known)
    for session, tenths in arrivals:
        at_ns = NOW + tenths * 100 * MS
        admission.admit(frame(sequence=tenths, generated_ns=at_ns, session=session), NOW + 5 * 10**9)
    assert admission.doubled == doubled and len(caplog.records) == len(doubled)


def test_a_thousand_sessions_do_not_grow_the_admission():
    admission = FrameAdmission(["cam01"], [])
    for i in range(1000):
        admission.admit(good(session=f"s{i}"), NOW)
    assert len(admission._sessions["cam01"]) <= 64


def test_an_uncertain_clock_is_given_its_uncertainty_but_no_two_seconds():
    FrameAdmission(["cam01"], []).admit(frame(generated_ns=NOW + 400 * MS, clock_uncertainty_ns=200 * MS), NOW)
    for ahead_ms, uncertain_ms in ((400, 0), (2000, 3_600_000)):
        late = frame(generated_ns=NOW + ahead_ms * MS, clock_uncertainty_ns=uncertain_ms * MS)
        assert rejection(FrameAdmission(["cam01"], []), late) == "from_future"


def test_after_a_restart_of_the_edge_no_frame_is_taken_again():
    before = FrameAdmission(["cam01", "cam02"], [])
    for sequence in (3, 4):
        before.admit(good(sequence), NOW)
    told = msgspec.json.decode(msgspec.json.encode(before.last_frames()), type=dict[str, dict[str, tuple[int, int]]])
    after = FrameAdmission(["cam01"], ["cam00"], known=told)
    no_later = [frame(sequence=5, generated_ns=at_ns) for at_ns in (NOW - 51 * MS, good(4).generated_ns)]
    for item in (good(3), good(4), *no_later):
        assert rejection(after, item) == ("time_reversed" if item in no_later else "replayed_sequence")
    after.admit(good(5), NOW)
    after.admit(good(0, session="another"), NOW)


@pytest.mark.stability
@pytest.mark.parametrize("restarts", [False, True])
def test_ages_are_right_again_with_the_first_frame_after_a_jump(restarts):
    """A node's own clock jumps, which begins a new session, or its clock runs on and the estimated offset jumps."""
    # The clock's error in ms, by time in ms: ahead within what an unknown clock is given, far behind, ahead by a day.
    jumps = {0: 0, 2000: 1100, 4000: 0, 6000: -20 * 60_000, 8000: 0, 9000: 86_400_000, 10_000: 0}
    gate, buffer = FrameAdmission(["cam01"], []), FrameBuffer(["cam01", "never"])
    ages, refused = {}, []
    for number, at_ms in enumerate(range(0, 12_000, 50)):
        captured_ns, now_ns = NOW + at_ms * MS, NOW + (at_ms + 20) * MS
        jumped_ms = max(t for t in jumps if t <= at_ms)
        wrong_ns = jumps[jumped_ms] * MS
        told = {"generated_ns": captured_ns, "clock_offset_ns": wrong_ns}
        if restarts:
            told = {"generated_ns": captured_ns + wrong_ns, "session": f"s{jumped_ms}"}
        made = frame(sequence=number, clock_uncertainty_ns=3600 * 10**9, **told)
        try:
            gate.admit(made, now_ns)
            buffer.put(made, now_ns)
        except FrameRejected as error:
            refused.append(error.reason)
        ages[at_ms] = buffer.ages_ms(now_ns)["cam01"]
        assert wrong_ns or ages[at_ms] == 20, at_ms
    # Ahead within the tolerance is believed; behind, the last good frame grows old; a day ahead is refused.
    assert ages[3000] == 20 - 1100 and ages[7950] == 20 + 2000
    assert refused == ["from_future"] * 20 and buffer.stale_on_arrival == 40
    assert buffer.ages_ms(now_ns)["never"] is None
