"""Which frame a tick shows, and who gets which photo."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from camera_node.sources.datasets.records import Dataset, DatasetError, PosedImage
from camera_node.sources.datasets.streamer import Playback, Timeline, split_photos
from freshfield.geometry import Pinhole


def test_back_and_forth_and_restart_at_a_recordings_own_pace():
    there_and_back = Playback(4, Fraction(10), Fraction(10))
    assert [there_and_back.frame(k) for k in range(9)] == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    restart = Playback(4, Fraction(10), Fraction(10), back_and_forth=False)
    assert [restart.frame(k) for k in range(6)] == [0, 1, 2, 3, 0, 1]
    assert [Playback(1, Fraction(10), Fraction(30)).frame(k) for k in range(3)] == [0, 0, 0]
    assert [Playback(1000, Fraction(15), Fraction(60)).frame(k) for k in range(4)] == [0, 4, 8, 12]
    fast = Playback(1000, Fraction(60), Fraction(20))
    assert [fast.frame(k) for k in range(7)] == [0, 0, 1, 1, 1, 2, 2]  # the nearest, halves upwards


@given(
    count=st.integers(1, 500),
    fps=st.fractions(Fraction(1, 10), 200, max_denominator=1001),
    recorded=st.fractions(Fraction(1, 10), 200, max_denominator=1001),
    tick=st.integers(0, 10**12),
)
def test_frames_are_within_the_recording_and_never_jump(count, fps, recorded, tick):
    playback = Playback(count, fps, recorded)
    a, b = playback.frame(tick), playback.frame(tick + 1)
    assert 0 <= a < count and 0 <= b < count
    assert abs(a - b) <= recorded / fps + 1


@given(count=st.integers(1, 300), training=st.integers(1, 20), held_out=st.integers(0, 3))
def test_photos_are_dealt_once_and_every_eighth_is_held_out(count, training, held_out):
    names = [f"t{k}" for k in range(training)], [f"h{k}" for k in range(held_out)]
    try:
        shares = split_photos(count, *names)
    except DatasetError as error:
        assert "too few" in str(error)
        assert count < 8 * max(training, held_out) + 8
        return
    assert sorted(i for share in shares.values() for i in share) == list(range(count))
    for name, share in shares.items():
        if held_out:
            assert all((i % 8 == 0) == name.startswith("h") for i in share)
    of_training = [len(shares[n]) for n in names[0]]
    assert max(of_training) - min(of_training) <= 1


def test_own_test_images_go_to_held_out_cameras_and_to_nobody_else():
    assert split_photos(6, ["a", "b"], ["d"], [1, 4]) == {"d": [1, 4], "a": [0, 3], "b": [2, 5]}
    assert split_photos(6, ["a", "b"], [], [1, 4]) == {"a": [0, 3], "b": [2, 5]}


def recorded(**times: list[float]) -> Dataset:
    images = (
        PosedImage(f"{camera}{k}", camera, time_s, np.eye(4), Pinhole(8, 8, 8, 8, 4, 4), lambda: None)
        for camera, stamps in times.items()
        for k, time_s in enumerate(stamps)
    )
    return Dataset(tuple(images))


def test_a_timeline_holds_what_all_cameras_have_at_the_fastest_ones_rate():
    found = recorded(fast=[0.2, 0.3, 0.4, 0.6, 0.7, 0.8], slow=[0.0, 0.2, 0.4, 0.6], once=[5.0])
    timeline = Timeline.of(found, Path("set"))
    assert timeline == Timeline(0.2, 5, Fraction(10))
    assert list(timeline.nearest(found.of("fast"))) == [0, 1, 2, 2, 3]  # 0.5 s was dropped: the earlier of two
    assert list(timeline.nearest(found.of("slow"))) == [1, 1, 2, 2, 3]
    assert list(timeline.nearest(found.of("once"))) == [0] * 5
    assert list(Timeline(0.0, 0, Fraction(10)).nearest(found.of("slow"))) == [0, 1, 2, 3]
