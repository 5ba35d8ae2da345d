"""A node as a whole, when its captures are due, its cache and outbox, honest about every frame, and its settings."""

import asyncio
import threading
from fractions import Fraction
from functools import partial
from itertools import pairwise
from pathlib import Path
from unittest.mock import AsyncMock, MagicMock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node import sender as sender_module
from camera_node.capture import Camera, ShotCache, build_cameras, prepare
from camera_node.capture_schedule import OnceSchedule, PartialSchedule, RateSchedule
from camera_node.cli import main
from camera_node.node import Node, NodeOptions
from camera_node.outbox import Outbox
from camera_node.sender import Sender
from camera_node.settings import CameraConfig, find_data, source_config
from camera_node.sources.base import Shot, Source
from freshfield import ledger
from freshfield.clock import VirtualClock
from freshfield.frame import Frame
from freshfield.geometry import Pinhole
from freshfield.scenario import ScenarioError, load, parse
from freshfield.transport import Transport
from freshfield.v1 import frames_pb2 as pb
from tests.camera_node.depth_source import LENS, POSE, DepthSource, depth_camera
from tests.camera_node.sources.datasets.photos import photo_scenario, write_photos
from tests.integration.peer import Peer, answer, wrong_number
from tests.support import refusal, refused, until

NOBODY = "127.0.0.1:1"


class Eye(Source):
    """A camera that takes a black picture, after ``until`` is set."""

    def __init__(self, camera: str, until: threading.Event | None = None) -> None:
        self.camera, self.fps, self.intrinsics, self._until = camera, Fraction(50), LENS, until

    def read(self, content: int) -> Shot:
        if self._until is not None:
            self._until.wait(10.0)
            raise ValueError("the camera is gone")
        return Shot(np.zeros((24, 32, 3), np.uint8), POSE, LENS)


def node_of(sources: list[Source], to: str = NOBODY, seconds: float | None = None) -> Node:
    cameras = [Camera(source, CameraConfig(kind="camera"), ShotCache(0)) for source in sources]
    return Node(load("room"), cameras, NodeOptions(to=to, transport=Transport(), seconds=seconds))


async def test_cameras_that_wait_for_their_devices_keep_no_other_waiting():
    gone = threading.Event()
    node = node_of([Eye("cam01", gone), Eye("cam02", gone), Eye("cam03")])
    running = asyncio.ensure_future(node.run())
    await until(lambda: node.outboxes and node.outboxes["cam03"].counts["captured"] >= 5, 8.0)
    waiting = gone.is_set() + sum(node.outboxes[name].counts["captured"] for name in ("cam01", "cam02"))
    gone.set()
    node.stop()
    await running
    assert waiting == 0


@pytest.mark.stability
async def test_frames_that_go_without_their_depth_are_counted():
    camera = Camera(DepthSource("cam01", 10, unit=2.0), CameraConfig(kind="camera"), ShotCache(10**6), depth_every=1)
    node = Node(load("room"), [camera], NodeOptions(to=NOBODY, transport=Transport(), seconds=0.5))
    await node.run()
    status = node.status()["cameras"]["cam01"]
    assert status["depth_failed"] == 10 and status["captured"] > 0 and status["failed"] == 0


@pytest.mark.parametrize(
    ("respond", "failure"),
    [
        (answer(pb.OUTCOME_DROPPED_BUSY), None),
        (answer(pb.OUTCOME_REJECTED, "lens"), "all frames were refused: lens "),
        (wrong_number, " answered no frame: answer to frame "),
    ],
)
async def test_the_end_says_if_no_frame_was_taken(respond, failure):
    peer = await Peer(respond=respond).start()
    node = node_of([Eye("cam01")], peer.address)
    running = asyncio.ensure_future(node.run())
    await peer.until(3)
    node.stop()
    await running
    await peer.stop()
    found = node.failure()
    assert found is failure if failure is None else failure in found


async def test_the_end_says_if_nothing_was_captured():
    gone = threading.Event()
    gone.set()
    node = node_of([Eye("cam01", gone)], seconds=0.3)
    await node.run()
    assert node.failure().startswith("no frame could be captured (")


async def test_a_fault_of_the_program_ends_the_node_and_is_told(monkeypatch):
    """A frame that is missing is counted; what should never happen is not passed over."""
    node = node_of([Eye("cam01"), Eye("cam02")], seconds=5.0)
    monkeypatch.setattr(node, "_frame", MagicMock(side_effect=ZeroDivisionError))
    with pytest.raises(ZeroDivisionError):
        await node.run()


