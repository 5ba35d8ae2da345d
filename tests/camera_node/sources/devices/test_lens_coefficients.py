import cv2
import numpy as np
import pytest

from camera_node.sources.devices.lens_coefficients import fit_opencv_distortion

K = [[500.0, 0.0, 320.5], [0.0, 505.0, 239.0], [0.0, 0.0, 1.0]]


def test_four_coefficients_stay_as_they_are():
    given = (-0.12, 0.03, 8e-4, -5e-4)
    lens, off_px = fit_opencv_distortion(640, 480, K, given)
    assert np.allclose(lens.distortion, given, atol=1e-6) and off_px < 1e-4
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (500.0, 505.0, 321.0, 239.5)  # our origin is the corner


@pytest.mark.parametrize("count", [5, 8, 12, 14])
def test_more_of_them_are_fitted_and_the_error_is_what_is_left(count):
    given = np.array([0.9, -0.3, 1e-4, 2e-4, 0.05, 0.85, -0.31, 0.02, 1e-4, 0, 0, 0, 0, 0])[:count]
    if count == 5:
        given = np.array([-0.1, 0.02, 1e-4, 2e-4, -0.01])
    lens, off_px = fit_opencv_distortion(640, 480, K, list(given))
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (500, 3)) * [1, 0.7, 0] + [0, 0, 1]
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.array(K), given)[0].reshape(-1, 2)
    inside = ((theirs > 0) & (theirs < [639, 479])).all(axis=1)
    ours = lens.project(points) - 0.5
    assert inside.sum() > 200
    assert np.abs(ours - theirs)[inside].max() <= off_px + 0.02 and off_px < 0.5


def test_a_straight_lens_has_none():
    lens, off_px = fit_opencv_distortion(640, 480, K, [])
    assert lens.distortion == (0.0, 0.0, 0.0, 0.0) and off_px < 1e-9
