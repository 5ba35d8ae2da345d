"""From a stylus to a target of the flange, and from there to speeds of the joints."""

import msgspec
import numpy as np
import pytest

from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.teleop.mapping import Mapping
from camera_node.robot.teleop.one_euro_filter import OneEuro
from camera_node.robot.teleop.settings import TeleopConfig
from camera_node.robot.teleop.stylus import StylusSample
from camera_node.robot.teleop.teleoperator import commanded_twist, joint_speeds
from freshfield.geometry import se3, so3_exp
from tests.camera_node.robot.teleop.checks import HOME, sample

FLANGE = UR3E.forward(HOME)
QUICK = TeleopConfig(filter_hz=1000.0)  # lets a sample pass at once, nearly
MS = 1_000_000


def settle(mapping: Mapping, position, first: int, quaternion=(1.0, 0.0, 0.0, 0.0)) -> np.ndarray:
    for k in range(20):
        mapping.add_sample(StylusSample((first + k) * 10 * MS, position, quaternion, True), FLANGE)
    assert mapping.target is not None
    return mapping.target


def pressed(**changed) -> Mapping:
    """A mapping whose clutch has been let go once."""
    mapping = Mapping(msgspec.structs.replace(QUICK, **changed))
    mapping.add_sample(sample(1, (0.3, 0.1, 0.2), clutch=False), FLANGE)
    return mapping


@pytest.mark.parametrize("follows", [True, False])
def test_the_scaled_map_and_an_orientation_that_follows_or_not(follows):
    """(4.1), with axes turned by 90 degrees."""
    mapping = pressed(scale=(2.0, 1.0, 0.5), yaw_deg=90.0, orientation=follows)
    settle(mapping, (0.3, 0.1, 0.2), 1)
    target = settle(mapping, (0.33, 0.11, 0.16), 100, (np.cos(0.1), np.sin(0.1), 0.0, 0.0))
    expected = FLANGE[:3, 3] + np.array([2.0 * -0.01, 1.0 * 0.03, 0.5 * -0.04])
    assert target[:3, 3] == pytest.approx(expected, abs=1e-6)
    turned = so3_exp([0.0, 0.2, 0.0]) if follows else np.eye(3)
    assert np.allclose(target[:3, :3], turned @ FLANGE[:3, :3], atol=1e-6)


def test_pressing_the_clutch_commands_no_motion_wherever_the_stylus_is():
    mapping = Mapping(QUICK)
    mapping.add_sample(sample(1), FLANGE)
    assert mapping.target is None, "held from the beginning, it was never let go"
    for k in range(2, 60):
        mapping.add_sample(sample(k * MS, (0.01 * k, 0.0, 0.0), clutch=False), FLANGE)
    assert mapping.target is None
    mapping.add_sample(sample(61 * MS, (0.6, 0.0, 0.0)), FLANGE)
    assert mapping.target is not None and np.allclose(mapping.target, FLANGE)
    mapping.add_sample(sample(62 * MS, (0.0, 0.0, 0.0)), FLANGE)
    assert mapping.counts.jumps == 1 and np.allclose(mapping.target, FLANGE), "found elsewhere, it is anchored anew"


def test_silence_lets_go_and_asks_for_a_new_press_on_any_clock():
    mapping = pressed()
    mapping.add_sample(sample(10**15, (0.3, 0.1, 0.2)), FLANGE)
    mapping.silence()
    mapping.silence()
    assert mapping.counts.silences == 1 and mapping.target is None
    assert mapping.add_sample(sample(5), FLANGE), "the stylus was started anew: its clock begins again"
    assert mapping.target is None
    mapping.add_sample(sample(6, clutch=False), FLANGE)
    mapping.add_sample(sample(7), FLANGE)
    assert mapping.target is not None


