"""From a node to an edge that records, and from the recording through a node: the same, each message."""

import asyncio
import logging
from dataclasses import replace
from pathlib import Path

import pytest

from camera_node.capture import Camera, build_cameras
from camera_node.node import Node, NodeOptions
from camera_node.settings import source_config
from edge_server.live.buffer import FrameBuffer
from edge_server.live.ingest import Ingest
from edge_server.live.output.recorder import Recorder
from freshfield.clock import WallClock
from freshfield.frame import Frame, to_request
from freshfield.ledger import Ledger
from freshfield.scenario import parse
from freshfield.transport import Transport
from freshfield.v1 import frames_pb2 as pb
from tests.camera_node.depth_source import depth_camera
from tests.camera_node.sources.datasets.photos import photo_scenario, write_photos
from tests.integration.peer import Peer, answer
from tests.support import refused

pytest.importorskip("mcap", reason="MCAP is not installed (extra mcap)")

from freshfield.session.reader import Session
from freshfield.session.writer import SessionWriter

CAMERAS = {"count": 3, "held_out": ["cam00"]}


def replay_scenario(file: Path, **source):
    section = {"kind": "mcap", "file": str(file), **source}
    return parse({"name": "replay", "seed": 3, "cameras": CAMERAS, "source": section}, file.parent / "r.yaml")


def camera_of(scenario) -> Camera:
    """That of cam01."""
    (camera,) = build_cameras(scenario, source_config(scenario), ["cam01"])
    return camera


