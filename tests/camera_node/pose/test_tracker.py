"""Poses of a trajectory file, whole or written while the camera runs."""

from __future__ import annotations

import os
import threading
import time

import numpy as np
import pytest

from camera_node.pose.pairing import PoseGapError
from camera_node.pose.providers import read_tum
from camera_node.pose.tracker import TrackerPoses
from freshfield.geometry import so3_exp
from tests.camera_node.sources.datasets.photos import fails

START_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000


def _line(k: int, x: float | None = None) -> str:
    t_ns = START_NS + k * STEP_NS
    return f"{t_ns // 10**9}.{t_ns % 10**9:09d} {k if x is None else x} 0 0 0 0 0 1\n"


def _written(file, text: str, mode: str = "a") -> None:
    with open(file, mode) as out:
        out.write(text)


def _x(poses: TrackerPoses, k: float, within_s: float = 5.0) -> float:
    """The position at step ``k``; a busy machine may be late."""
    until = time.monotonic() + within_s
    while True:
        try:
            return poses.at(START_NS + round(k * STEP_NS))[0].translation_m[0]
        except PoseGapError:
            if time.monotonic() > until:
                raise


@pytest.fixture
def followed(tmp_path):
    poses = TrackerPoses(tmp_path / "poses.txt")
    yield poses
    poses.close()


def test_a_file_is_followed_from_before_it_is_there_to_its_next_beginning(followed):
    with pytest.raises(PoseGapError, match=r"poses\.txt: there is no pose yet; its times are seconds since 1970"):
        followed.at(START_NS)
    _written(followed.path, _line(0) + _line(1)[:20])
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


def test_a_frame_waits_for_the_pose_that_is_computed_after_it(followed):
    _written(followed.path, _line(0))
    assert _x(followed, 0) == 0.0
    threading.Timer(0.03, _written, (followed.path, _line(1))).start()
    assert followed.at(START_NS + STEP_NS // 2)[0].translation_m[0] == pytest.approx(0.5)


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
    file.write_text("2 1 2 3 0 0 0 1")
    assert read_tum(file).at(2_050_000_000)[0].translation_m == (1.0, 2.0, 3.0), "one sample is enough"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "at least one sample"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 zero\n", ":2: expected t tx ty tz"),
        ("0 0 0 0 0 0 0 0\n", ":1: quaternion"),
        ("0 nan 0 0 0 0 0 1\n", ":1: expected"),
        ("0 0 0 0 0 0 0 1\n-1e300 0 0 0 0 0 0 1\n", ":2: the time -1e.* milliseconds or nanoseconds"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "times that increase"),
    ],
)
def test_bad_lines_are_named(tmp_path, text, message):
    file = tmp_path / "track.txt"
    file.write_text(text)
    fails(f"{file}.*{message}", read_tum, file)
