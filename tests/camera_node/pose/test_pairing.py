"""Pairing while samples still arrive: what is between two, what is refused, what is counted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.pose.pairing import SampleBuffer, interpolate_joints, interpolate_screw, sort_samples
from camera_node.pose.providers import PoseGapError
from freshfield.geometry import Pose, so3_exp

MS = 1_000_000


def pose(turn, shift=(0.0, 0.0, 0.0)) -> Pose:
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = so3_exp(turn), shift
    return Pose.from_matrix(m)


def test_a_screw_keeps_what_is_mounted_on_the_hand_on_its_circle():
    """Half way through a quarter turn about z at (1, 0): the origin stays at distance 1, which a straight
    line between the ends does not."""
    a, b = pose((0, 0, 0)), pose((0, 0, np.pi / 2), (1.0, -1.0, 0.0))
    middle = np.array(interpolate_screw(a, b, 0.5).translation_m)
    assert np.linalg.norm(middle - [1, 0, 0]) == pytest.approx(1.0, abs=1e-12)
    line = np.array(Pose.interpolate(a, b, 0.5).translation_m)
    assert np.linalg.norm(line - [1, 0, 0]) == pytest.approx(np.sqrt(0.5), abs=1e-12)


@given(st.integers(0, 10**6), st.floats(0, 1))
def test_the_screw_is_the_constant_twist_between_its_ends(seed, fraction):
    rng = np.random.default_rng(seed)
    twist, shift = rng.normal(0, 0.5, 3), rng.normal(0, 1, 3)
    start = pose(rng.normal(0, 1, 3), rng.normal(0, 1, 3))
    # The reference: many small steps of the same twist.
    steps = 256
    small = np.eye(4)
    small[:3, :3], small[:3, 3] = so3_exp(twist / steps), so3_exp(twist / steps / 2) @ shift / steps
    power = [np.eye(4)]
    for _ in range(steps):
        power.append(power[-1] @ small)
    end = Pose.from_matrix(start.matrix() @ power[steps])
    at = round(fraction * steps)
    found = interpolate_screw(start, end, at / steps).matrix()
    np.testing.assert_allclose(found, start.matrix() @ power[at], atol=1e-9)


def test_the_ends_of_an_interpolation_are_its_samples_and_tiny_turns_are_no_danger():
    for size in (0.0, 1e-300, 1e-9, 1e-4, 3.0):
        a, b = pose((0.3, 0, 0), (1, 2, 3)), pose((0.3 + size, 0, 0), (1.1, 2, 3))
        for mix in (Pose.interpolate, interpolate_screw):
            np.testing.assert_allclose(mix(a, b, 0.0).matrix(), a.matrix(), atol=1e-12)
            np.testing.assert_allclose(mix(a, b, 1.0).matrix(), b.matrix(), atol=1e-12)


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
        SampleBuffer(interpolate_screw).at(0)


def test_bounds_that_make_no_sense_are_refused():
    for wrong in ({"max_gap_ns": -1}, {"keep_ns": 0}, {"restart_after": 0}):
        with pytest.raises(ValueError, match="must be positive"):
            SampleBuffer(None, **wrong)


def test_tidy_sorts_and_keeps_the_first_of_a_stamp():
    times, values, counts = sort_samples([5, 1, 3, 3, 9], [np.array([float(k)]) for k in range(5)])
    assert times == [1, 3, 5, 9] and [v[0] for v in values] == [1, 2, 0, 4]
    assert (counts.duplicates, counts.reordered) == (1, 2)
