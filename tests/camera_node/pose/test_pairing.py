"""Poses while samples still arrive: in order or not, from clocks that are set, from a file that is being written."""

import os
import threading
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.pose import tracker
from camera_node.pose.pairing import PoseGapError, SampleBuffer, interpolate_joints
from camera_node.pose.tracker import TrackerPoses
from camera_node.pose.trajectory_file import read_tum
from freshfield.geometry import Pose, se3, so3_exp
from tests.camera_node.sources.datasets.photos import fails
from tests.support import patiently, refused

MS = 1_000_000


def at(t_ms: float) -> Pose:
    turn = so3_exp([0.3 * np.sin(t_ms / 90), 0.5 * np.cos(t_ms / 70), t_ms / 200])
    return Pose.from_matrix(se3(turn, [np.sin(t_ms / 100), t_ms / 500, 0.2]))


def test_nearest_or_between_with_the_gap_and_a_bound_that_counts():
    joints = SampleBuffer(interpolate_joints, max_gap_ns=10 * MS)
    nearest = SampleBuffer(None, max_gap_ns=10 * MS)
    refused(PoseGapError, "no pose yet", joints.at, 0)
    for t_ms in (0, 8, 16, 60, 68):
        for buffer in (joints, nearest):
            buffer.add(t_ms * MS, np.full(6, float(t_ms)))
    between, gap_ns = joints.at(10 * MS)
    assert between == pytest.approx(np.full(6, 10.0)) and gap_ns == 2 * MS
    assert nearest.at(10 * MS)[0][0] == 8 and nearest.at(13 * MS)[0][0] == 16
    refused(PoseGapError, r"22\.0 ms away, more than 10 ms", joints.at, 38 * MS)
    # Outside: the first or the last, not beyond it, as far as the bound itself.
    assert joints.at(78 * MS)[0][0] == 68 and joints.at(-10 * MS)[0][0] == 0
    for t_ms in (-11, 79):
        refused(PoseGapError, "nearest pose", joints.at, t_ms * MS)
    assert not joints.ready(69 * MS) and joints.ready(68 * MS)


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
            refused(PoseGapError, "", buffer.at, t_ms * MS)
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


START_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000


def _line(k: int, x: float | None = None) -> str:
    t_ns = START_NS + k * STEP_NS
    return f"{t_ns // 10**9}.{t_ns % 10**9:09d} {k if x is None else x} 0 0 0 0 0 1\n"


def _written(file, text: str, mode: str = "a") -> None:
    with open(file, mode) as out:
        out.write(text)


def _x(poses: TrackerPoses, k: float) -> float:
    """The position at step ``k``."""
    return patiently(lambda: poses.at(START_NS + round(k * STEP_NS))[0].translation_m[0], PoseGapError)


@pytest.fixture
def followed(tmp_path):
    poses = TrackerPoses(tmp_path / "poses.txt")
    yield poses
    poses.close()


def test_a_file_is_followed_from_before_it_is_there_to_its_next_beginning(followed):
    refused(PoseGapError, r"poses\.txt: there is no pose yet; its times are seconds since 1970", followed.at, START_NS)
    _written(followed.path, "\ufeff" + _line(0) + _line(1)[:20])  # the mark that editors on Windows write
    assert _x(followed, 0) == 0.0
    _written(followed.path, _line(1)[20:] + _line(2))
    assert _x(followed, 1.25) == pytest.approx(1.25)
    _written(followed.path, _line(3), "w")  # shorter: the tracker began anew
    assert _x(followed, 3) == 3.0
    other = followed.path.with_suffix(".new")
    _written(other, _line(4) * 20)
    os.replace(other, followed.path)
    assert _x(followed, 4) == 4.0
    for k in (5, 6):  # in place, as long as before, then longer
        _written(followed.path, _line(k) * (15 + k), "r+")
        assert _x(followed, k) == k
    assert followed.refused == 0


