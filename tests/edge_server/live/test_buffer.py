import threading
import time
from collections import Counter
from collections.abc import Sequence

import pytest

from edge_server.live.buffer import FrameBuffer
from edge_server.live.live_constants import MOST_UNSELECTED
from freshfield.frame import Frame
from tests.edge_server.frames import frame

MS = 1_000_000


# Overtaken; of one instant; ahead of the edge's clock, within the tolerance; from the future, which gives way to any.
@pytest.mark.parametrize(
    ("first_ms", "then_ms", "newest_is_first"), [(60, 30, 1), (60, 60, 1), (400, 120, 1), (1300, 120, 0)]
)
def test_which_of_two_frames_is_the_newest(first_ms, then_ms, newest_is_first):
    buffer = FrameBuffer(["cam01"])
    buffer.put(frame(sequence=2, generated_ns=first_ms * MS), 100 * MS)
    assert buffer.ages_ms(100 * MS) == {"cam01": 100.0 - first_ms}
    buffer.put(frame(sequence=1, generated_ns=then_ms * MS), 150 * MS)
    assert buffer.newest()["cam01"].sequence == (2 if newest_is_first else 1)
    assert (buffer.stale_on_arrival, buffer.arrivals) == (newest_is_first, 2)


def test_wait_returns_on_arrival_and_on_timeout():
    buffer = FrameBuffer(["cam01"])
    assert buffer.wait(0, 0.01) == 0
    threading.Timer(0.05, lambda: buffer.put(frame(), 0)).start()
    begun_s = time.monotonic()
    assert buffer.wait(0, 60.0) == 1
    assert time.monotonic() - begun_s < 30.0, "it slept on"


def _sequences(items: Sequence[Frame]) -> list[tuple[str, int]]:
    return [(item.camera, item.sequence) for item in items]


def _keeping(*cameras: str) -> FrameBuffer:
    buffer = FrameBuffer(cameras)
    buffer.keep_every_frame(True)
    return buffer


def _put(buffer: FrameBuffer, camera: str, sequence: int, at_ms: float) -> None:
    """A frame that arrives as it is taken."""
    buffer.put(frame(camera, sequence, round(at_ms * MS)), round(at_ms * MS))


def _taken(buffer: FrameBuffer, most: int | None = None) -> list[list[tuple[str, int]]]:
    """What is taken of a selection of all newest frames, and further ones."""
    return [_sequences(items) for items in buffer.take(list(buffer.newest().values()), most)]


def test_every_frame_is_taken_once_and_the_oldest_make_room():
    buffer = FrameBuffer(["cam01", "cam02"])
    for sequence in range(2):  # nobody has asked for every frame yet
        _put(buffer, "cam01", sequence, sequence)
    assert _taken(buffer) == [[("cam01", 1)], []]
    buffer.keep_every_frame(True)
    for sequence in range(2, 5):
        for k, camera in enumerate(("cam02", "cam01")):
            _put(buffer, camera, sequence, sequence + 1e-6 * k)
    selected = [buffer.newest()["cam01"]]
    _put(buffer, "cam01", 5, 9)  # after the selection
    assert _sequences(buffer.take(selected)[1]) == [("cam01", 2), ("cam01", 3)]
    assert buffer.take(selected) == (tuple(selected), ())
    buffer.put(frame("cam01", 1, MS), 10 * MS)  # overtaken on its way: it is evidence all the same
    _put(buffer, "cam02", 6, 11)
    assert _taken(buffer)[1] == [("cam01", 1)]
    for sequence in range(20, 20 + MOST_UNSELECTED + 3):
        _put(buffer, "cam01", sequence, sequence)
    assert buffer.shed == 3
    taken = _sequences(buffer.take([buffer.newest()["cam01"]])[1])
    assert taken == [("cam01", k) for k in range(23, 20 + MOST_UNSELECTED + 2)]
    buffer.keep_every_frame(True)  # as before
    for sequence in range(40, 42):
        _put(buffer, "cam01", sequence, sequence)
    buffer.keep_every_frame(False)
    newest = tuple(buffer.newest().values())
    assert buffer.take(newest) == (newest, ()) and buffer.shed == 3


def test_frames_that_wait_for_the_first_take_are_not_shed():
    buffer = _keeping("cam01")
    for sequence in range(MOST_UNSELECTED + 5):
        _put(buffer, "cam01", sequence, sequence)
    assert buffer.shed == 0


