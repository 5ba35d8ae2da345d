"""The real client library against the simulated controller; a world camera in the hand of its arm."""

import dataclasses
import math
import socket
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from camera_node.capture import build_cameras
from camera_node.pose.providers import PoseGapError
from camera_node.robot.arm.camera_poses import base_matrix, load_hand_eyes
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.arm.rtde_process import VARIABLES
from camera_node.robot.flange_camera import TruthClient
from camera_node.robot.simulated_controller import rtde_protocol as rtde
from camera_node.robot.simulated_controller.controller import HOME_RAD, STEP_NS, Controller
from camera_node.robot.simulated_controller.joint_motion import STEP_S, JointMotion
from camera_node.settings import source_config
from camera_node.synthetic.depth import DepthRenderer
from freshfield import payload
from freshfield.clock import WallClock
from freshfield.scenario import Scenario, load
from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde, simulated_arm
from tests.support import patiently, refused, wait_until


@pytest.fixture(scope="module")
def arm():
    host = own_address()
    with simulated_arm(host):
        yield host


@pytest.fixture(scope="module")
def receive(arm):
    require_ur_rtde()
    from rtde_receive import RTDEReceiveInterface

    interface = RTDEReceiveInterface(arm, 500.0, VARIABLES)
    yield interface
    interface.disconnect()


@pytest.fixture(scope="module")
def control(arm, receive):
    from rtde_control import RTDEControlInterface

    interface = RTDEControlInterface(arm)
    yield interface
    interface.stopScript()


def _joints(receive) -> np.ndarray:
    """Joints of a state that was sent after the call."""
    for _ in range(2):
        stamp = receive.getTimestamp()
        wait_until(lambda stamp=stamp: receive.getTimestamp() != stamp, "no state for five seconds", 5.0)
    return np.array(receive.getActualQ())


def test_the_library_moves_stops_and_servos_the_arm(control, receive):
    goal = np.add(HOME_RAD, [0.2, 0.1, -0.1, 0.1, 0.0, 0.3])
    assert control.moveJ(goal.tolist(), 2.0, 8.0)
    assert np.allclose(_joints(receive), goal, atol=1e-9)
    assert control.moveJ(list(HOME_RAD), 1.0, 4.0, True)  # does not wait
    assert not np.allclose(receive.getActualQ(), HOME_RAD, atol=1e-3)
    control.stopJ(8.0)
    where = _joints(receive)
    time.sleep(0.02)
    assert np.array_equal(_joints(receive), where)
    for k in range(60):
        control.servoJ([where[0] + 0.001 * k, *where[1:]], 0.0, 0.0, 0.002, 0.1, 300)
        time.sleep(0.002)
    control.servoStop()
    assert abs(_joints(receive)[0] - where[0] - 0.059) < 0.01
    assert control.moveJ(goal.tolist(), 1.0, 4.0, True)
    assert control.moveJ(list(HOME_RAD), 2.0, 8.0)  # while the other is on its way
    assert np.allclose(_joints(receive), HOME_RAD, atol=1e-9)


@pytest.mark.parametrize("wrong", ["beyond", "not simulated", "kinematics", "watchdog"])
def test_what_it_cannot_do_stops_the_program_and_is_not_called_done(control, receive, wrong):
    """As a fault does on a real one."""
    before = receive.getActualQ()
    if wrong == "kinematics":
        refused(RuntimeError, "did not succeed", control.getForwardKinematics, before, [0.0] * 6)
        done = False
    elif wrong == "not simulated":
        done = control.moveL([0.2, 0.2, 0.2, 0.0, 3.0, 0.0], 0.1, 0.5)
    elif wrong == "watchdog":
        done = control.setWatchdog(0.0)
    else:
        done = control.moveJ([99.0, *before[1:]], 1.0, 4.0)
    assert not done and not control.isProgramRunning()
    assert receive.getActualQ() == before
    assert control.reuploadScript()
    wait_until(control.isProgramRunning, "no program", 10.0)
    assert control.moveJ(before, 1.0, 4.0)


