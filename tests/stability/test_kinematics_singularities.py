"""Forward and inverse kinematics at and about singular postures, where an arm loses a direction of motion."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.robot.arm.kinematics import UR3E
from freshfield.geometry import so3_exp

DISTANCES = [0.0, 1e-300, 1e-16, 1e-12, 1e-10, 1e-9, 1e-8, 1e-6, 1e-4, 1e-2]
angles = st.floats(-math.pi, math.pi, allow_subnormal=False)


def check(q):
    """Every posture that is found reaches the target to a nanometer, and there is one."""
    target = UR3E.forward(q)
    found = UR3E.inverse(target, near=q)
    assert found
    for posture in found:
        assert np.isfinite(posture).all()
        assert np.abs(UR3E.forward(posture) - target).max() < 1e-7
    return found


@pytest.mark.parametrize("away", DISTANCES)
@pytest.mark.parametrize("straight", [0.0, math.pi])
def test_a_straight_wrist_keeps_joint_six(away, straight):
    q = np.array([0.4, -1.1, 1.3, -0.8, straight - away, 0.7])
    found = check(q)
    assert "wrist" in UR3E.singularities(found[0]) or away >= 0.1
    # Joint 6 is free there: it stays where it was, or is exact where it is not free.
    assert abs(found[0][5] - q[5]) < 1e-5


@pytest.mark.parametrize("away", DISTANCES)
def test_a_stretched_and_a_folded_elbow(away):
    for elbow in (away, -away, math.pi - away):
        found = check(np.array([0.4, -1.1, elbow, -0.8, 1.2, 0.7]))
        assert "elbow" in UR3E.singularities(found[0])


@pytest.mark.parametrize("away", DISTANCES)
def test_a_wrist_above_the_base(away):
    bend = np.array([0.4, 0.0, 1.3, -0.8, 1.2, 0.7])
    low, high = 0.0, math.pi  # the Jacobian's determinant changes its sign between the two
    sign = np.sign(np.linalg.det(UR3E.jacobian(bend)))
    for _ in range(80):
        bend[1] = 0.5 * (low + high)
        same = np.sign(np.linalg.det(UR3E.jacobian(bend))) == sign
        low, high = (bend[1], high) if same else (low, bend[1])
    bend[1] += away
    assert "shoulder" in UR3E.singularities(check(bend)[0])


def test_all_three_at_once():
    found = check(np.array([0.0, -math.pi / 2, 0.0, -math.pi / 2, 0.0, 0.0]))
    assert {"elbow", "wrist"} <= set(UR3E.singularities(found[0]))


@given(st.tuples(*[st.one_of(angles, st.sampled_from([0.0, math.pi, -math.pi / 2, 1e-9]))] * 6))
def test_whatever_the_posture_the_target_is_reached(q):
    check(np.array(q))


@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.lists(angles, min_size=3, max_size=3))
def test_whatever_the_target_postures_reach_it_or_are_none(where, turn):
    target = np.eye(4)
    target[:3, :3], target[:3, 3] = so3_exp(turn), where
    for posture in UR3E.inverse(target):
        assert np.abs(UR3E.forward(posture) - target).max() < 1e-7


def test_damped_steps_stay_small_next_to_a_singularity():
    """Refinement started in a singular posture neither divides by nothing nor runs away."""
    start = np.array([0.4, -1.1, 0.0, -0.8, 0.0, 0.7])
    goal = UR3E.forward(start + np.array([0.01, -0.01, 0.02, 0.01, 0.02, -0.01]))
    reached = UR3E.refine(goal, start)
    assert reached is not None and np.abs(reached - start).max() < 0.2
    assert UR3E.refine(np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) * 9.0, start) is None
