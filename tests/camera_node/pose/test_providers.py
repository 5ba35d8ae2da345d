"""Pairing instants with poses: nearest, interpolated, bounded."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.pose.pairing import PoseGapError, SampleBuffer
from camera_node.pose.providers import FixedPose, TrajectoryError, read_tum
from freshfield.geometry import Pose, so3_exp

MS = 1_000_000


def turn(angle: float, x: float = 0.0) -> Pose:
    m = np.eye(4)
    m[:3, :3] = so3_exp([0, 0, angle])
    m[0, 3] = x
    return Pose.from_matrix(m)


def track_of(times: list[int], poses: list[Pose], interpolate: bool = True) -> SampleBuffer[Pose]:
    track = SampleBuffer(Pose.interpolate if interpolate else None, 50 * MS)
    for t_ns, pose in zip(times, poses, strict=True):
        track.add(t_ns, pose)
    return track


def test_nearest_and_interpolated():
    times, poses = [0, 100 * MS, 130 * MS], [turn(0.0, 0), turn(1.0, 10), turn(1.0, 10)]
    nearest = track_of(times, poses, interpolate=False)
    assert nearest.at(40 * MS) == (poses[0], 40 * MS)
    assert nearest.at(70 * MS) == (poses[1], 30 * MS)
    between, gap_ns = track_of(times, poses).at(40 * MS)
    assert gap_ns == 40 * MS  # still the distance to the nearest sample
    np.testing.assert_allclose(between.matrix(), turn(0.4, 4).matrix(), atol=1e-12)


def test_beyond_the_bound_there_is_no_pose():
    track = track_of([0, 200 * MS], [turn(0), turn(1)])
    assert track.at(-50 * MS)[0] == turn(0) and track.at(250 * MS)[0] == turn(1)
    for t_ms in (-51, 100, 251):
        with pytest.raises(PoseGapError, match="nearest pose"):
            track.at(t_ms * MS)


def test_a_fixed_pose_has_no_gap():
    assert FixedPose(turn(0.3)).at(123) == (turn(0.3), 0)


def test_tum_files_keep_nanoseconds_and_put_w_first(tmp_path):
    file = tmp_path / "groundtruth.txt"
    file.write_text("# comment\n\n1305031102.175304 1 2 3 0 0 0.5 0.8660254\n1305031102.2 1,2,3,0,0,0,1\n")
    track = read_tum(file)
    exact, gap_ns = track.at(1305031102_175304000)
    assert gap_ns == 0 and read_tum(file, start_ns=1305031102_175304000).at(0) == (exact, 0)
    np.testing.assert_allclose(exact.matrix()[:3, :3], so3_exp([0, 0, np.pi / 3]), atol=1e-6)


def test_a_trajectory_may_have_one_sample(tmp_path):
    (tmp_path / "track.txt").write_text("2 1 2 3 0 0 0 1")
    assert read_tum(tmp_path / "track.txt").at(2_050 * MS)[0].translation_m == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "at least one sample"),
        ("1 2 3\n", ":1: expected t tx ty tz"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 zero\n", ":2: expected"),
        ("0 0 0 0 0 0 0 0\n", ":1: quaternion"),
        ("0 nan 0 0 0 0 0 1\n", ":1: expected"),
        ("1732600000000 0 0 0 0 0 0 1\n", ":1: the time 1.7.* milliseconds or nanoseconds"),
        ("0 0 0 0 0 0 0 1\n-1e300 0 0 0 0 0 0 1\n", ":2: the time -1e"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "times that increase"),
    ],
)
def test_bad_lines_are_named(tmp_path, text, message):
    file = tmp_path / "track.txt"
    file.write_text(text)
    with pytest.raises(TrajectoryError, match=message) as error:
        read_tum(file)
    assert str(file) in str(error.value)
