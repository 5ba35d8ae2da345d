"""Pairing while samples still arrive: what is between two, what is refused, what is counted."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.pose.pairing import SampleBuffer, interpolate_joints, sort_samples
from camera_node.pose.providers import PoseGapError
from freshfield.geometry import Pose, so3_exp

MS = 1_000_000


def pose(turn, shift=(0.0, 0.0, 0.0)) -> Pose:
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = so3_exp(turn), shift
    return Pose.from_matrix(m)


def test_the_ends_of_an_interpolation_are_its_samples_and_tiny_turns_are_no_danger():
    for size in (0.0, 1e-300, 1e-9, 1e-4, 3.0):
        a, b = pose((0.3, 0, 0), (1, 2, 3)), pose((0.3 + size, 0, 0), (1.1, 2, 3))
        np.testing.assert_allclose(a.interpolate(b, 0.0).matrix(), a.matrix(), atol=1e-12)
        np.testing.assert_allclose(a.interpolate(b, 1.0).matrix(), b.matrix(), atol=1e-12)


def test_nearest_or_between_with_the_gap_and_a_bound_that_counts():
    joints = SampleBuffer(interpolate_joints, max_gap_ns=10 * MS)
    nearest = SampleBuffer(None, max_gap_ns=10 * MS)
    for t_ms in (0, 8, 16, 60, 68):
        for buffer in (joints, nearest):
            buffer.add(t_ms * MS, np.full(6, float(t_ms)))
    between, gap_ns = joints.at(10 * MS)
    assert between == pytest.approx(np.full(6, 10.0)) and gap_ns == 2 * MS
    assert nearest.at(10 * MS)[0][0] == 8 and nearest.at(13 * MS)[0][0] == 16
    with pytest.raises(PoseGapError, match=r"22\.0 ms away, more than 10 ms"):
        joints.at(38 * MS)
    assert joints.at(78 * MS)[0][0] == 68  # after the last: the last, not beyond it
    assert not joints.ready(69 * MS) and joints.ready(68 * MS)


def test_an_empty_buffer_says_so():
    with pytest.raises(PoseGapError, match="no pose yet"):
        SampleBuffer(Pose.interpolate).at(0)


def test_bounds_that_make_no_sense_are_refused():
    for wrong in ({"max_gap_ns": -1}, {"keep_ns": 0}, {"restart_after": 0}):
        with pytest.raises(ValueError, match="must be positive"):
            SampleBuffer(None, **wrong)


def test_tidy_sorts_and_keeps_the_first_of_a_stamp():
    times, values, counts = sort_samples([5, 1, 3, 3, 9], [np.array([float(k)]) for k in range(5)])
    assert times == [1, 3, 5, 9] and [v[0] for v in values] == [1, 2, 0, 4]
    assert (counts.duplicates, counts.reordered) == (1, 2)
