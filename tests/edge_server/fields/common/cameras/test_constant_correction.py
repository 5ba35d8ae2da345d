"""A mount that is off is told from a world that has moved and from errors of single poses."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields.common.cameras.constant_correction import constant_correction
from freshfield.geometry import look_at, se3, so3_exp


def arm_poses(count: int = 40) -> list[np.ndarray]:
    """A camera led around a target, now above it, now beside, and turned about its axis."""
    turns = np.linspace(0.0, 4.0, count)
    eyes = [[0.4 * np.cos(a), 0.4 * np.sin(a), 0.3 + 0.3 * np.sin(3 * a)] for a in turns]
    return [look_at(eye, [0, 0, 0]) @ se3(so3_exp([0, 0, 2 * a]), [0, 0, 0]) for eye, a in zip(eyes, turns)]


def small(rotation_deg: list[float], shift_mm: list[float]) -> np.ndarray:
    return se3(so3_exp(np.deg2rad(rotation_deg)), 1e-3 * np.array(shift_mm))


def test_the_mounts_error_is_found_though_the_world_moved_and_poses_scatter():
    rng, given = np.random.default_rng(3), arm_poses()
    mount, world = small([0.5, -0.3, 0.2], [4.0, -2.0, 6.0]), small([0.4, 0.1, -0.5], [-9.0, 3.0, 5.0])
    noise = [small(*rng.normal(scale=[[0.05], [0.5]], size=(2, 3))) for _ in given]
    found = constant_correction(given, [world @ pose @ mount @ error for pose, error in zip(given, noise)])
    assert found is not None
    assert found.rotation_deg == pytest.approx([0.5, -0.3, 0.2], abs=0.05)
    assert found.shift_mm == pytest.approx([4.0, -2.0, 6.0], abs=0.6)
    assert found.scatter_deg == pytest.approx(0.05 * 3**0.5, rel=0.2)
    assert found.scatter_mm == pytest.approx(0.5 * 3**0.5, rel=0.3)
    assert "in common 0.6" in found.words and found.words.endswith("hand-eye calibration is off")
    scattered = [small(*rng.normal(scale=[[0.3], [5.0]], size=(2, 3))) for _ in given]
    found = constant_correction(given, [pose @ error for pose, error in zip(given, scattered)])
    assert found is not None and "no sure part in common" in found.words


@pytest.mark.stability
def test_what_cannot_be_told_is_not_said():
    mount, turning = small([0.5, 0.0, 0.0], [5.0, 0.0, 0.0]), arm_poses()
    along = [se3(turning[0][:3, :3], [0.1 * k, 0.0, 0.0]) for k in range(20)]
    found = constant_correction(along, [pose @ mount for pose in along])
    assert found is not None and np.abs(found.rotation_deg).max() < 1e-3, "it has not turned: all is the world's"
    assert constant_correction(turning[:5], [pose @ mount for pose in turning[:5]]) is None, "too few"
    wrong = [*turning[:-1], np.full((4, 4), np.nan)]
    assert constant_correction(turning, wrong) is None


@pytest.mark.parametrize(
    ("rotation_deg", "shift_mm", "away_m"),
    [
        ([-2.85, 0.2, 0.14], [-36.4, -106.8, 67.9], 2.2),  # what a minute of `redkitchen` drifted by
        ([0.0, 2.0, 0.0], [69.8, 0.0, 0.0], None),  # they add up
        ([0.0, 2.0, 0.0], [0.0, 69.8, 0.0], None),  # the one has nothing to do with the other
        ([0.0, 2.0, 0.0], [-3.0, 0.0, 0.0], None),  # nothing is so near
    ],
)
def test_a_turn_and_a_shift_that_undo_each_other_do_not_accuse_the_mount(rotation_deg, shift_mm, away_m):
    mount, given = small(rotation_deg, shift_mm), arm_poses()
    found = constant_correction(given, [pose @ mount for pose in given])
    assert found is not None and found.sure is (away_m is None)
    assert found.cancels_m == (away_m and pytest.approx(away_m, abs=0.1))