def sent_by(scenario, cameras=None, seconds=None, take=None, after_s: float = 0.0) -> list[pb.PushRequest]:
    """What a node sends until it ends by itself (or after some seconds); ``take`` answers, after a while."""
    got: list[pb.PushRequest] = []

    async def respond(request: pb.PushRequest) -> pb.PushResponse:
        got.append(request)
        return await answer(after_s=after_s)(request) if take is None else take(request)

    async def scene() -> None:
        peer = await Peer(respond=respond).start()
        built = build_cameras(scenario, source_config(scenario), cameras or scenario.cameras)
        node = Node(scenario, built, NodeOptions(to=peer.address, transport=Transport(), seconds=seconds))
        await asyncio.wait_for(node.run(), 20)
        await peer.stop()

    asyncio.run(scene())
    return got


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A node's session, recorded at the edge's door: the file, and what was sent."""
    folder = tmp_path_factory.mktemp("session")
    recorder = Recorder(folder / "a.mcap", "test")
    ledger, cameras = Ledger(folder, "edge", "edge", 1), FrameBuffer(("cam01", "cam02"))
    ingest = Ingest(WallClock(), cameras, ["cam00"], ledger, lambda frame: None, recorder.frame)
    scenario = photo_scenario(write_photos(folder / "data", 24), 3, fps=25)
    sent = sent_by(scenario, seconds=1.5, take=ingest.take)
    recorder.close()
    assert not ingest.rejected and recorder.dropped == 0
    return folder / "a.mcap", sent


def said(request: pb.PushRequest) -> tuple:
    """Everything of a message that a replay repeats: pose and lens to the bit."""
    h = request.header
    parts = [part.SerializeToString(deterministic=True) for part in (h.pose, h.intrinsics)]
    depth = request.depth.SerializeToString(deterministic=True) if request.HasField("depth") else None
    return (*parts, h.codec, h.width, h.height, h.role, h.pose_gap_ns, request.payload, depth)


def by_camera(sent: list[pb.PushRequest]) -> dict[str, list[pb.PushRequest]]:
    return {name: [r for r in sent if r.header.camera_id == name] for name in ("cam00", "cam01", "cam02")}


@pytest.mark.parametrize("after_s", [0.0, 0.05], ids=["quick answers", "answers slower than frames"])
def test_replay_is_exact_to_the_message(session, after_s):
    file, sent = session
    shifts, found = set(), Session(file)
    assert found.cut is None and len(sent) > 60
    for camera, mine in by_camera(sent).items():
        assert [f.header for f in found.frames[camera]] == [r.header for r in mine]
    again = by_camera(sent_by(replay_scenario(file), after_s=after_s))
    for before, after in zip(by_camera(sent).values(), again.values()):
        assert [said(r) for r in after] == [said(r) for r in before]
        assert [r.header.sequence for r in after] == list(range(len(before)))
        shifts |= {b.header.generated_ns - a.header.generated_ns for a, b in zip(before, after)}
    assert len(shifts) == 1, "all cameras share the node's clock: every stamp is shifted by the same"


def test_cameras_may_be_renamed_or_wrong(session, tmp_path):
    file, _ = session
    scenario = replay_scenario(file, assignment={"cam00": "cam00", "cam01": "cam02", "cam02": "cam01"})
    recorded = Session(file)
    assert camera_of(scenario).capture(0).payload == recorded.payload(recorded.frames["cam02"][0])
    SessionWriter(tmp_path / "empty.mcap", {}).close({})
    for wrong, why in (
        (replay_scenario(file, assignment={"cam01": "nobody"}), r"no camera 'nobody'.*cam00"),
        (replay_scenario(tmp_path / "no.mcap"), r"source\.file: .*does not exist"),
        (replay_scenario(tmp_path / "empty.mcap"), "holds no frames"),
        (replay_scenario(file, effects={"exposure_drift": None}), "replayed as it was"),
    ):
        refused(ValueError, why, camera_of, wrong)


def recorded(camera: Camera, file: Path, stamps: list[tuple[str, int, int]]) -> list[pb.PushRequest]:
    """Frames of a camera, written to a session. stamps: of each, session, number, milliseconds."""
    writer, sent = SessionWriter(file, {}), []
    for k, (session, sequence, at_ms) in enumerate(stamps):
        shot, at_ns = camera.capture(k), at_ms * 1_000_000
        frame = Frame("cam01", session, sequence, at_ns, shot.pose, shot.intrinsics, "jpeg", shot.payload)
        sent.append(to_request(replace(frame, depth=shot.encoded_depth)))
        writer.frame(sent[-1], at_ns + 5)
    writer.close({})
    return sent


STAMPS = [("s", k, 100 * k + 1000) for k in range(4)]


def test_frames_that_do_not_follow_are_left_out_and_said(tmp_path, caplog):
    stamps = [("a", 0, 1000), ("a", 1, 2000), ("b", 0, 1500), ("b", 1, 3000)]
    recorded(depth_camera(1, 4), tmp_path / "a.mcap", stamps)
    scenario = replay_scenario(tmp_path / "a.mcap", assignment={"cam00": "x", "cam01": "cam01", "cam02": "y"})
    with caplog.at_level(logging.WARNING):
        camera = camera_of(scenario)
    assert "cam01: 1 frames do not follow the one before in time" in caplog.text
    assert "this node replays 1 of 3 cameras" in caplog.text
    schedule = camera.source.schedule(7)
    assert [schedule.due_ns(k) - 7 for k in range(3)] == [0, 10**9, 2 * 10**9] and schedule.next(2, 0) == (None, 0)


def test_cameras_that_are_not_replayed_are_not_waited_for(tmp_path):
    shot, writer = depth_camera(0, 1).capture(0), SessionWriter(tmp_path / "a.mcap", {})
    for name, at_ns in (("early", 1), ("cam01", 10**12)):
        frame = Frame(name, "s", 0, at_ns, shot.pose, shot.intrinsics, "jpeg", shot.payload)
        writer.frame(to_request(frame), at_ns)
    writer.close({})
    scenario = replay_scenario(tmp_path / "a.mcap", assignment={"cam00": "x", "cam02": "y"})
    assert camera_of(scenario).source.schedule(7).due_ns(0) == 7


def test_a_recorded_run_replays_with_its_depth(tmp_path):
    """As it came, also where it belongs to another instant; what shows a held-out camera sends none."""
    sent = recorded(depth_camera(2, 4, after_image_ns=-40_000_000), tmp_path / "a.mcap", STAMPS)
    scenario = replay_scenario(tmp_path / "a.mcap", assignment={"cam00": "x", "cam02": "y"})
    got = sent_by(scenario, ["cam01"])
    assert [said(request) for request in got] == [said(request) for request in sent]
    assert [request.HasField("depth") for request in got] == [True, False, True, False]
    scenario = replay_scenario(tmp_path / "a.mcap", assignment={"cam00": "cam01", "cam01": "x", "cam02": "y"})
    got = sent_by(scenario, ["cam00"])
    assert len(got) == 4 and not any(request.HasField("depth") for request in got)


@pytest.mark.stability
def test_depth_that_cannot_be_read_again_costs_only_the_depth(tmp_path):
    """The file is damaged after it was opened: within, checksums leave whole chunks out."""
    camera = depth_camera(1, 4)
    recorded(camera, tmp_path / "a.mcap", STAMPS[:2])
    replayed = camera_of(replay_scenario(tmp_path / "a.mcap", assignment={"cam00": "x", "cam02": "y"}))
    location = Session(tmp_path / "a.mcap").frames["cam01"][0].depth_location
    with (tmp_path / "a.mcap").open("r+b") as file:
        file.seek(location.offset + location.size // 2)
        file.write(b"\xff" * (location.size - location.size // 2))
    assert replayed.capture(0).payload == camera.capture(0).payload
    assert replayed.capture(0).encoded_depth is None and replayed.depth_failed == 1
