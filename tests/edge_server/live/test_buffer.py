from __future__ import annotations

import threading
import time
from collections.abc import Sequence

import pytest

from edge_server.live.buffer import MOST_UNSELECTED, FrameBuffer
from freshfield.frame import Frame
from tests.edge_server.frames import frame

MS = 1_000_000


def test_age_is_now_minus_generation_on_the_edges_clock():
    buffer = FrameBuffer(["cam01", "cam02"])
    buffer.put(frame(generated_ns=100 * MS, clock_offset_ns=-20 * MS), received_ns=150 * MS)
    assert buffer.ages_ms(200 * MS) == {"cam01": 120.0, "cam02": None}


@pytest.mark.parametrize(
    ("first_ms", "then_ms", "newest_is_first"),
    [
        (60, 30, True),  # overtaken on its way
        (400, 120, True),  # ahead of the edge's clock, within the tolerance
        (1300, 120, False),  # a frame from the future gives way to any
    ],
)
def test_which_of_two_frames_is_the_newest(first_ms, then_ms, newest_is_first):
    buffer = FrameBuffer(["cam01"])
    buffer.put(frame(sequence=2, generated_ns=first_ms * MS), 100 * MS)
    assert buffer.ages_ms(100 * MS) == {"cam01": 100.0 - first_ms}
    buffer.put(frame(sequence=1, generated_ns=then_ms * MS), 150 * MS)
    assert buffer.newest()["cam01"].sequence == (2 if newest_is_first else 1)
    assert (buffer.stale_on_arrival, buffer.arrivals) == (int(newest_is_first), 2)


def test_wait_returns_on_arrival_and_on_timeout():
    buffer = FrameBuffer(["cam01"])
    assert buffer.wait(0, 0.01) == 0
    threading.Timer(0.05, lambda: buffer.put(frame(), 0)).start()
    begun_s = time.monotonic()
    assert buffer.wait(0, 60.0) == 1
    assert time.monotonic() - begun_s < 30.0, "it slept on"


def _sequences(items: Sequence[Frame]) -> list[tuple[str, int]]:
    return [(item.camera, item.sequence) for item in items]


def test_every_frame_is_taken_once_and_the_oldest_make_room():
    buffer = FrameBuffer(["cam01", "cam02"])
    for sequence in range(2):  # nobody has asked for every frame yet
        buffer.put(frame("cam01", sequence=sequence, generated_ns=sequence * MS), sequence * MS)
    assert buffer.take(list(buffer.newest().values())) == (tuple(buffer.newest().values()), ())
    buffer.keep_every_frame(True)
    for sequence in range(2, 5):
        for k, camera in enumerate(("cam02", "cam01")):
            at = sequence * MS + k
            buffer.put(frame(camera, sequence=sequence, generated_ns=at), at)
    selected = [buffer.newest()["cam01"]]
    buffer.put(frame("cam01", sequence=5, generated_ns=9 * MS), 9 * MS)  # after the selection
    assert _sequences(buffer.take(selected)[1]) == [("cam01", 2), ("cam01", 3)]
    assert buffer.take(selected) == (tuple(selected), ())
    late = frame("cam01", sequence=1, generated_ns=MS)
    buffer.put(late, 10 * MS)  # overtaken on its way: it is evidence all the same
    buffer.put(frame("cam02", sequence=6, generated_ns=11 * MS), 11 * MS)
    both = list(buffer.newest().values())
    assert _sequences(buffer.take(both)[1]) == [("cam01", 1)]
    for sequence in range(20, 20 + MOST_UNSELECTED + 3):
        buffer.put(frame("cam01", sequence=sequence, generated_ns=sequence * MS), sequence * MS)
    assert buffer.shed == 3
    taken = _sequences(buffer.take([buffer.newest()["cam01"]])[1])
    assert taken == [("cam01", k) for k in range(23, 20 + MOST_UNSELECTED + 2)]
    buffer.keep_every_frame(True)  # as before
    for sequence in range(40, 42):
        buffer.put(frame("cam01", sequence=sequence, generated_ns=sequence * MS), sequence * MS)
    buffer.keep_every_frame(False)
    newest = tuple(buffer.newest().values())
    assert buffer.take(newest) == (newest, ()) and buffer.shed == 3


def test_frames_that_wait_for_the_first_take_are_not_shed():
    buffer = FrameBuffer(["cam01"])
    buffer.keep_every_frame(True)
    for sequence in range(MOST_UNSELECTED + 5):
        buffer.put(frame(sequence=sequence, generated_ns=sequence * MS), sequence * MS)
    assert buffer.shed == 0