def test_what_there_is_no_time_for_waits_behind_newer_frames_and_the_oldest_of_too_many_are_left_out():
    buffer = _keeping(*(f"cam{k:02d}" for k in range(4)))
    for sequence in range(3):
        for k, camera in enumerate(buffer.cameras):
            _put(buffer, camera, sequence, 10 * sequence + k)
    assert _taken(buffer, 6) == [[(camera, 2) for camera in buffer.cameras], [("cam02", 1), ("cam03", 1)]]
    assert (buffer.shed, buffer.held_back) == (0, 6)
    _put(buffer, "cam00", 3, 30)
    _put(buffer, "cam01", 3, 31)
    # What was taken before costs nothing; the newest frames go first, though others have waited.
    assert _taken(buffer, 2) == [[("cam00", 3), ("cam01", 3), ("cam02", 2), ("cam03", 2)], []]
    assert _taken(buffer, 4)[1] == [("cam02", 0), ("cam03", 0), ("cam00", 1), ("cam01", 1)]
    assert (buffer.shed, buffer.held_back) == (0, 2)
    for sequence in range(4, 4 + MOST_UNSELECTED - 1):
        _put(buffer, "cam00", sequence, 10 * sequence)
    assert (buffer.shed, MOST_UNSELECTED) == (0, 16)  # one has waited, fifteen are new
    _put(buffer, "cam00", 20, 200)
    # The oldest went; those that have waited come in the order in which they arrived.
    assert buffer.shed == 1 and _taken(buffer)[1] == [("cam01", 0), *[("cam00", sequence) for sequence in range(4, 19)]]
    _put(buffer, "cam00", 21, 210)
    _taken(buffer, 0)
    assert buffer.held_back == 1
    buffer.keep_every_frame(False)
    buffer.take([])
    assert buffer.held_back == 0


def test_frames_that_have_waited_keep_their_order_and_count_where_their_camera_is_not_selected():
    buffer = _keeping("cam01", "cam02")
    for camera in buffer.cameras:
        for sequence in range(4):
            _put(buffer, camera, sequence, sequence)
    newest = list(buffer.newest().values())
    assert len(buffer.take(newest, 2)[0]) == 2 and buffer.held_back == 6
    assert not buffer.take(newest[1:], 0)[1] and (buffer.held_back, buffer.shed) == (3, 3)  # less those of cam01
    _put(buffer, "cam02", 4, 4)
    selected = buffer.newest()["cam02"]
    for sequence in range(5, MOST_UNSELECTED + 3):  # arrive while the update is under way
        _put(buffer, "cam02", sequence, sequence)
    assert buffer.shed == 5  # cam02's oldest two
    assert buffer.take([selected], 0) == ((), ()) and (buffer.held_back, buffer.shed) == (2, 5)
    assert _taken(buffer)[1] == [("cam02", 2), *[("cam02", sequence) for sequence in range(4, MOST_UNSELECTED + 2)]]


def test_of_equally_young_frames_those_of_who_has_waited_longest_are_taken():
    buffer = _keeping(*(f"cam{k:02d}" for k in range(6)))
    seen = Counter()
    for sequence in range(12):
        for k, camera in enumerate(buffer.cameras):  # clocks that differ by less than a millisecond
            _put(buffer, camera, sequence, 100 * sequence + 0.7 + 0.1 * k)
        seen.update(camera for camera, _ in _taken(buffer, 2)[0])
    assert seen == dict.fromkeys(buffer.cameras, 4)


@pytest.mark.parametrize(("most", "taken"), [(1, ["cam03"]), (2, ["cam01", "cam03"]), (3, ["cam00", "cam01", "cam03"])])
def test_the_more_moves_before_a_camera_the_older_its_frame_may_be(most, taken):
    """By 28 ms for twice as much: 40 ms times the logarithm of 2. cam03, of which nothing is known, goes first."""
    moving = {"cam00": 0.1, "cam01": 0.2, "cam02": 0.2, "cam04": 0.0}
    buffer = _keeping(*moving, "cam03")
    for camera, lag_ms in {"cam00": 0, "cam01": 26, "cam02": 30, "cam03": 60, "cam04": 0}.items():
        buffer.put(frame(camera, generated_ns=(1000 - lag_ms) * MS), 1000 * MS)
    used, _ = buffer.take(list(buffer.newest().values()), most, moving)
    assert sorted(item.camera for item in used) == taken


def test_a_camera_goes_first_in_the_seventeenth_take_after_its_last():
    """It waits for sixteen takes, and no longer."""
    buffer = _keeping("cam00", "cam01")
    _put(buffer, "cam00", 0, 0)
    assert _taken(buffer, 1)[0] == [("cam00", 0)]
    served = []
    for take in range(2, 20):
        _put(buffer, "cam01", take, 100 * take)
        buffer.put(frame("cam00", take, (100 * take - 50) * MS), 100 * take * MS)  # always older
        served += [(take, camera) for camera, sequence in _taken(buffer, 1)[0] if sequence == take]
    assert served == [(take, "cam00" if take == 18 else "cam01") for take in range(2, 20)]
