from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.teleop.mapping import Mapping
from camera_node.robot.teleop.one_euro_filter import OneEuro
from camera_node.robot.teleop.settings import TeleopConfig
from camera_node.robot.teleop.stylus import StylusSample
from freshfield.geometry import so3_exp
from tests.camera_node.robot.teleop.checks import HOME, sample

HAND = UR3E.forward(HOME)
QUICK = TeleopConfig(filter_hz=1000.0)  # lets a sample pass at once, nearly
MS = 1_000_000


def settle(mapping: Mapping, position, first: int, quaternion=(1.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    for k in range(20):
        mapping.add_sample(StylusSample((first + k) * 10 * MS, position, quaternion, True), HAND)
    assert mapping.target is not None
    return mapping.target


def test_the_scaled_map():
    """(4.1), with axes turned by 90 degrees."""
    mapping = Mapping(dataclasses.replace(QUICK, scale=(2.0, 1.0, 0.5), yaw_deg=90.0))
    mapping.add_sample(sample(1, (0.3, 0.1, 0.2), clutch=False), HAND)
    settle(mapping, (0.3, 0.1, 0.2), 1)
    target = settle(mapping, (0.33, 0.11, 0.16), 100)
    expected = HAND[:3, 3] + np.array([2.0 * -0.01, 1.0 * 0.03, 0.5 * -0.04])
    assert target[:3, 3] == pytest.approx(expected, abs=1e-6)
    assert np.allclose(target[:3, :3], HAND[:3, :3])


def test_orientation_follows_about_the_bases_axes_or_not_at_all():
    small = (np.cos(0.1), 0.0, 0.0, np.sin(0.1))
    for follows in (True, False):
        mapping = Mapping(dataclasses.replace(QUICK, orientation=follows))
        mapping.add_sample(sample(1, clutch=False), HAND)
        settle(mapping, (0.0, 0.0, 0.0), 1)
        target = settle(mapping, (0.0, 0.0, 0.0), 100, small)
        turned = so3_exp([0.0, 0.0, 0.2]) if follows else np.eye(3)
        assert np.allclose(target[:3, :3], turned @ HAND[:3, :3], atol=1e-6)


def test_pressing_the_clutch_commands_no_motion_wherever_the_stylus_is():
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(1, (0.0, 0.0, 0.0), clutch=False), HAND)
    for k in range(2, 60):
        mapping.add_sample(sample(k * MS, (0.01 * k, 0.0, 0.0), clutch=False), HAND)
    assert mapping.target is None
    mapping.add_sample(sample(61 * MS, (0.6, 0.0, 0.0)), HAND)
    assert mapping.target is not None and np.allclose(mapping.target, HAND)


def test_a_clutch_held_from_the_beginning_does_nothing_until_it_was_let_go():
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(1), HAND)
    mapping.add_sample(sample(2), HAND)
    assert mapping.target is None
    mapping.add_sample(sample(3, clutch=False), HAND)
    mapping.add_sample(sample(4), HAND)
    assert mapping.target is not None


def test_a_stylus_found_elsewhere_is_anchored_anew():
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(1, clutch=False), HAND)
    settle(mapping, (0.0, 0.0, 0.0), 1)
    mapping.add_sample(sample(10_000 * MS, (0.5, 0.0, 0.0)), HAND)
    assert mapping.counts.jumps == 1
    assert np.allclose(mapping.target, HAND)


def test_silence_lets_go_and_asks_for_a_new_press_on_any_clock():
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(10**15, clutch=False), HAND)
    mapping.add_sample(sample(10**15 + 1), HAND)
    mapping.silence()
    mapping.silence()
    assert mapping.counts.silences == 1 and mapping.target is None
    assert mapping.add_sample(sample(5), HAND), "the stylus was started anew: its clock begins again"
    assert mapping.target is None
    mapping.add_sample(sample(6, clutch=False), HAND)
    mapping.add_sample(sample(7), HAND)
    assert mapping.target is not None


@pytest.mark.parametrize(
    "bad",
    [
        StylusSample(5, (np.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), True),
        StylusSample(5, (0.0, np.inf, 0.0), (1.0, 0.0, 0.0, 0.0), True),
        StylusSample(5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), True),
        StylusSample(5, (0.0, 0.0, 99.0), (1.0, 0.0, 0.0, 0.0), True),
        StylusSample(-5, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), True),
        StylusSample(2**70, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_what_is_no_pose_is_counted_and_changes_nothing(bad):
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(1, clutch=False), HAND)
    mapping.add_sample(sample(2), HAND)
    before = mapping.target.copy()
    assert not mapping.add_sample(bad, HAND)
    assert mapping.counts.unsound == 1 and np.array_equal(mapping.target, before)


def test_messages_from_the_past_are_counted_and_change_nothing():
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(100, clutch=False), HAND)
    assert not mapping.add_sample(sample(100), HAND) and not mapping.add_sample(sample(99), HAND)
    assert mapping.counts.backwards == 2 and mapping.target is None


def test_the_target_waits_at_the_wall():
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(1, clutch=False), HAND)
    for k in range(200):
        mapping.add_sample(sample((k + 1) * 10 * MS, (0.0, 0.01 * k, 0.0)), HAND)
    assert mapping.target[1, 3] == QUICK.workspace_high_m[1]


def test_the_filter_is_smooth_when_slow_and_quick_when_fast():
    rng = np.random.default_rng(0)
    still, turn = OneEuro(2.0, 20.0), np.array([1.0, 0.0, 0.0, 0.0])
    noise = rng.normal(0.0, 1e-4, (2000, 3))
    out = np.array([still(each, turn, 0.001)[0].copy() for each in noise])
    assert out[500:].std() < 0.35 * noise.std()
    fast, slow = OneEuro(2.0, 20.0), OneEuro(2.0, 0.0)
    for k in range(200):
        at = np.array([k * 0.001, 0.0, 0.0])  # 1 m/s
        lag_fast, lag_slow = at - fast(at, turn, 0.001)[0], at - slow(at, turn, 0.001)[0]
    assert lag_fast[0] < 0.2 * lag_slow[0]
