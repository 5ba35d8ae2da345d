import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.simulated_controller.controller import HOME_RAD, STEP_NS, Controller
from camera_node.robot.simulated_controller.joint_motion import MAX_ACCELERATION_RAD_S2, STEP_S, JointMotion

SPEED = np.array(UR3E.speed_rad_s)
angle = st.floats(-6.2, 6.2, allow_subnormal=False)
six = st.tuples(*[angle] * 6)
rates = st.floats(0.8, 20.0)


def run(motion, steps):
    """Positions, velocities and accelerations (steps, 6)."""
    rows = []
    for _ in range(steps):
        motion.step()
        rows.append((motion.q.copy(), motion.qd.copy(), motion.qdd.copy()))
    return [np.array(column) for column in zip(*rows)]


def until_idle(motion, most=10_000):
    rows = []
    for _ in range(most):
        if not motion.moving:
            return rows
        motion.step()
        rows.append((motion.q.copy(), motion.qd.copy()))
    raise AssertionError("never at rest")


@settings(max_examples=25)
@given(six, rates, rates)
def test_a_move_ends_exactly_at_its_target_within_its_limits(goal, speed, acceleration):
    motion = JointMotion(UR3E, HOME_RAD)
    assert motion.move(goal, speed, acceleration)
    rows = until_idle(motion)
    assert np.array_equal(motion.q, goal) and not motion.qd.any()
    if rows:
        velocities = np.array([np.zeros(6), *[qd for _, qd in rows]])
        assert np.all(np.abs(velocities) <= np.minimum(speed, SPEED) + 1e-9)
        assert np.abs(np.diff(velocities, axis=0)).max() <= acceleration * STEP_S + 1e-9
        positions = np.array([HOME_RAD, *[q for q, _ in rows]])
        assert np.abs(np.diff(positions, axis=0)).max() <= min(speed, SPEED.max()) * STEP_S + 1e-9


def test_a_move_that_interrupts_another_is_made_after_a_stop():
    motion = JointMotion(UR3E, HOME_RAD)
    motion.move(np.array(HOME_RAD) + 1.0, 1.0, 2.0)
    run(motion, 200)
    goal = np.array(HOME_RAD) - 0.5
    assert motion.move(goal, 1.0, 2.0)
    velocities = np.array([qd for _, qd in until_idle(motion)])
    assert np.array_equal(motion.q, goal)
    assert np.abs(np.diff(velocities, axis=0)).max() <= 10.0 * STEP_S + 1e-9
    motion.move(np.array(HOME_RAD), 1.0, 2.0)
    run(motion, 100)
    motion.move(goal, 1.0, 2.0)
    motion.stop()  # forgets what was to follow
    until_idle(motion)
    assert not np.allclose(motion.q, goal)


def test_all_joints_of_a_move_end_together():
    motion = JointMotion(UR3E, HOME_RAD)
    motion.move([1.0, -1.0, 0.0, -1.5, 1.0, 0.2], 0.7, 2.0)
    shares = [(q - HOME_RAD) / (motion.target - np.array(HOME_RAD)) for q, _ in until_idle(motion)]
    assert np.ptp(np.array(shares), axis=1).max() < 1e-9


@settings(max_examples=25)
@given(st.lists(st.tuples(six, st.integers(1, 60)), min_size=1, max_size=6))
def test_targets_that_jump_make_no_arm_that_jumps(targets):
    motion = JointMotion(UR3E, HOME_RAD)
    for goal, steps in targets:
        assert motion.servo(goal)
        q, qd, qdd = run(motion, steps)
        assert np.all(np.abs(qd) <= SPEED + 1e-9)
        assert np.abs(qdd).max() <= MAX_ACCELERATION_RAD_S2 + 1e-6
        assert np.isfinite(q).all()


def test_a_servo_target_is_reached_and_not_passed_by_much():
    motion = JointMotion(UR3E, HOME_RAD)
    goal = np.array(HOME_RAD) + 0.5
    for _ in range(400):
        motion.servo(goal)
        motion.step()
        assert np.max(motion.q - goal) < 2e-4
    assert np.abs(motion.q - goal).max() < 1e-5


def test_an_arm_whose_client_goes_quiet_comes_to_rest():
    motion = JointMotion(UR3E, HOME_RAD)
    motion.servo(np.array(HOME_RAD) + 3.0)
    _, qd, _ = run(motion, 600)
    assert np.abs(qd).max() > 1.0 and not qd[-1].any() and not motion.moving


def test_stopping_takes_the_time_that_its_deceleration_allows():
    motion = JointMotion(UR3E, HOME_RAD)
    motion.move(np.array(HOME_RAD) + 3.0, 1.0, 20.0)
    run(motion, 200)
    motion.stop(2.0)
    rows = until_idle(motion)
    assert abs(len(rows) * STEP_S - 0.5) < 2 * STEP_S


@pytest.mark.parametrize(
    "goal, speed, acceleration",
    [([7.0] * 6, 1, 1), ([math.nan] * 6, 1, 1), ([0.0] * 5, 1, 1), ([0.0] * 6, 0, 1), ([0.0] * 6, 1, -1)],
)
def test_what_cannot_be_done_is_refused(goal, speed, acceleration):
    motion = JointMotion(UR3E, HOME_RAD)
    assert not motion.move(goal, speed, acceleration) and not motion.moving


def test_the_truth_between_two_steps_and_the_same_again():
    def follow():
        arm = Controller(UR3E, start_ns=1_000, noise_rad=1e-3, seed=5)
        arm.motion.move([1.0, -1.0, 0.0, -1.5, 1.0, 0.2], 1.0, 2.0)
        seen = []
        arm.advance_to(1_000 + 200 * STEP_NS, lambda: seen.append(arm.values()["actual_q"]))
        return arm, np.array(seen)

    arm, seen = follow()
    assert np.array_equal(seen, follow()[1])
    t_ns, half = arm.true_joints(1_000 + 100 * STEP_NS + STEP_NS // 2)
    before, after = (arm.true_joints(1_000 + k * STEP_NS)[1] for k in (100, 101))
    assert t_ns == 1_000 + 100 * STEP_NS + STEP_NS // 2
    assert np.allclose(half, (before + after) / 2, atol=1e-15) and not np.array_equal(before, after)
    assert arm.true_joints(10**15)[0] == 1_000 + 200 * STEP_NS  # nobody knows the future
    noise = seen - np.array([arm.true_joints(1_000 + (k + 1) * STEP_NS)[1] for k in range(200)])
    assert 0.8e-3 < noise.std() < 1.2e-3


def test_a_long_standstill_of_the_machine_is_no_leap_of_the_arm():
    arm = Controller(UR3E, start_ns=0)
    arm.motion.move([1.0, -1.0, 0.0, -1.5, 1.0, 0.2], 0.1, 1.0)
    arm.advance_to(100 * STEP_NS)
    before = arm.motion.q.copy()
    arm.advance_to(3_600 * 10**9)
    assert np.array_equal(arm.motion.q, before)
    arm.advance_to(3_600 * 10**9 + 10 * STEP_NS)
    assert arm.motion.moving and np.abs(arm.motion.q - before).max() < 0.01