@pytest.mark.parametrize("rubbish", [b"\0\0\0", b"\xff\xff\x55", b"\0\4U\1"])
def test_rubbish_ends_its_connection_and_no_other(arm, rubbish):
    with socket.create_connection((arm, 30004), 5.0) as link:
        link.sendall(rubbish)
        link.shutdown(socket.SHUT_WR)
        link.settimeout(5.0)
        assert link.recv(100) == b""
    with socket.create_connection((arm, 30004), 5.0) as link:
        link.sendall(rtde.packet(rtde.REQUEST_VERSION, b"\0\2"))
        assert link.recv(100) == rtde.packet(rtde.REQUEST_VERSION, b"\1")


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
    assert np.all(np.abs(qd) <= np.minimum(speed, UR3E.speed_rad_s) + 1e-9)
    assert np.abs(np.diff(qd, axis=0, prepend=np.zeros((1, 6)))).max() <= acceleration * STEP_S + 1e-9
    way = np.array(goal) - HOME_RAD
    along = (q - HOME_RAD) @ way / (way @ way)
    np.testing.assert_allclose(q, HOME_RAD + along[:, None] * way, atol=1e-9)
    for wrong in (([7.0] * 6, 1, 1), ([math.nan] * 6, 1, 1), ([0.0] * 6, 0, 1), ([0.0] * 6, 1, -1)):
        assert not motion.move(*wrong) and not motion.moving


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


CELL = load("cell")
LOOKING = (-95.90, 9.29, -109.38, 0.72, 262.47, 38.48)  # degrees, from a viewpoint of the cell's tour


def at(host: str, **source: object) -> Scenario:
    arm = {**CELL.source["arm"], "host": host, "max_gap_ms": 2000.0}
    changed = {"width": 48, "height": 48, "params": {"supersample": 1}, "codec": "png", **source}
    return dataclasses.replace(CELL, source={**CELL.source, "arm": arm, **changed})


def test_what_it_sees_and_what_it_claims_agree_where_the_arm_stands(host):
    scenario = at(host, effects={"depth_sensor": {"nearest_m": 0.1}}, depth_every=1)
    with simulated_arm(host, f"--joints={','.join(map(str, LOOKING))}"):
        fixed, hand = build_cameras(scenario, source_config(scenario), scenario.cameras)
        assert hand.waits and not fixed.waits
        shot = patiently(lambda: hand.capture(int(time.time() * hand.fps)), PoseGapError, 2.0)
        config = source_config(scenario).arm
        mount = load_hand_eyes(scenario, config, ["hand"])["hand"].transform
        place = base_matrix(config) @ UR3E.forward(np.deg2rad(LOOKING)) @ mount
        assert np.allclose(shot.pose.matrix(), place, atol=1e-12)
        scene = fixed.source.scene
        expected = scene.view(shot.intrinsics, place).image(0.0)
        assert np.array_equal(payload.decode(shot.payload, "png", 48, 48), expected)
        exact = DepthRenderer(scene.world, shot.intrinsics, place).depth(0.0)
        measured = shot.encoded_depth.decode().meters()
        seen = (measured > 0) & (exact > 0)
        assert seen.sum() > 0.6 * (exact > 0).sum() and np.median(np.abs(measured - exact)[seen] / exact[seen]) < 0.02
        assert shot.intrinsics == fixed.source.intrinsics
        hand.source._carrier.poses._flange._stream.stop()


def test_the_truth_of_another_instant_is_not_taken(host):
    with simulated_arm(host):
        truth, clock = TruthClient(host), WallClock()
        assert truth.joints(clock.now_ns()).shape == (6,)
        for offset_ns in (-3600 * 10**9, 10**9):
            refused(PoseGapError, "ms away: is this machine too busy", truth.joints, clock.now_ns() + offset_ns)
        # Each camera on the arm asks from a thread of its own, and gets its own instant's answer.
        time.sleep(0.5)
        instants = [clock.now_ns() - k * 10_000_000 for k in range(40)]
        with ThreadPoolExecutor(4) as threads:
            assert len(list(threads.map(truth.joints, 5 * instants))) == 200


def test_fixed_cameras_of_the_scenario_need_no_arm():
    scenario = at(own_address())
    (camera,) = build_cameras(scenario, source_config(scenario), ["cam00"])
    assert len(camera.capture(0).payload) > 100
