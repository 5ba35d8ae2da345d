import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.simulated_controller.controller import HOME_RAD, STEP_NS, Controller
from camera_node.robot.simulated_controller.joint_motion import MAX_ACCELERATION_RAD_S2, STEP_S, JointMotion

SPEED = np.array(UR3E.speed_rad_s)
six = st.tuples(*[st.floats(-6.2, 6.2, allow_subnormal=False)] * 6)
rates = st.floats(0.8, 20.0)


def run(motion, steps=10_000):
    """Positions and velocities (N, 6) of at most so many steps, until the arm stands still."""
    rows = []
    while motion.moving and len(rows) < steps:
        motion.step()
        rows.append((motion.q.copy(), motion.qd.copy()))
    assert steps < 10_000 or not motion.moving, "never at rest"
    return np.array(rows).reshape(-1, 2, 6).swapaxes(0, 1)


@settings(max_examples=25)
@given(six, rates, rates)
def test_a_move_is_a_straight_line_that_ends_exactly_at_its_target_within_its_limits(goal, speed, acceleration):
    motion = JointMotion(UR3E, HOME_RAD)
    assert motion.move(goal, speed, acceleration)
    q, qd = run(motion)
    assert np.array_equal(motion.q, goal) and not motion.qd.any()
    assert np.all(np.abs(qd) <= np.minimum(speed, SPEED) + 1e-9)
    assert np.abs(np.diff(qd, axis=0, prepend=np.zeros((1, 6)))).max() <= acceleration * STEP_S + 1e-9
    way = np.array(goal) - HOME_RAD
    along = (q - HOME_RAD) @ way / (way @ way)
    np.testing.assert_allclose(q, HOME_RAD + along[:, None] * way, atol=1e-9)
    for wrong in (([7.0] * 6, 1, 1), ([math.nan] * 6, 1, 1), ([0.0] * 6, 0, 1), ([0.0] * 6, 1, -1)):
        assert not motion.move(*wrong) and not motion.moving


@settings(max_examples=25)
@given(st.lists(st.tuples(six, st.integers(1, 60)), min_size=1, max_size=6))
def test_targets_that_jump_make_no_arm_that_jumps(targets):
    motion, before = JointMotion(UR3E, HOME_RAD), np.zeros((1, 6))
    for goal, steps in targets:
        assert motion.servo(goal)
        q, qd = run(motion, steps)
        assert np.all(np.abs(qd) <= SPEED + 1e-9) and np.isfinite(q).all()
        assert np.abs(np.diff(qd, axis=0, prepend=before)).max() <= MAX_ACCELERATION_RAD_S2 * STEP_S + 1e-9
        before = qd[-1:]


def test_a_servo_target_is_reached_and_not_passed_by_much_and_a_quiet_client_ends_it():
    motion = JointMotion(UR3E, HOME_RAD)
    goal = np.array(HOME_RAD) + 0.5
    for _ in range(400):
        motion.servo(goal)
        motion.step()
        assert np.max(motion.q - goal) < 2e-4
    assert np.abs(motion.q - goal).max() < 1e-5
    motion.servo(goal + 3.0)
    _, qd = run(motion)
    assert np.abs(qd).max() > 1.0 and len(qd) * STEP_S < 0.9


def test_the_truth_between_two_steps_and_the_same_again():
    def follow():
        arm = Controller(UR3E, start_ns=1_000)
        arm.motion.move([1.0, -1.0, 0.0, -1.5, 1.0, 0.2], 1.0, 2.0)
        seen = []
        arm.advance_to(1_000 + 200 * STEP_NS, lambda: seen.append(arm.values()["actual_q"].copy()))
        return arm, np.array(seen)

    arm, seen = follow()
    assert np.array_equal(seen, follow()[1])
    t_ns, half = arm.true_joints(1_000 + 100 * STEP_NS + STEP_NS // 2)
    before, after = (arm.true_joints(1_000 + k * STEP_NS)[1] for k in (100, 101))
    assert t_ns == 1_000 + 100 * STEP_NS + STEP_NS // 2
    assert np.allclose(half, (before + after) / 2, atol=1e-15) and not np.array_equal(before, after)
    assert arm.true_joints(10**15)[0] == 1_000 + 200 * STEP_NS  # nobody knows the future
    assert np.array_equal(seen, [arm.true_joints(1_000 + (k + 1) * STEP_NS)[1] for k in range(200)])


def test_a_long_standstill_of_the_machine_is_no_leap_of_the_arm():
    arm = Controller(UR3E, start_ns=0)
    arm.motion.move([1.0, -1.0, 0.0, -1.5, 1.0, 0.2], 0.1, 1.0)
    arm.advance_to(100 * STEP_NS)
    before = arm.motion.q.copy()
    arm.advance_to(3_600 * 10**9)
    assert np.array_equal(arm.motion.q, before)
    arm.advance_to(3_600 * 10**9 + 10 * STEP_NS)
    assert arm.motion.moving and np.abs(arm.motion.q - before).max() < 0.01
