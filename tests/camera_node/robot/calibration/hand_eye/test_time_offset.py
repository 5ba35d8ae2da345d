"""The time offset between arm and camera, found from their motion, against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.calibrate import calibrate_tracks
from camera_node.robot.calibration.hand_eye.samples import distance_mm
from camera_node.robot.calibration.hand_eye.time_offset import calibrate_streams, coarse_offset
from camera_node.robot.calibration.inputs import Track
from freshfield.geometry import se3_inverse
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.known_truth import Sweep, streams

X = known_truth.CAMERA_IN_FLANGE


@pytest.mark.parametrize("offset_s", [0.0, 0.0371, -0.8, 1.7e9])
def test_any_offset_is_found_to_half_a_millisecond(offset_s):
    """Also one of decades: a controller's clock that counts from its start against UTC."""
    flange, target = streams(Sweep(0.15), 15.0, offset_s, np.random.default_rng(1))
    found = calibrate_streams(flange, target, EYE_IN_HAND)
    assert found.offset_s == pytest.approx(offset_s, abs=5e-4)
    assert abs(found.coarse_s - offset_s) < 0.01 and found.correlation > 0.98
    assert abs(found.offset_s - offset_s) < 4 * found.refined.offset_std_s
    assert found.refined.offset_std_s == pytest.approx(1e-4, rel=0.2)
    assert distance_mm(found.refined.x, X) < 1.0


def test_a_camera_that_stands_works_alike():
    flange, target = streams(Sweep(0.15), 15.0, 0.1, np.random.default_rng(2))
    held = Track(flange.times_ns, se3_inverse(flange.poses))
    found = calibrate_tracks(held, target, EYE_TO_HAND)
    assert found.time_offset_s == pytest.approx(0.1, abs=5e-4)
    assert distance_mm(found.transform, X) < 1.0


def test_gaps_are_left_out_and_counted():
    flange, target = streams(Sweep(0.15), 20.0, 0.25, np.random.default_rng(3))
    t_s = (flange.times_ns - flange.times_ns[0]) / 1e9
    kept = ~(((t_s > 4) & (t_s < 6)) | ((t_s > 11) & (t_s < 11.3)))
    found = calibrate_streams(Track(flange.times_ns[kept], flange.poses[kept]), target, EYE_IN_HAND)
    assert found.offset_s == pytest.approx(0.25, abs=5e-4)
    assert 25 <= found.unpaired <= 40  # 2.3 s at 15 a second, less what is within the bound
    # A target that is in sight for two fifths of the time only.
    seen = target.times_ns % 4_000_000_000 < 1_600_000_000
    offset_s, correlation = coarse_offset(flange, Track(target.times_ns[seen], target.poses[seen]))
    assert abs(offset_s - 0.25) < 0.01 and correlation > 0.9


def turning(angle_of, seconds=12.0) -> tuple[Track, Track]:
    """Streams of an arm that turns about one axis by ``angle_of`` the time."""
    out = []
    for rate in (125.0, 15.0):
        t_s = np.arange(0.2, seconds, 1 / rate)
        poses = np.tile(np.eye(4), (len(t_s), 1, 1))
        a = angle_of(t_s)
        poses[:, 0, 0] = poses[:, 1, 1] = np.cos(a)
        poses[:, 1, 0], poses[:, 0, 1] = np.sin(a), -np.sin(a)
        out.append(Track((t_s * 1e9).astype(np.int64), poses))
    return out[0], Track(out[1].times_ns, se3_inverse(out[1].poses))


@pytest.mark.parametrize(
    ("angle_of", "message"),
    [
        (lambda t: 0.0 * t, "hardly turns"),
        (lambda t: 0.7 * t, "do not turn alike at any time offset"),
        (lambda t: np.sin(2 * np.pi * t / 2.0), "repeats itself"),
        (lambda t: np.sin(1.1 * t) + np.sin(1.7 * t + 1), "parallel axes"),
    ],
)
def test_motion_that_does_not_tell_is_refused(angle_of, message):
    with pytest.raises(CalibrationError, match=message):
        calibrate_streams(*turning(angle_of), EYE_IN_HAND)


def test_streams_of_different_bodies_and_short_ones_are_refused():
    flange, _ = streams(Sweep(0.15), 20.0, 0.0, np.random.default_rng(4))
    t_s = (flange.times_ns / 1e9)[::8]
    other = Track(flange.times_ns[::8], known_truth.observed_targets(Sweep(0.05).flanges(t_s + 300.0)))
    with pytest.raises(CalibrationError, match=r"turn alike|does not settle|repeats"):
        calibrate_streams(flange, other, EYE_IN_HAND)
    with pytest.raises(CalibrationError, match="without gaps, at least 2 s"):
        coarse_offset(*streams(Sweep(0.15), 1.5, 0.0, np.random.default_rng(4)))
