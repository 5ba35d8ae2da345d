"""Pairing while samples still arrive: in order or not, from clocks that are set, interpolated or nearest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.pose.pairing import PoseGapError, SampleBuffer, interpolate_joints
from freshfield.geometry import Pose, se3, so3_exp

MS = 1_000_000


def at(t_ms: float) -> Pose:
    turn = so3_exp([0.3 * np.sin(t_ms / 90), 0.5 * np.cos(t_ms / 70), t_ms / 200])
    return Pose.from_matrix(se3(turn, [np.sin(t_ms / 100), t_ms / 500, 0.2]))


def test_nearest_or_between_with_the_gap_and_a_bound_that_counts():
    joints = SampleBuffer(interpolate_joints, max_gap_ns=10 * MS)
    nearest = SampleBuffer(None, max_gap_ns=10 * MS)
    with pytest.raises(PoseGapError, match="no pose yet"):
        joints.at(0)
    for t_ms in (0, 8, 16, 60, 68):
        for buffer in (joints, nearest):
            buffer.add(t_ms * MS, np.full(6, float(t_ms)))
    between, gap_ns = joints.at(10 * MS)
    assert between == pytest.approx(np.full(6, 10.0)) and gap_ns == 2 * MS
    assert nearest.at(10 * MS)[0][0] == 8 and nearest.at(13 * MS)[0][0] == 16
    with pytest.raises(PoseGapError, match=r"22\.0 ms away, more than 10 ms"):
        joints.at(38 * MS)
    # Outside: the first or the last, not beyond it, as far as the bound itself.
    assert joints.at(78 * MS)[0][0] == 68 and joints.at(-10 * MS)[0][0] == 0
    for t_ms in (-11, 79):
        with pytest.raises(PoseGapError, match="nearest pose"):
            joints.at(t_ms * MS)
    assert not joints.ready(69 * MS) and joints.ready(68 * MS)
    for wrong in ({"max_gap_ns": -1}, {"keep_ns": 0}, {"restart_after": 0}):
        with pytest.raises(ValueError, match="must be positive"):
            SampleBuffer(None, **wrong)


def test_exactly_so_many_old_samples_restart_the_buffer():
    buffer = SampleBuffer[int](None, max_gap_ns=MS, keep_ns=100 * MS, restart_after=4)
    buffer.add(10**12, 0)
    assert not any(buffer.add(MS, 1) for _ in range(8)), "one sample, however often it comes"
    assert [buffer.add(k * MS, k) for k in range(3)] == [False] * 3
    assert buffer.at(10**12)[0] == 0, "one fewer does not"
    assert buffer.add(3 * MS, 3) and buffer.at(0)[0] == 0 and buffer.at(3 * MS)[0] == 3
    with pytest.raises(PoseGapError):
        buffer.at(10**12)


@pytest.mark.stability
@given(st.randoms(use_true_random=False), st.lists(st.integers(0, 400), min_size=1, max_size=40))
def test_the_order_and_the_number_of_arrivals_do_not_matter(random, stamps_ms):
    """Duplicated and shuffled, a stream pairs as its sorted self does."""
    sent = stamps_ms + random.sample(stamps_ms, len(stamps_ms) // 2)
    random.shuffle(sent)
    buffer, track = (SampleBuffer(Pose.interpolate, max_gap_ns=30 * MS) for _ in range(2))
    added = [buffer.add(t_ms * MS, at(t_ms)) for t_ms in sent]
    distinct = sorted(set(stamps_ms))
    assert sum(added) == len(distinct) and buffer.received == len(sent)
    for t_ms in distinct:
        track.add(t_ms * MS, at(t_ms))
    for t_ms in range(0, 400, 13):
        try:
            expected = track.at(t_ms * MS)
        except PoseGapError:
            with pytest.raises(PoseGapError):
                buffer.at(t_ms * MS)
        else:
            assert buffer.at(t_ms * MS) == expected


@pytest.mark.stability
@pytest.mark.parametrize("jump_ms", [-3_600_000, 10**12])
def test_a_clock_that_is_set_is_followed_and_one_wild_stamp_costs_a_few_samples(jump_ms):
    """A controller that restarts counts from its start again; one that is synchronised leaps."""
    buffer, lost = SampleBuffer(Pose.interpolate, max_gap_ns=20 * MS), 0
    for t_ms in range(0, 4000, 8):
        buffer.add((10**15 if t_ms == 2000 else t_ms) * MS, at(t_ms))
        try:
            buffer.at(t_ms * MS)
        except PoseGapError:
            lost += 1
    assert lost == 8
    for k, t_ms in enumerate(range(4000, 5000, 8)):
        buffer.add((t_ms + jump_ms) * MS, at(t_ms))
        assert k < 8 or buffer.at((t_ms + jump_ms) * MS)[0] == at(t_ms)


@pytest.mark.stability
def test_late_samples_in_disorder_restart_nothing_and_memory_is_bounded():
    buffer = SampleBuffer[float](None, keep_ns=100 * MS, restart_after=4)
    for t_ms in range(0, 10_000, 2):
        buffer.add(t_ms * MS, float(t_ms))
    assert len(buffer._times) <= 60
    for t_ms in (50, 40, 30, 20, 10, 0, 0, 0):
        assert not buffer.add(t_ms * MS, float(t_ms))
    assert buffer.at(9998 * MS)[0] == 9998