@pytest.mark.parametrize(
    "change", [{"p": (np.nan, 0.0, 0.0)}, {"p": (0.0, 0.0, 10.1)}, {"q": (0.0, 0.0, 0.0, 0.0)}, {"t": -5}, {"t": 2**63}]
)
def test_what_is_no_pose_and_what_is_old_is_counted_and_changes_nothing(change):
    assert StylusSample(2**63 - 1, (0.0, 0.0, -10.0), (1.9, 0.0, 0.0, 0.0), True).is_valid()
    mapping = pressed()
    mapping.add_sample(sample(2, (0.3, 0.1, 0.2)), FLANGE)
    before = mapping.target.copy()
    bad = {"t": 5, "p": (0.0, 0.0, 0.0), "q": (1.0, 0.0, 0.0, 0.0), **change}
    assert not mapping.add_sample(StylusSample(bad["t"], bad["p"], bad["q"], True), FLANGE)
    assert mapping.counts.unsound == 1
    assert not mapping.add_sample(sample(2), FLANGE) and not mapping.add_sample(sample(1), FLANGE)
    assert mapping.counts.backwards == 2 and np.array_equal(mapping.target, before)


def test_the_target_waits_at_the_wall():
    mapping = Mapping(QUICK)
    for k in range(200):
        mapping.add_sample(sample((k + 1) * 10 * MS, (0.0, 0.01 * k, 0.0), k > 0), FLANGE)
    assert mapping.target[1, 3] == 0.45


@pytest.mark.parametrize("axis", np.eye(3))
def test_the_filter_follows_each_part_by_its_own_speed(axis):
    def share(hz: float) -> float:
        return 0.02 * np.pi * hz / (0.02 * np.pi * hz + 1.0)

    def turned(angle_rad: float) -> np.ndarray:
        return np.array([np.cos(angle_rad / 2), *np.sin(angle_rad / 2) * axis])

    filtered = OneEuro(2.0, 3.0)
    filtered(np.zeros(3), turned(0.5), 0.01)
    position, quaternion = filtered(0.02 * axis, turned(0.7), 0.01)  # 2 m/s, 20 rad/s
    assert position == pytest.approx(0.02 * share(2.0 + 3.0 * share(2.0) * 2.0) * axis)
    assert quaternion == pytest.approx(turned(0.5 + 0.2 * share(2.0 + 3.0 * share(2.0) * 20.0)))


CONFIG = TeleopConfig(gain_per_s=4.0, speed_m_s=0.2, speed_rad_s=6.0, acceleration_rad_s2=40.0)


def moved(q, shift, turn=(0.0, 0.0, 0.0)):
    """The flange's pose at ``q``, shifted and turned in the base's axes."""
    flange = UR3E.forward(q)
    return se3(so3_exp(turn) @ flange[:3, :3], flange[:3, 3] + shift)


def test_the_twist_is_in_proportion_to_the_distance_up_to_its_limit():
    near = commanded_twist(UR3E, CONFIG, HOME, moved(HOME, [0.01, 0.0, -0.02], [0.0, 0.03, 0.0]))
    np.testing.assert_allclose(near, [0.04, 0.0, -0.08, 0.0, 0.12, 0.0], atol=1e-9)
    far = commanded_twist(UR3E, CONFIG, HOME, moved(HOME, [0.3, 0.0, 0.4], [0.0, 0.5, 0.0]))
    np.testing.assert_allclose(far, [0.12, 0.0, 0.16, 0.0, 0.2, 0.0], atol=1e-9)  # all of it, to a tenth
    assert not commanded_twist(UR3E, CONFIG, HOME, UR3E.forward(HOME)).any()


@pytest.mark.parametrize("wrist", [np.pi / 2, 0.2, 0.05, 0.0])
def test_speeds_follow_the_twist_exactly_but_near_a_singularity(wrist):
    q = HOME.copy()
    q[4] = wrist
    target = moved(q, [0.01, 0.0, -0.02], [0.0, 0.03, 0.01])
    twist, jacobian = commanded_twist(UR3E, CONFIG, q, target), UR3E.jacobian(q)
    least = np.linalg.svd(jacobian)[1][-1]
    damping = 0.05 * (1.0 - (least / 0.08) ** 2) if least < 0.08 else 0.0
    expected = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping**2 * np.eye(6), twist)
    found = joint_speeds(UR3E, CONFIG, q, target)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert (damping > 0.0) == (wrist < 0.3) and np.abs(found).max() < 2.0
    slow = TeleopConfig(gain_per_s=4.0, speed_m_s=0.2, speed_rad_s=0.01, acceleration_rad_s2=2.0)
    np.testing.assert_allclose(joint_speeds(UR3E, slow, q, target), found * 0.01 / np.abs(found).max())
