"""A camera moves if it has left two places; noise, a wrong pose and a knock are no motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge_server.fields import View
from edge_server.live.camera_motion import CameraMotion, pose_distance
from tests.edge_server.frames import CAMERA


def view(number: int, x_m: float = 0.0, turned_deg: float = 0.0, camera: str = "cam01") -> View:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", turned_deg, degrees=True).as_matrix()
    pose[0, 3] = x_m
    return View(camera, np.zeros((24, 32, 3), np.uint8), pose, CAMERA, number * 10**8)


def first_seen(places_m) -> int | None:
    """Number of the frame with which the camera is seen to move; its frames are taken at ``places_m``."""
    motion = CameraMotion()
    for number, x_m in enumerate(places_m):
        if motion.moving([view(number, camera="cam00"), view(number, x_m)]) is not None:
            return number
    return None


def test_a_camera_that_moves_on_is_seen_to_move_with_its_fifth_frame():
    assert first_seen([0.0, 0.1, 0.2, 0.3, 0.4, 0.5]) == 4
    motion = CameraMotion()
    assert [motion.moving([view(n, 0.0, 6.0 * n)]) for n in range(5)] == [None, None, None, None, "cam01"]


def test_a_slow_camera_is_seen_too():
    assert first_seen([0.0] * 50 + [0.004 * k for k in range(60)]) == 50 + 18


@pytest.mark.parametrize(
    "places_m",
    [
        [0.0] * 100,
        [0.0] * 20 + [0.5] * 200,  # knocked, or calibrated anew
        [0.0, 0.0, 9.0, 0.0, 0.0, 9.0, 0.0, 9.0, 0.0],  # single wrong poses
        [0.03 * (k % 2) for k in range(100)],
        list(np.random.default_rng(4).normal(0.0, 0.005, 2000)),
    ],
)
def test_what_is_no_motion(places_m):
    assert first_seen(places_m) is None


def test_a_frame_that_is_used_again_and_one_that_was_overtaken_do_not_count():
    motion = CameraMotion()
    assert motion.moving([view(0)]) is None
    for number, x_m in ((5, 1.0), (5, 1.0), (3, 2.0), (5, 1.0), (1, 3.0), (6, 0.0)):
        assert motion.moving([view(number, x_m)]) is None


def test_the_distance_of_poses_is_in_meters_and_degrees():
    assert pose_distance(view(0).camera_to_world, view(1, 0.25, 30.0).camera_to_world) == pytest.approx((0.25, 30.0))
