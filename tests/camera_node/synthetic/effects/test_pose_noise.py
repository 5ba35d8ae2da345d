"""Poses err by the standard deviations asked for, per frame and per camera, and images do not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from camera_node.synthetic.effects.pose_noise import PoseNoise
from freshfield.geometry import Pose, look_at

POSE = Pose.from_matrix(look_at([1.0, -2.0, 1.5], [0.3, 0.2, 0.4]))
NONE = {"translation_mm": 0.0, "rotation_deg": 0.0}


def make(seed: int = 0, **parameters: float) -> PoseNoise:
    return PoseNoise(**{**NONE, **parameters}).start(np.random.default_rng(seed))


def errors(poses: list[Pose]) -> tuple[np.ndarray, np.ndarray]:
    """Translations (N, 3) in mm and rotation vectors (N, 3) in degrees, in camera axes."""
    true = POSE.matrix()
    moved = np.array([p.translation_m for p in poses]) - true[:3, 3]
    turned = Rotation.from_matrix([true[:3, :3].T @ p.matrix()[:3, :3] for p in poses]).as_rotvec()
    return 1e3 * moved, np.rad2deg(turned)


def test_the_noise_of_many_frames():
    noise = make(translation_mm=8.0, rotation_deg=0.5)
    moved, turned = errors([noise.reported(POSE, k, 0.0) for k in range(4000)])
    assert moved.std(axis=0) == pytest.approx([8.0] * 3, rel=0.04)
    assert turned.std(axis=0) == pytest.approx([0.5] * 3, rel=0.04)
    assert np.abs(moved.mean(axis=0)).max() < 0.5 and np.abs(turned.mean(axis=0)).max() < 0.03
    # White: one frame's error says nothing about the next one's, nor one axis about another.
    both = np.concatenate([moved, turned], axis=1)
    assert np.abs(np.corrcoef(both.T) - np.eye(6)).max() < 0.06
    assert max(abs(np.corrcoef(e[1:], e[:-1])[0, 1]) for e in both.T) < 0.06


def test_correlated_noise_is_as_large_and_smooth():
    noise = make(translation_mm=8.0, rotation_deg=0.5, correlation_s=2.0)
    moved, turned = errors([noise.reported(POSE, 0, 0.4 * k) for k in range(10_000)])
    assert moved.std(axis=0) == pytest.approx([8.0] * 3, rel=0.06)
    assert turned.std(axis=0) == pytest.approx([0.5] * 3, rel=0.06)
    for error in (moved / 8.0, turned / 0.5):
        far = [np.corrcoef(axis[15:], axis[:-15])[0, 1] for axis in error.T]
        assert np.abs(far).max() < 0.06, "after three times that time nothing is left"
    moved, turned = errors([noise.reported(POSE, 0, 0.1 * k) for k in range(4000)])
    for error in (moved / 8.0, turned / 0.5):
        assert np.abs(np.diff(error, axis=0)).max() < 0.6, "in a twentieth of the time"
    assert noise.reported(POSE, 5, 3.7) == noise.reported(POSE, 9, 3.7) != noise.reported(POSE, 5, 3.8)


def test_the_bias_is_a_camera_s_own_and_for_good():
    cameras = [make(k, translation_bias_mm=12.0, rotation_bias_deg=0.8) for k in range(2000)]
    assert not cameras[0].varies
    assert cameras[5].reported(POSE, 0, 0.0) == cameras[5].reported(POSE, 900, 60.0)
    moved, turned = errors([c.reported(POSE, 0, 0.0) for c in cameras])
    assert moved.std(axis=0) == pytest.approx([12.0] * 3, rel=0.05)
    assert turned.std(axis=0) == pytest.approx([0.8] * 3, rel=0.05)
