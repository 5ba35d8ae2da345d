"""The real detectors on pictures that the project's own ray caster made, so that the true pose is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.samples import angle_deg
from camera_node.robot.calibration.targets import Corners, estimate_pose, parse_target
from freshfield.geometry import Pinhole, look_at, se3_inverse, so3_exp
from tests.camera_node.robot.calibration.rendered import render

LENS = Pinhole(400, 300, 330.0, 332.0, 203.0, 148.0, (-0.05, 0.02, 0.001, -0.001))
# Where a picture's own origin lies in its target's axes: a chessboard's is its first inner corner.
ORIGIN = {"chessboard": 2 * 0.02}
KINDS = ["charuco:7x5:24mm:18mm", "chessboard:7x4:20mm"]


def cameras(target) -> list[np.ndarray]:
    """Two cameras in the picture's axes (z into the paper), one of them upside down."""
    width, height = target.size_m
    middle = np.array([width / 2, height / 2, 0.0])
    out = []
    for x, y, z, roll in ((0.05, 0.08, -0.22, 0.4), (-0.07, 0.03, -0.20, 3.3)):
        camera = look_at(middle + np.array([x, y, z]), middle, up=(0.0, -1.0, 0.0))
        camera[:3, :3] = camera[:3, :3] @ so3_exp([0, 0, roll])
        out.append(camera)
    return out


@pytest.mark.parametrize("spec", KINDS)
def test_a_rendered_target_is_found_where_it_is(spec):
    target = parse_target(spec)
    for camera in cameras(target):
        picture = render(target, LENS, camera, 2)
        corners = target.find(picture)
        assert corners is not None
        found = estimate_pose(corners, LENS)
        truth = se3_inverse(camera)
        truth[:3, 3] += truth[:3, :3] @ ([ORIGIN.get(spec.split(":")[0], 0.0)] * 2 + [0.0])
        assert angle_deg(found, truth) < 0.1
        assert np.linalg.norm(found[:3, 3] - truth[:3, 3]) * 1e3 < 0.1


@pytest.mark.parametrize("spec", KINDS)
def test_nothing_is_found_where_nothing_is(spec):
    noise = np.random.default_rng(0).integers(0, 256, (120, 160)).astype(np.uint8)
    for picture in (np.zeros((120, 160), np.uint8), np.full((120, 160), 255, np.uint8), noise):
        assert parse_target(spec).find(picture) is None


@pytest.mark.parametrize("turn", [None, cv2.ROTATE_90_CLOCKWISE, cv2.ROTATE_180, cv2.ROTATE_90_COUNTERCLOCKWISE])
def test_a_chessboard_is_the_same_way_up_however_it_is_held(turn):
    """Its first corner stays the first: the picture is turned and the corners with it."""
    target = parse_target("chessboard:7x4:20mm")
    straight = cv2.GaussianBlur(target.draw(600), (0, 0), 1.0)
    first = target.find(straight).pixels[0]
    height, width = straight.shape
    if turn is None:
        picture, expected = straight, first
    else:
        picture = cv2.rotate(straight, turn)
        x, y = first
        expected = {
            cv2.ROTATE_90_CLOCKWISE: (height - y, x),
            cv2.ROTATE_180: (width - x, height - y),
            cv2.ROTATE_90_COUNTERCLOCKWISE: (y, width - x),
        }[turn]
    np.testing.assert_allclose(target.find(picture).pixels[0], expected, atol=0.1)


def test_a_small_tag_seen_straight_on_may_be_tilted_either_way():
    points = np.array([[0, 0, 0], [0.02, 0, 0], [0.02, 0.02, 0], [0, 0.02, 0]])
    pixels = LENS.project(points - [0.01, 0.01, -0.8])
    wobble = np.random.default_rng(0).normal(0, 0.05, pixels.shape)
    with pytest.raises(CalibrationError, match="tilted either way"):
        estimate_pose(Corners(pixels + wobble, points), LENS)


@pytest.mark.parametrize(
    ("spec", "why"),
    [
        ("circles:3x4", "no kind 'circles'"),
        ("charuco:7x5:20mm:30mm", "smaller than the squares"),
        ("charuco:7x5:30mm:20mm:9X9_50", "no dictionary 9X9_50"),
        ("chessboard:9x6:23.6", "needs a unit"),
        ("chessboard:8x6:20mm", "odd and the other even"),
        ("chessboard:9x6:90m", "not within"),
    ],
)
def test_specs_that_are_none_say_what_is_one(spec, why):
    with pytest.raises(CalibrationError, match=why) as error:
        parse_target(spec)
    assert "charuco:7x5:30mm:22mm" in str(error.value)