def test_of_a_long_file_that_is_written_anew_with_each_pose_what_is_new_is_read(followed, monkeypatch):
    read, other = MagicMock(side_effect=tracker.read_sample), followed.path.with_suffix(".new")
    monkeypatch.setattr(tracker, "read_sample", read)
    for count in (5000, 5001):
        _written(other, "".join(map(_line, range(count))))
        os.replace(other, followed.path)
        assert _x(followed, count - 1) == count - 1
    assert read.call_count < 200 and followed.refused == 0


def test_a_frame_waits_for_the_pose_that_is_computed_after_it(followed):
    _written(followed.path, _line(0))
    assert _x(followed, 0) == 0.0
    threading.Timer(0.03, _written, (followed.path, _line(1))).start()
    assert followed.at(START_NS + STEP_NS // 2)[0].translation_m[0] == pytest.approx(0.5)


def test_poses_fit_frames_after_the_machine_was_suspended(followed):
    """The frames' clock stands still meanwhile, that of the tracker's stamps does not."""
    _written(followed.path, _line(0))
    assert _x(followed, 0) == 0.0
    followed._system = MagicMock(now_ns=lambda: followed._clock.now_ns() + 3000 * STEP_NS)
    _written(followed.path, _line(3001) + _line(3002))
    assert _x(followed, 1.5) == pytest.approx(3001.5, abs=0.1)


def test_a_named_pipe_is_read_from_one_writer_after_the_other(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    poses = TrackerPoses(tmp_path / "pipe")
    for k in range(2):
        writer = threading.Thread(target=_written, args=(poses.path, _line(k)))
        writer.start()
        assert _x(poses, k) == k
        writer.join(5.0)
    poses.close()
    assert not poses._thread.is_alive()


@pytest.mark.stability
def test_lines_that_are_no_pose_are_counted_and_cost_nothing_else(followed, caplog):
    bad = ["nan 0 0 0 0 0 0 1\n", f"{START_NS} 0 0 0 0 0 0 1\n", "1 2\n", "\xff" * 20 + "\n", "0 0 0 0 0 0 0 0\n"]
    _written(followed.path, "# t x y z\n" + "".join(bad) + "x" * 20_000 + "\n" + _line(0) + "\n" + _line(1))
    assert _x(followed, 1) == 1.0 and _x(followed, 0) == 0.0
    assert followed.refused == len(bad) + 1
    assert caplog.text.count("lines that are no pose are left out") == 1


def test_tum_files_keep_nanoseconds_and_put_w_first(tmp_path):
    file = tmp_path / "groundtruth.txt"
    file.write_text("# comment\n\n1305031102.175304 1 2 3 0 0 0.5 0.8660254\n1305031102.2 1,2,3,0,0,0,1\n")
    track = read_tum(file)
    exact, gap_ns = track.at(1305031102_175304000)
    assert gap_ns == 0 and read_tum(file, start_ns=1305031102_175304000).at(0) == (exact, 0)
    between, _ = track.at(1305031102_187652000)
    for pose, angle in ((exact, np.pi / 3), (between, np.pi / 6)):
        np.testing.assert_allclose(pose.matrix()[:3, :3], so3_exp([0, 0, angle]), atol=1e-6)
    file.write_text("\ufeff2 1 2 3 0 0 0 1")  # as editors on Windows write it
    assert read_tum(file).at(2_050_000_000)[0].translation_m == (1.0, 2.0, 3.0), "one sample is enough"


def test_bad_lines_are_named(tmp_path):
    for text, message in (
        ("", "at least one sample"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 zero\n", ":2: expected t tx ty tz"),
        ("0 0 0 0 0 0 0 1\n-1e300 0 0 0 0 0 0 1\n", ":2: the time -1e.* milliseconds or nanoseconds"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "times that increase"),
    ):
        file = tmp_path / "track.txt"
        file.write_text(text)
        fails(f"{file}.*{message}", read_tum, file)