def test_where_there_is_no_time_for_all_the_oldest_are_left_out_and_counted_once():
    buffer = FrameBuffer([f"cam{k:02d}" for k in range(4)])
    buffer.keep_every_frame(True)
    for sequence in range(3):
        for k, camera in enumerate(buffer.cameras):
            at = (10 * sequence + k) * MS
            buffer.put(frame(camera, sequence=sequence, generated_ns=at), at)
    used, others = buffer.take(list(buffer.newest().values()), most=6)
    assert _sequences(used) == [(camera, 2) for camera in buffer.cameras]
    assert _sequences(others) == [("cam02", 1), ("cam03", 1)]
    assert (buffer.shed, buffer.arrivals) == (6, 12)
    buffer.put(frame("cam00", sequence=3, generated_ns=30 * MS), 30 * MS)
    buffer.put(frame("cam01", sequence=3, generated_ns=31 * MS), 31 * MS)
    used, others = buffer.take(list(buffer.newest().values()), most=1)
    # What was taken before costs nothing; a camera's newest frame waits on.
    assert _sequences(used) == [("cam01", 3), ("cam02", 2), ("cam03", 2)] and others == ()
    assert (buffer.shed, buffer.held_back) == (6, 1)
    used, _ = buffer.take(list(buffer.newest().values()), most=1)
    assert len(used) == 4 and buffer.shed == 6
    buffer.put(frame("cam00", sequence=4, generated_ns=40 * MS), 40 * MS)
    buffer.take(list(buffer.newest().values()), most=0)
    assert buffer.held_back == 1
    buffer.keep_every_frame(False)
    buffer.take([])
    assert buffer.held_back == 0


def test_of_two_frames_of_one_instant_the_selected_one_comes_first():
    buffer = FrameBuffer(["cam01"])
    buffer.keep_every_frame(True)
    for sequence in range(3):  # the first is the newest, the others are no newer
        buffer.put(frame(sequence=sequence, generated_ns=MS), MS)
    assert _sequences(buffer.take(list(buffer.newest().values()), most=1)[0]) == [("cam01", 0)]


def test_of_equally_young_frames_those_of_who_has_waited_longest_are_taken():
    buffer = FrameBuffer([f"cam{k:02d}" for k in range(6)])
    buffer.keep_every_frame(True)
    seen = dict.fromkeys(buffer.cameras, 0)
    for sequence in range(12):
        for k, camera in enumerate(buffer.cameras):  # clocks that differ by less than a millisecond
            at_ns = 100 * sequence * MS + 7 * MS // 10 + k * MS // 10
            buffer.put(frame(camera, sequence=sequence, generated_ns=at_ns), at_ns)
        for item in buffer.take(list(buffer.newest().values()), most=2)[0]:
            seen[item.camera] += 1
    assert seen == dict.fromkeys(buffer.cameras, 4)


@pytest.mark.parametrize(("most", "taken"), [(1, ["cam03"]), (2, ["cam01", "cam03"]), (3, ["cam00", "cam01", "cam03"])])
def test_the_more_moves_before_a_camera_the_older_its_frame_may_be(most, taken):
    """By 28 ms for twice as much: 40 ms times the logarithm of 2. cam03, of which nothing is known, goes first."""
    moving = {"cam00": 0.1, "cam01": 0.2, "cam02": 0.2, "cam04": 0.0}
    buffer = FrameBuffer([*moving, "cam03"])
    buffer.keep_every_frame(True)
    for camera, lag_ms in {"cam00": 0, "cam01": 26, "cam02": 30, "cam03": 60, "cam04": 0}.items():
        buffer.put(frame(camera, generated_ns=(1000 - lag_ms) * MS), 1000 * MS)
    used, _ = buffer.take(list(buffer.newest().values()), most, moving)
    assert sorted(item.camera for item in used) == taken


def test_a_camera_goes_first_in_the_seventeenth_take_after_its_last():
    """It waits for sixteen takes, and no longer."""
    buffer = FrameBuffer(["cam00", "cam01"])
    buffer.keep_every_frame(True)
    buffer.put(frame("cam00", generated_ns=0), 0)
    assert _sequences(buffer.take(list(buffer.newest().values()), most=1)[0]) == [("cam00", 0)]
    served = []
    for take in range(2, 20):
        at_ns = 100 * take * MS
        buffer.put(frame("cam01", sequence=take, generated_ns=at_ns), at_ns)
        buffer.put(frame("cam00", sequence=take, generated_ns=at_ns - 50 * MS), at_ns)  # always older
        used, _ = buffer.take(list(buffer.newest().values()), most=1)
        served += [(take, item.camera) for item in used if item.sequence == take]
    assert served == [(take, "cam00" if take == 18 else "cam01") for take in range(2, 20)]
