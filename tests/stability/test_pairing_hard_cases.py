"""Streams of poses as bad networks and restarting controllers deliver them, and rotations after a hundred
thousand steps: whatever comes, a pose is right, or refused and counted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.pose.pairing import SampleBuffer, sort_samples
from camera_node.pose.providers import PoseGapError, Trajectory
from freshfield.geometry import (
    Pose,
    matrix_to_quaternion,
    quaternion_multiply,
    quaternion_normalize,
    quaternion_to_matrix,
    so3_exp,
)

MS = 1_000_000


def at(t_ms: float) -> Pose:
    m = np.eye(4)
    m[:3, :3] = so3_exp([0.3 * np.sin(t_ms / 90), 0.5 * np.cos(t_ms / 70), t_ms / 200])
    m[:3, 3] = np.sin(t_ms / 100), t_ms / 500, 0.2
    return Pose.from_matrix(m)


@given(st.randoms(use_true_random=False), st.lists(st.integers(0, 400), min_size=1, max_size=40))
def test_the_order_and_the_number_of_arrivals_do_not_matter(random, stamps_ms):
    """Duplicated and shuffled, a stream pairs as its sorted self does."""
    sent = stamps_ms + random.sample(stamps_ms, len(stamps_ms) // 2)
    random.shuffle(sent)
    buffer = SampleBuffer(Pose.interpolate, max_gap_ns=30 * MS)
    for t_ms in sent:
        buffer.add(t_ms * MS, at(t_ms))
    distinct = sorted(set(stamps_ms))
    track = Trajectory([t * MS for t in distinct], [at(t) for t in distinct], max_gap_ns=30 * MS)
    for t_ms in range(0, 400, 13):
        try:
            expected = track.at(t_ms * MS)
        except PoseGapError:
            with pytest.raises(PoseGapError):
                buffer.at(t_ms * MS)
            continue
        assert buffer.at(t_ms * MS) == expected
    assert buffer.counts.duplicates == len(sent) - len(distinct)
    assert sort_samples([t * MS for t in sent], [at(t) for t in sent])[0] == [t * MS for t in distinct]


def test_a_hole_is_refused_and_counted_frame_by_frame():
    buffer = SampleBuffer(Pose.interpolate, max_gap_ns=20 * MS)
    for t_ms in [*range(0, 500, 8), *range(900, 1400, 8)]:
        buffer.add(t_ms * MS, at(t_ms))
    refused = 0
    for t_ms in range(0, 1400, 33):
        try:
            pose, gap_ns = buffer.at(t_ms * MS)
            assert gap_ns <= 20 * MS
            off = np.abs(pose.matrix() - at(t_ms).matrix()).max()
            assert off < 1e-3 or gap_ns > 4 * MS  # beside the hole: the last sample, as old as it says
        except PoseGapError:
            refused += 1
    assert refused == sum(516 < t < 880 for t in range(0, 1400, 33))


@pytest.mark.parametrize("jump_ms", [-3_600_000, 3_600_000, -(10**12), 10**12])
def test_a_clock_that_is_set_is_followed(jump_ms):
    """A controller that restarts counts from its start again; one that is synchronised leaps."""
    buffer = SampleBuffer(Pose.interpolate, max_gap_ns=20 * MS)
    for t_ms in range(0, 1000, 8):
        buffer.add(t_ms * MS, at(t_ms))
    for k, t_ms in enumerate(range(1000, 2000, 8)):
        buffer.add((t_ms + jump_ms) * MS, at(t_ms))
        if k >= 10:
            assert buffer.at((t_ms + jump_ms) * MS)[0] == at(t_ms)
    assert buffer.counts.restarts == (1 if jump_ms < 0 else 0)


def test_one_wild_stamp_costs_a_few_samples_and_no_more():
    buffer = SampleBuffer(Pose.interpolate, max_gap_ns=20 * MS)
    lost = 0
    for t_ms in range(0, 4000, 8):
        buffer.add((10**15 if t_ms == 2000 else t_ms) * MS, at(t_ms))
        try:
            buffer.at(t_ms * MS)
        except PoseGapError:
            lost += 1
    assert lost <= 8 and buffer.counts.restarts == 1


def test_late_samples_in_disorder_do_not_restart_anything():
    buffer = SampleBuffer[float](None, keep_ns=100 * MS, restart_after=4)
    for t_ms in range(0, 1000, 10):
        buffer.add(t_ms * MS, float(t_ms))
    for t_ms in (50, 40, 30, 20, 10, 0, 0, 0):
        assert not buffer.add(t_ms * MS, float(t_ms))
    assert buffer.counts.restarts == 0 and buffer.at(990 * MS)[0] == 990


def test_memory_is_bounded_however_long_it_runs():
    buffer = SampleBuffer[float](None, keep_ns=1000 * MS)
    for t_ms in range(0, 100_000, 2):
        buffer.add(t_ms * MS, 0.0)
    assert len(buffer._times) <= 600


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1.0, np.pi - 1e-9, np.pi, np.pi + 1e-9, 2 * np.pi - 1e-9])
def test_between_two_poses_however_far_apart(angle):
    """Up to and past half a turn, where the shorter way changes sides: always a rigid motion between them."""
    a, b = at(10), Pose.from_matrix(at(10).matrix() @ turn(angle))
    for fraction in (0.0, 1e-15, 0.3, 0.5, 1.0):
        middle = a.interpolate(b, fraction).matrix()
        assert np.isfinite(middle).all()
        np.testing.assert_allclose(middle[:3, :3] @ middle[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(a.interpolate(b, 1.0).matrix(), b.matrix(), atol=1e-7)


def turn(angle: float) -> np.ndarray:
    m = np.eye(4)
    m[:3, :3] = so3_exp(np.array([0.6, 0.0, 0.8]) * angle)
    m[:3, 3] = 0.1, 0.2, -0.1
    return m


def composed(steps: int, each: int) -> tuple[np.ndarray, float]:
    """The product of ``steps`` equal turns that end where they began, normalised at every ``each``-th, and
    the furthest that its length came from one."""
    # All turns are about one axis: after a whole number of rounds the product is the identity.
    angle = 2 * np.pi * 17 / steps
    step = matrix_to_quaternion(so3_exp(np.array([2, -3, 6]) / 7 * angle))
    q = np.array([1.0, 0.0, 0.0, 0.0])
    furthest = 0.0
    for k in range(steps):
        q = quaternion_multiply(q, step)
        if (k + 1) % each == 0:
            furthest = max(furthest, abs(float(np.linalg.norm(q)) - 1.0))
            q = quaternion_normalize(q)
    return quaternion_to_matrix(q), furthest


def test_unit_quaternions_after_a_hundred_thousand_compositions():
    end, furthest = composed(100_000, 10)
    assert furthest < 1e-14
    # Rounding of the step's angle adds up in proportion to the number of steps, and in nothing else: a tenth
    # of what a million may come to.
    np.testing.assert_allclose(end, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(end @ end.T, np.eye(3), atol=1e-14)
