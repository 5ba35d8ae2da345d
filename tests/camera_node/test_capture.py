"""When captures are due; the cache and the outbox: bounded, and honest about every frame."""

import asyncio
from fractions import Fraction
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.capture import Camera, ShotCache, build_cameras, prepare
from camera_node.capture_schedule import OnceSchedule, PartialSchedule, RateSchedule
from camera_node.outbox import Outbox
from camera_node.settings import WorldConfig, source_config
from camera_node.sources.base import Shot
from freshfield import ledger
from freshfield.clock import VirtualClock
from freshfield.frame import Frame
from freshfield.geometry import Pinhole
from tests.camera_node.depth_source import LENS, POSE, DepthSource
from tests.camera_node.sources.datasets.photos import photo_scenario, write_photos
from tests.support import refused


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


def depth_camera(every: int, contents: int | None = None, cache: ShotCache | None = None, **depth) -> Camera:
    source = DepthSource("cam01", contents, **depth)
    return Camera(source, WorldConfig(kind="world"), cache or ShotCache(10**6), depth_every=every)


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
    assert record.getMessage().startswith("cam01: a frame without its depth: ") and message in record.getMessage()
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