async def test_the_time_allowed_for_an_answer_doubles_after_each_timeout_up_to_its_bound():
    outbox = Outbox("cam01", "s", None, VirtualClock(0))
    sender = Sender(outbox, MagicMock(), (), lambda: None, np.random.default_rng(0), {}, response_timeout_s=0.05)
    sender._patience_s = 0.01
    call, allowed_s = MagicMock(write=AsyncMock(), read=asyncio.Event().wait), []
    for _ in range(4):
        with pytest.raises(TimeoutError):
            await sender._exchange(call, Frame("cam01", "s", 0, 0, POSE, LENS, "jpeg", b""))
        allowed_s.append(sender._patience_s)
    assert allowed_s == [0.02, 0.04, 0.05, 0.05] and outbox.counts["broken"] == 4
    assert not sender.connected, "it never was"


async def test_an_answer_is_waited_for_eight_times_as_long_as_the_slowest_recent_one(monkeypatch):
    sender = Sender(Outbox("cam01", "s", None, VirtualClock(0)), MagicMock(), (), lambda: None, MagicMock(), {}, 60.0)
    call, allowed_s = MagicMock(write=AsyncMock(), read=AsyncMock(return_value=pb.PushResponse())), []
    for took_s in (0.1, 1.0, 0.5, 10.0):
        monkeypatch.setattr(sender_module, "time", MagicMock(monotonic=MagicMock(side_effect=[0.0, took_s])))
        await sender._exchange(call, Frame("cam01", "s", 0, 0, POSE, LENS, "jpeg", b""))
        allowed_s.append(sender._patience_s)
    assert allowed_s == pytest.approx([1.25, 8.0, 7.6, 60.0])


async def test_pauses_grow_until_a_session_has_worked(monkeypatch):
    outbox, failures = Outbox("cam01", "s", None, VirtualClock(0)), []
    sender = Sender(outbox, MagicMock(), (), lambda: None, MagicMock(), {})
    monkeypatch.setattr(sender_module, "backoff_s", lambda failed, *_: failures.append(failed) or 0.0)

    async def session():
        outbox.counts["sent"] += len(failures) == 2  # the third has worked for a while
        raise ZeroDivisionError if len(failures) == 4 else TimeoutError

    sender._session = session
    with pytest.raises(ZeroDivisionError):
        await sender.run()
    assert failures == [0, 1, 0, 1]


def test_a_node_that_reached_nobody_ends_with_1(capsys):
    assert main(["run", "tile", "--camera-index", "0", "--to", NOBODY, "--seconds", "0.2", "--quiet"]) == 1
    assert f"camera-node: {NOBODY} was never reached: " in capsys.readouterr().err


async def test_a_recording_that_waited_for_nobody_says_so(monkeypatch):
    monkeypatch.setattr(sender_module.tuned, "CONNECT_S", 0.1)
    eye = Eye("cam01")
    monkeypatch.setattr(eye, "schedule", partial(OnceSchedule, [0]))
    node = node_of([eye])
    running = asyncio.ensure_future(node.run())
    await until(lambda: node.senders and node.senders["cam01"].trouble, 8.0)
    node.stop()
    await running
    assert node.failure() == f"{NOBODY} was never reached: peer not reachable"


def test_the_cache_never_exceeds_its_bound_and_keeps_what_it_has():
    cache = ShotCache(100)
    shots = [Shot(bytes(30), POSE, LENS, 0) for _ in range(5)]
    for k in (0, 1, 2, 3, 4, 0):
        cache.put("a", k, shots[k])
    assert [cache.get("a", k) for k in range(5)] == [*shots[:3], None, None] and cache.bytes == 90
    assert cache.get("a", 1) is shots[1] and cache.get("b", 1) is None


@pytest.mark.parametrize(("cache", "cached"), [({}, 2), ({"cache_bytes": 2000}, 1), ({"cache_bytes": 0}, 0)])
def test_preparing_fills_what_fits_until_it_is_told_to_stop(tmp_path, cache, cached):
    scenario = photo_scenario(write_photos(tmp_path, 24), 3)
    cameras = build_cameras(scenario, source_config(scenario), scenario.cameras, **cache)
    asked = iter([False, False, True])
    prepare(cameras, lambda: next(asked))
    assert sum(cameras[0].cached(k) is not None for k in range(3)) == cached
    assert len(cameras[1].capture(5).payload) > 0  # with or without


@pytest.mark.parametrize(
    ("every", "contents", "ticks"),
    [(0, 12, []), (1, None, list(range(12))), (3, 12, [0, 2, 5, 7, 10]), (100, None, [0])],
)
def test_one_in_so_many_shots_brings_depth(every, contents, ticks):
    camera = depth_camera(every, contents)
    for _ in range(2):  # the second time from the cache, where shots repeat
        depths = {tick: camera.capture(tick).encoded_depth for tick in range(12)}
        assert [tick for tick, depth in depths.items() if depth is not None] == ticks
        assert all((depths[tick].decode().counts == tick + 1).all() for tick in ticks)


