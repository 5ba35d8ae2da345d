from __future__ import annotations

import numpy as np
import pytest

from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.teleop.settings import TeleopConfig
from camera_node.robot.teleop.teleoperator import commanded_twist, joint_speeds
from freshfield.geometry import se3, so3_exp
from tests.camera_node.robot.teleop.checks import HOME

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
