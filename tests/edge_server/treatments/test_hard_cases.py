"""Whatever two frames a camera delivers, treatments return views that a field accepts, deterministically."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields.common.supervision import check_view
from edge_server.scheduler import TREATMENTS, make_policy
from freshfield.geometry import look_at
from tests.edge_server.treatments.pictures import HEIGHT, MS, POSE, WIDTH, picture, seen, view

every = pytest.mark.parametrize("name", TREATMENTS)
FRESH = seen(2000.0, "cam09")  # a young view, so that the others are stale


def treat(name: str, now, before, at_ms: float = 2000.0):
    """The treated view. The treatment must not change its arguments."""
    treatment = make_policy(name, None, np.random.default_rng(0)).treatment
    images = [v.image.copy() for v in (now, before) if v is not None]
    earlier = {} if before is None else {now.camera: before}
    out, beside = treatment.treat([now, FRESH], earlier, round(at_ms * MS))
    check_view(out)
    assert beside is FRESH and out.camera == now.camera and out.generated_ns == now.generated_ns
    assert all(np.array_equal(a, v.image) for a, v in zip(images, (now, before)))
    return out


@every
def test_one_frame_only(name):
    now = seen(60.0)
    assert treat(name, now, None) is now


@every
def test_identical_frames_are_left_as_they_are(name):
    now = view(picture(0.0), 60.0)
    out = treat(name, now, seen(0.0))
    assert out.image is now.image and out.weight is None


@every
@pytest.mark.parametrize("value", [0, 128, 255])
def test_constant_pictures(name, value):
    image = np.full((HEIGHT, WIDTH, 3), value, np.uint8)
    out = treat(name, view(image, 60.0), view(image.copy(), 0.0))
    assert out.image is not None and out.weight is None


@every
def test_a_light_that_goes_on_changes_everything(name):
    out = treat(name, view(np.full((HEIGHT, WIDTH, 3), 255, np.uint8), 60.0), view(picture(0.0) // 8, 0.0))
    assert out.weight is not None and out.weight.max() <= 1.0


@every
def test_random_pictures(name):
    rng = np.random.default_rng(3)
    a, b = rng.integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    treat(name, view(b, 60.0), view(a, 0.0))


@every
@pytest.mark.parametrize("age_ms", [1e9, 60.0, 0.0, -500.0])
def test_any_age(name, age_ms):
    now = seen(60.0)
    out = treat(name, now, seen(0.0), 60.0 + age_ms)
    if age_ms <= 0:
        assert out is now, "a picture from the future is not carried back"


@every
@pytest.mark.parametrize("gap_ms", [0.0, -40.0])
def test_frames_without_time_between_them_say_nothing_of_motion(name, gap_ms):
    now = view(picture(60.0), 60.0)
    assert treat(name, now, view(picture(0.0), 60.0 - gap_ms)) is now


@every
def test_a_gap_of_a_nanosecond_and_of_an_hour(name):
    now = seen(60.0)
    treat(name, now, replace(seen(0.0), generated_ns=now.generated_ns - 1))
    treat(name, now, replace(seen(0.0), generated_ns=now.generated_ns - 3600 * 10**9))


@every
def test_another_size_lens_or_pose_leaves_the_view_as_it_is(name):
    now, before = seen(60.0), seen(0.0)
    half = replace(before, image=before.image[::2, ::2], intrinsics=before.intrinsics.scaled(0.5))
    assert treat(name, now, half) is now
    zoomed = replace(before, intrinsics=replace(before.intrinsics, fx=200.0))
    assert treat(name, now, zoomed) is now
    moved = replace(before, camera_to_world=look_at([2.0, 0.1, 1.0], [0.0, 0.0, 0.0]))
    assert treat(name, now, moved) is now
    assert treat(name, now, replace(before, camera_to_world=POSE.copy())) is not now


@every
@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 7), (9, 200)])
def test_small_pictures(name, height, width):
    lens = replace(seen(0.0).intrinsics, width=width, height=height, cx=width / 2, cy=height / 2)
    rng = np.random.default_rng(1)
    a, b = (rng.integers(0, 2, (height, width, 3)).astype(np.uint8) * 255 for _ in range(2))
    treat(name, view(b, 60.0, intrinsics=lens), view(a, 0.0, intrinsics=lens))


@every
def test_one_result_whatever_the_threads(name):
    import cv2

    threads = cv2.getNumThreads()
    outs = []
    try:
        for count in (1, 4):
            cv2.setNumThreads(count)
            outs.append(treat(name, seen(60.0), seen(0.0)))
            assert cv2.getNumThreads() == count, "the process's own setting is put back"
    finally:
        cv2.setNumThreads(threads)
    assert np.array_equal(outs[0].image, outs[1].image) and np.array_equal(outs[0].weight, outs[1].weight)


def test_no_views_no_work():
    for name in TREATMENTS:
        assert make_policy(name, None, np.random.default_rng(0)).treatment.treat([], {}, 0) == []
