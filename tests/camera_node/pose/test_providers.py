"""Poses of a trajectory file."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.pose.providers import read_tum
from freshfield.geometry import so3_exp
from tests.camera_node.sources.datasets.photos import fails


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
