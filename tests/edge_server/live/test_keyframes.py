"""Cameras that move: when one is seen to, and its earlier viewpoints."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge_server.fields import Budget, View
from edge_server.live.buffer import FrameBuffer
from edge_server.live.camera_motion import CameraMotion
from edge_server.live.field_updater import FieldUpdater
from edge_server.live.keyframes import Keyframes
from edge_server.scheduler import make_policy
from edge_server.settings import KeyframesConfig
from freshfield.geometry import Pinhole, Pose, look_at
from tests.edge_server.frames import CAMERA, frame, tiny_field

LENS = Pinhole.from_fov(8, 8, 60.0)


def view(camera, degrees, t_ms, radius_m=1.0, value=0):
    a = np.deg2rad(degrees)
    pose = look_at([radius_m * np.sin(a), -radius_m * np.cos(a), 0.5], [0, 0, 0])
    return View(camera, np.full((8, 8, 3), value, np.uint8), pose, LENS, t_ms * 1_000_000)


def names(views):
    return [v.camera for v in views]


def test_earlier_viewpoints_follow_the_newest_view_and_are_as_they_were():
    kept = Keyframes(KeyframesConfig(apart_m=0.1))
    first, second = view("hand", 0, 0, value=1), view("hand", 20, 1, value=2)
    kept.with_earlier([first])
    given = kept.with_earlier([second, view("still", 0, 1)])
    assert given[0] is second and names(given) == ["hand", "still", "hand#0"]
    earlier = given[2]
    assert earlier.image is first.image and earlier.generated_ns == 0
    assert np.array_equal(earlier.camera_to_world, first.camera_to_world)
    # The same objects come again, so that a field need not look at them again.
    assert kept.with_earlier([second])[1] is earlier


def test_a_place_seen_again_is_seen_anew():
    kept = Keyframes(KeyframesConfig(apart_m=0.1, apart_deg=8.0))
    for t_ms, degrees in enumerate((0, 20, 2)):  # the third is where the first was
        given = kept.with_earlier([view("hand", degrees, t_ms, value=t_ms)])
    assert names(given) == ["hand", "hand#1"] and len(kept) == 2
    assert [v.image[0, 0, 0] for v in kept.with_earlier([view("hand", 40, 3)])[1:]] == [2, 1]
    for degrees, places in ((7.9, 1), (8.1, 2)):
        kept = Keyframes(KeyframesConfig(apart_m=1.0, apart_deg=8.0))
        for t_ms, turned in enumerate((0, degrees)):
            kept.with_earlier([view("hand", turned, t_ms)])
        assert len(kept) == places


@pytest.mark.parametrize("step_deg", [0.3, 4.0])
def test_a_slow_camera_leaves_as_many_viewpoints_behind_as_a_fast_one(step_deg):
    kept = Keyframes(KeyframesConfig(most=48, apart_m=0.1, apart_deg=8.0))
    walked = [view("hand", degrees, t_ms) for t_ms, degrees in enumerate(np.arange(0.0, 120.0, step_deg))]
    for each in walked:
        given = kept.with_earlier([each])
    # A viewpoint each tenth of a meter or so, of the two meters walked.
    assert 15 <= len(kept) <= 21
    places = np.array([v.camera_to_world[:3, 3] for v in given])
    for each in walked:  # nothing that it passed is forgotten, the start neither
        assert np.linalg.norm(places - each.camera_to_world[:3, 3], axis=1).min() < 0.1
    # Back the same way: no more viewpoints, and every picture a newer one.
    for t_ms, each in enumerate(walked[::-1]):
        given = kept.with_earlier([replace(each, generated_ns=(1000 + t_ms) * 1_000_000)])
    assert len(kept) <= 21 and min(v.generated_ns for v in given) >= 1_000_000_000


def test_the_oldest_gives_way():
    kept = Keyframes(KeyframesConfig(most=3, apart_m=0.01))
    for t_ms in range(10):
        given = kept.with_earlier([view("hand", 15 * t_ms, t_ms)])
        assert len(kept) == min(3, t_ms + 1)
    assert sorted(v.generated_ns for v in given) == [7_000_000, 8_000_000, 9_000_000]
    kept.clear()
    assert len(kept.with_earlier([view("hand", 0, 11)])) == 1


def test_a_field_of_few_viewpoints_is_begun_anew_when_they_double_and_a_resumed_one_never():
    kept = Keyframes(KeyframesConfig())
    counts = (1, 1, 2, 3, 4, 4, 7, 9, 15, 16, 18, 40)
    assert [n for n in counts if kept.should_restart(n)] == [2, 4, 9, 18]
    kept.clear()
    assert [n for n in (1, 2) if kept.should_restart(n)] == [2]
    assert not any(Keyframes(KeyframesConfig(), resumed=True).should_restart(n) for n in counts)
    many = Keyframes(KeyframesConfig())  # a rig of twenty is no beginning
    assert not any(many.should_restart(n) for n in (20, 40, 80))


def test_updates_hand_them_to_the_field_and_report_frames_only():
    policy = make_policy("all", None, np.random.default_rng(0))
    u = FieldUpdater(FrameBuffer(["hand"]), policy, tiny_field(), 0, keyframes=Keyframes(KeyframesConfig()))
    given, fit, reset = [], u.field.fit, u.field.reset

    def watched(views, budget):
        given.append(names(views))
        return replace(fit(views, budget), refused=("hand#0", "hand"))

    u.field.fit = watched
    u.field.reset = lambda: given.append("reset") or reset()
    for k in range(3):
        assert names(_update(u, k)) == ["hand"]
    assert given == [["hand"], "reset", ["hand", "hand#0"], ["hand", "hand#0", "hand#1"]]
    u.reset()
    _update(u, 3)
    assert given[-2:] == ["reset", ["hand"]]


def _update(u, k):
    pose = Pose.from_matrix(view("", 30 * k, 0, radius_m=2.0).camera_to_world)
    u.buffer.put(frame("hand", sequence=k, generated_ns=k * 10**9, pose=pose), k * 10**9)
    views, report = u.fit(u.select(u.plan(k * 10**9), k * 10**9), Budget(steps=1))
    assert report.refused == ("hand",)  # without "hand#0", an earlier viewpoint
    return views


def placed(number: int, x_m: float = 0.0, turned_deg: float = 0.0, camera: str = "cam01") -> View:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", turned_deg, degrees=True).as_matrix()
    pose[0, 3] = x_m
    return View(camera, np.zeros((24, 32, 3), np.uint8), pose, CAMERA, number * 10**8)


def first_seen(places_m) -> int | None:
    """Number of the frame with which the camera is seen to move; its frames are taken at ``places_m``."""
    motion = CameraMotion()
    for number, x_m in enumerate(places_m):
        if motion.moving([placed(number, camera="cam00"), placed(number, x_m)]) is not None:
            return number
    return None


def test_a_camera_that_moves_on_is_seen_to_move_with_its_fifth_frame_and_a_slow_one_later():
    assert first_seen([0.0, 0.1, 0.2, 0.3, 0.4, 0.5]) == 4
    motion = CameraMotion()
    assert [motion.moving([placed(n, 0.0, 6.0 * n)]) for n in range(5)] == [None, None, None, None, "cam01"]
    assert first_seen([0.0] * 50 + [0.004 * k for k in range(60)]) == 50 + 18


def test_what_is_no_motion():
    for places_m in (
        [0.0] * 100,
        [0.0] * 20 + [0.5] * 200,  # knocked, or calibrated anew
        [0.0, 0.0, 9.0, 0.0, 0.0, 9.0, 0.0, 9.0, 0.0],  # single wrong poses
        [0.03 * (k % 2) for k in range(100)],
        np.random.default_rng(4).normal(0.0, 0.005, 2000),
    ):
        assert first_seen(places_m) is None


def test_a_frame_that_is_used_again_and_one_that_was_overtaken_do_not_count():
    motion = CameraMotion()
    assert motion.moving([placed(0)]) is None
    for number, x_m in ((5, 1.0), (5, 1.0), (3, 2.0), (5, 1.0), (1, 3.0), (6, 0.0)):
        assert motion.moving([placed(number, x_m)]) is None