def test_depth_is_cached_encoded_and_its_bytes_count():
    cache = ShotCache(10**6)
    camera = depth_camera(5, 10, cache)
    prepare([camera], lambda: False)
    shots = [camera.cached(tick) for tick in range(10)]
    assert camera.capture(15).encoded_depth is shots[5].encoded_depth
    depths = [shot.encoded_depth.payload for shot in shots if shot.encoded_depth is not None]
    assert len(depths) == 2 and cache.bytes == sum(len(shot.payload) for shot in shots) + sum(map(len, depths))
    for room, fits in ((cache.bytes, True), (cache.bytes - len(depths[0]), False)):
        assert depth_camera(5, 10, ShotCache(room)).fits() == fits


@pytest.mark.stability
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"after_image_ns": 10**11}, "100 s after its image"),
        ({"intrinsics": Pinhole.from_fov(8, 8, 60)}, "a lens of"),
        ({"unit": float("nan")}, "nan m a count is not within"),
        ({"error": OSError("depth/007.png: no such file")}, "depth/007.png: no such file"),
        ({"error": KeyError("of a plug-in")}, "KeyError('of a plug-in')"),
    ],
)
def test_depth_that_cannot_be_sent_costs_only_the_depth(caplog, wrong, message):
    camera = depth_camera(1, **wrong)
    whole = depth_camera(1).capture(0)
    for tick in range(3):
        shot = camera.capture(tick)
        assert shot.encoded_depth is None and camera.depth_failed == tick + 1
        assert tick or shot.payload == whole.payload
    (record,) = caplog.records
    assert record.getMessage().startswith("cam01: frame sent without depth: ") and message in record.getMessage()
    unasked = depth_camera(0, **wrong)
    assert unasked.capture(0).encoded_depth is None and not unasked.depth_failed


def frame(sequence: int) -> Frame:
    return Frame("cam", "s", sequence, 0, POSE, LENS, "jpeg", b"")


async def test_the_outbox_keeps_the_newest_and_books_each_frame(tmp_path):
    book = ledger.Ledger(tmp_path, "node", "cam", 1)
    box = Outbox("cam", "s", book, VirtualClock(5))
    for k in range(4):
        box.put(frame(k))
    await box.wait_frame()
    assert box.take().sequence == 3 and box.waiting == 0
    refused(LookupError, "", box.take)
    box.record(3, "answered", "accepted")
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.02):
            await box.wait_frame()  # nothing waits any more
    box.put(frame(4))
    box.close()
    book.close(9)
    assert box.waiting == 1 and box.counts == {"captured": 5, "replaced": 3, "sent": 1, "accepted": 1}
    (file,) = ledger.read_all(tmp_path)
    written = [(e.event, e.sequence) for e in file.events if e.camera]
    assert written[-2:] == [("captured", 4), ("waiting", 4)]
    # At every prefix at most one frame waits: a kill between two lines leaves no frame unexplained.
    for end in range(len(written) + 1):
        seen = [name for name, _ in written[:end]]
        assert 0 <= seen.count("captured") - seen.count("replaced") - seen.count("sent") <= 1


NOW_NS = 1_763_000_000_123_456_789
TIMES = [0, 33_000_000, 66_000_001, 250_000_000]


def walk(schedule, now_ns, steps, late_ns=0):
    """RateSchedule and due times as a node makes them: each capture ends ``late_ns`` after it was due."""
    tick, out = schedule.first(now_ns), []
    missed = 0
    while tick is not None and len(out) < steps:
        due_ns = schedule.due_ns(tick)
        out.append((tick, due_ns))
        tick, m = schedule.next(tick, due_ns + late_ns)
        missed += m
    return out, missed


@given(st.fractions(Fraction(1, 10), 200, max_denominator=1001), st.integers(0, 2**62), st.integers(0, 10**10))
def test_ticks_are_due_after_now_and_follow_each_other(fps, now_ns, phase_ns):
    schedule = RateSchedule(fps, phase_ns)
    found, missed = walk(schedule, now_ns, 5)
    assert found[0][1] > now_ns >= schedule.due_ns(found[0][0] - 1) and missed == 0 and schedule.due_ns(0) == phase_ns
    assert [tick for tick, _ in found] == list(range(found[0][0], found[0][0] + 5))


