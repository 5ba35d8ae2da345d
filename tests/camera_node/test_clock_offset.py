"""The estimate of another machine's clock."""

import asyncio
from unittest.mock import AsyncMock

from hypothesis import given
from hypothesis import strategies as st

from camera_node import clock_offset
from camera_node.clock_offset import ClockSync, OffsetEstimator
from freshfield.clock import WallClock
from tests.support import refused

MS = 1_000_000

delays = st.tuples(st.integers(0, 200 * MS), st.integers(0, 5 * MS), st.integers(0, 200 * MS))


@given(offset=st.integers(-(10**18), 10**18), exchanges=st.lists(delays, min_size=1, max_size=40))
def test_the_true_offset_lies_within_the_bound(offset, exchanges):
    """Whatever the delays of both ways, the error is at most the bound: half the shortest round trip."""
    estimator, now = OffsetEstimator(drift_ppm=0.0), 10**18
    for there, thinking, back in exchanges:
        sent = now
        received = sent + there
        returned = received + thinking + back
        estimator.add(sent, received + offset, received + thinking + offset, returned)
        now = returned
    found = estimator.estimate(now)
    assert abs(found.offset_ns - offset) <= found.uncertainty_ns + 1
    assert found.uncertainty_ns <= min(a + b for a, _, b in exchanges[-16:]) // 2


def test_old_exchanges_lose_trust():
    estimator = OffsetEstimator(drift_ppm=50.0)
    estimator.add(0, 1 * MS, 1 * MS, 2 * MS)  # good, but then it grows old
    assert estimator.estimate(2 * MS).uncertainty_ns == MS
    assert estimator.estimate(2 * MS + 100 * 10**9).uncertainty_ns == MS + 5 * MS
    estimator.add(100 * 10**9, 100 * 10**9 + 9 * MS, 100 * 10**9 + 9 * MS, 100 * 10**9 + 4 * MS)
    assert estimator.estimate(100 * 10**9 + 4 * MS).offset_ns == 7 * MS


def test_the_best_of_the_last_sixteen_exchanges_counts():
    estimator = OffsetEstimator(drift_ppm=0.0)
    estimator.add(0, 5, 5, 0)  # none better: the way takes no time
    offsets = []
    for k in range(1, 17):
        estimator.add(100 * k, 100 * k + 12, 100 * k + 12, 100 * k + 10)
        offsets.append(estimator.estimate(100 * k + 10).offset_ns)
    assert offsets == [5] * 15 + [7]


def test_a_clock_that_stood_still_ends_what_was_known_of_it():
    """After a suspended machine wakes, the other clock is ahead by as long, however promptly it answered before."""
    estimator, slept = OffsetEstimator(), 20 * 10**9
    estimator.add(0, MS // 2, MS // 2, MS)
    estimator.add(100 * MS, 102 * MS + slept, 102 * MS + slept, 104 * MS)
    assert estimator.estimate(104 * MS).offset_ns == slept


def test_impossible_exchanges_are_ignored():
    estimator = OffsetEstimator()
    estimator.add(0, 0, 10, 5)  # the answer took longer to make than the whole exchange
    estimator.add(0, 10, 5, 20)  # answered before it was received
    for absurd in (-(2**63), 2**63 - 1):  # no frame's header has room for the offset
        estimator.add(10**18, absurd, absurd, 10**18 + 5)
    assert estimator.estimate(100) is None


def test_exchanges_follow_each_other_quickly_at_first_and_four_replace_an_old_peers_estimate(monkeypatch):
    """The peer fails once and comes back with a clock that is an hour ahead, answering late. What the old one answered,
    however promptly, says nothing about the new one's clock."""
    hour_ns, pauses, offsets = 3600 * 10**9, [], []
    sync = ClockSync(AsyncMock(), (), WallClock())

    async def exchanged(channel, metadata, clock, estimator, timeout_s) -> bool:
        number = len(pauses)
        ahead_ns, way_ns = (0, 10) if number < 5 else (hour_ns, 10**6)
        if number != 5:
            sent_ns = WallClock().now_ns() - way_ns
            received_ns = sent_ns + way_ns // 2 + ahead_ns
            estimator.add(sent_ns, received_ns, received_ns, sent_ns + way_ns)
        return number != 5

    async def pause(seconds: float) -> None:
        pauses.append(seconds)
        offsets.append(sync.offset().offset_ns)
        if len(pauses) == 11:
            raise asyncio.CancelledError

    monkeypatch.setattr(clock_offset, "exchange", exchanged)
    monkeypatch.setattr(clock_offset.asyncio, "sleep", pause)
    refused(asyncio.CancelledError, "", asyncio.run, sync.run())
    assert pauses == [0.05, 0.05, 0.05, 1.0, 1.0, 1.0, 0.05, 0.05, 0.05, 1.0, 1.0]
    assert offsets == [0] * 9 + [hour_ns] * 2