def test_a_late_node_skips_to_the_newest_tick_but_plays_a_recording_once_whole():
    found, missed = walk(RateSchedule(Fraction(10)), NOW_NS, 3, late_ns=350_000_000)
    assert [b[0] - a[0] for a, b in pairwise(found)] == [3, 3] and missed == 6
    for late_ns in (0, 10**10):
        found, missed = walk(OnceSchedule(TIMES, NOW_NS), NOW_NS + 5, 10, late_ns)
        assert found == [(k, NOW_NS + t) for k, t in enumerate(TIMES)] and missed == 0


@given(st.integers(2, 9), st.integers(0, 2**60), st.integers(0, 10**9))
def test_captures_that_are_held_out_are_left_out_and_the_others_counted_without_a_gap(every, now_ns, late_ns):
    whole, part = RateSchedule(Fraction(10), 70_000_000), PartialSchedule(Fraction(10), 70_000_000, every)
    tick = part.first(now_ns)
    at = part.whole(tick)
    own = [whole.due_ns(k) for k in range(at - every, at + 2 * every + 12) if k % every]
    assert part.due_ns(tick) == min(due_ns for due_ns in own if due_ns > now_ns)
    later_ns = part.due_ns(tick) + late_ns
    after, missed = part.next(tick, later_ns)
    between = [due_ns for due_ns in own if part.due_ns(tick) < due_ns <= later_ns]
    assert after is not None and missed == max(0, len(between) - 1)
    assert part.due_ns(after) == (between[-1] if between else min(due_ns for due_ns in own if due_ns > later_ns))


def config(**source):
    return source_config(parse({"cameras": {"count": 2}, "source": source}, Path("s.yaml")))


def test_errors_name_file_and_key():
    for source, message in (
        ({"kind": "wrold"}, "source.kind: .*'wrold'"),
        ({"kind": "world", "fbs": 3}, "source.fbs: unknown key; did you mean 'fps'"),
        ({"kind": "transforms", "data": "x", "background": "keep"}, "use png"),
        ({"kind": "video", "data": "x", "trajectory": {"files": {}, "start_s": 1e300}}, "trajectory.start_s: expected"),
        ({"kind": "camera", "devices": {"cam1": 4}}, "source.devices.cam1: not a camera of this scenario"),
        ({"kind": "oak", "trajectory": {"files": {"cam1": "x"}}}, "trajectory.files.cam1: not a camera of this"),
        ({"kind": "world", "quality": 10**400}, "source.quality: expected .*1 to 100, got 10{99}"),
    ):
        assert str(refused(ScenarioError, message, config, **source)).startswith("s.yaml: source")


def test_data_is_found_below_the_folder_that_was_given(tmp_path, monkeypatch):
    scenario = parse({"cameras": {"count": 2}}, Path("s.yaml"))
    (tmp_path / "set").mkdir()
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    refused(ScenarioError, "none given: --data DIR or FRESHFIELD_DATA", find_data, "set", scenario, None)
    assert find_data("set", scenario, tmp_path) == tmp_path / "set"
    assert find_data(str(tmp_path / "set"), scenario, None) == tmp_path / "set"
    monkeypatch.setenv("FRESHFIELD_DATA", str(tmp_path))
    assert find_data("set", scenario, None) == tmp_path / "set"
    refused(ScenarioError, r"neither beside s.yaml nor in .*FRESHFIELD_DATA\)$", find_data, "a.json", scenario, None)
    film = parse({"cameras": {"count": 2}, "source": {"kind": "video"}}, Path("s.yaml"))
    refused(ScenarioError, "camera-node calibrate rig writes it$", find_data, "a.json", film, None)
    # What lies beside the scenario comes first.
    (tmp_path / "mine/set").mkdir(parents=True)
    mine = parse({"cameras": {"count": 2}}, tmp_path / "mine/s.yaml")
    assert find_data("set", mine, tmp_path) == tmp_path / "mine/set"


def test_mistakes_are_one_line_and_exit_code_2(capsys, tmp_path):
    (tmp_path / "bad.yaml").write_text("cameras: {count: 20}\nsource: {kind: world, scene: room}\n")
    for words, message in (
        (["room", "--camera", "cam01,cam77"], "has no camera cam77; it has cam00, "),
        (["room", "--camera-index", "13"], "--camera-index 13: expected 0 to 12"),
        (["room", "--all", "--to", "host:0"], "--to: expected HOST:PORT"),
        (["room", "--all", "--seconds", "nan"], "--seconds: expected"),
        ([tmp_path / "bad.yaml", "--all"], "bad.yaml: source: "),
    ):
        said = refusal(capsys, main, "run", *(() if "--to" in words else ("--to", "127.0.0.1:1")), *words)
        assert said.startswith("camera-node: ") and message in said
