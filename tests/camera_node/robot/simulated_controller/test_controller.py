"""The real client library against the simulated controller."""

from __future__ import annotations

import socket
import struct
import time

import numpy as np
import pytest

from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.simulated_controller import rtde_protocol as rtde
from camera_node.robot.simulated_controller.controller import HOME_RAD
from freshfield.geometry import so3_exp
from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde, simulated_arm


@pytest.fixture(scope="module")
def arm():
    host = own_address()
    with simulated_arm(host):
        yield host


@pytest.fixture(scope="module")
def receive(arm):
    require_ur_rtde()
    from rtde_receive import RTDEReceiveInterface

    interface = RTDEReceiveInterface(arm)
    yield interface
    interface.disconnect()


@pytest.fixture(scope="module")
def control(arm, receive):
    from rtde_control import RTDEControlInterface

    interface = RTDEControlInterface(arm)
    yield interface
    interface.stopScript()


def test_the_library_receives_states_that_advance(receive):
    assert receive.isConnected() and receive.getRobotMode() == 7 and receive.getSafetyMode() == 1
    first = receive.getTimestamp()
    stamps = set()
    while len(stamps) < 50:
        stamps.add(receive.getTimestamp())
        time.sleep(0.001)
    assert max(stamps) > first
    on_grid = np.array(sorted(stamps)) / 0.002
    assert np.abs(on_grid - np.round(on_grid)).max() < 1e-6


def test_the_pose_it_reports_is_our_forward_kinematics(receive):
    x, y, z, *turn = receive.getActualTCPPose()
    flange = UR3E.forward(receive.getActualQ())
    assert np.allclose([x, y, z], flange[:3, 3], atol=1e-12)
    assert np.allclose(so3_exp(turn), flange[:3, :3], atol=1e-12)


def _await_next_state(receive) -> None:
    """Return when two states have been received that were sent after the call."""
    for _ in range(2):
        stamp, deadline = receive.getTimestamp(), time.monotonic() + 5.0
        while receive.getTimestamp() == stamp:
            assert time.monotonic() < deadline, "no state for five seconds"
            time.sleep(0.001)


def test_the_library_moves_the_arm(control, receive):
    goal = np.add(HOME_RAD, [0.2, 0.1, -0.1, 0.1, 0.0, 0.3])
    assert control.moveJ(goal.tolist(), 2.0, 8.0)
    _await_next_state(receive)  # the arm has arrived; what was received last may be from just before
    assert np.allclose(receive.getActualQ(), goal, atol=1e-9)
    assert control.moveJ(list(HOME_RAD), 1.0, 4.0, True)  # does not wait
    assert not np.allclose(receive.getActualQ(), HOME_RAD, atol=1e-3)
    control.stopJ(8.0)
    _await_next_state(receive)
    assert np.abs(receive.getActualQd()).max() < 1e-9
    where = receive.getActualQ()
    assert control.moveJ(list(HOME_RAD), 2.0, 8.0) and not np.allclose(where, HOME_RAD, atol=1e-4)
    _await_next_state(receive)
    assert np.allclose(receive.getActualQ(), HOME_RAD, atol=1e-9)
    assert control.moveJ(goal.tolist(), 1.0, 4.0, True)
    assert control.moveJ(list(HOME_RAD), 2.0, 8.0)  # while the other is on its way
    _await_next_state(receive)
    assert np.allclose(receive.getActualQ(), HOME_RAD, atol=1e-9)


def test_the_library_servos_the_arm(control, receive):
    start = receive.getActualQ()
    for k in range(60):
        control.servoJ([start[0] + 0.001 * k, *start[1:]], 0.0, 0.0, 0.002, 0.1, 300)
        time.sleep(0.002)
    control.servoStop()
    assert abs(receive.getActualQ()[0] - start[0] - 0.059) < 0.01


@pytest.mark.parametrize("wrong", ["beyond", "nan", "not simulated", "kinematics"])
def test_what_it_cannot_do_stops_the_program_and_is_not_called_done(control, receive, wrong):
    """As a fault does on a real one."""
    before = receive.getActualQ()
    if wrong == "kinematics":
        with pytest.raises(RuntimeError, match="did not succeed"):
            control.getForwardKinematics(before, [0.0] * 6)
        done = False
    elif wrong == "not simulated":
        done = control.moveL([0.2, 0.2, 0.2, 0.0, 3.0, 0.0], 0.1, 0.5)
    else:
        done = control.moveJ([99.0 if wrong == "beyond" else float("nan"), *before[1:]], 1.0, 4.0)
    assert not done and not control.isProgramRunning()
    assert receive.getActualQ() == before
    assert control.reuploadScript()
    until = time.monotonic() + 10.0
    while not control.isProgramRunning() and time.monotonic() < until:
        time.sleep(0.01)
    assert control.moveJ(before, 1.0, 4.0)


def test_two_clients_at_once(arm, receive):
    from rtde_receive import RTDEReceiveInterface

    other = RTDEReceiveInterface(arm, 50.0, ["timestamp", "actual_q"])
    assert np.allclose(other.getActualQ(), receive.getActualQ(), atol=1e-9)
    other.disconnect()
    assert receive.isConnected()


def test_the_dashboard_answers(arm):
    with socket.create_connection((arm, 29999), 5.0) as link, link.makefile("rw") as lines:
        assert lines.readline().startswith("Connected")
        for asked, answer in (
            ("robotmode", "Robotmode: RUNNING"),
            ("is in remote control", "true"),
            ("nonsense", "could not understand: 'nonsense'"),
        ):
            lines.write(asked + "\n")
            lines.flush()
            assert lines.readline().strip() == answer


def _exchange(link, kind, payload):
    link.sendall(rtde.packet(kind, payload))
    size, answered = rtde.HEADER.unpack(link.recv(3))
    assert answered == kind
    return link.recv(size - 3)


def test_an_unknown_variable_is_refused_by_name(arm):
    with socket.create_connection((arm, 30004), 5.0) as link:
        assert _exchange(link, rtde.REQUEST_VERSION, b"\0\2") == b"\1"
        assert _exchange(link, rtde.REQUEST_VERSION, b"\0\3") == b"\0"
        answer = _exchange(link, rtde.SETUP_OUTPUTS, struct.pack(">d", 125.0) + b"actual_q,moon_phase")
        assert answer == b"\0VECTOR6D,NOT_FOUND"
        assert _exchange(link, rtde.START, b"") == b"\0"  # nothing was agreed on


@pytest.mark.parametrize("rubbish", [b"\0\0\0", b"\xff\xff\x55", b"GET / HTTP/1.1\r\n\r\n", b"\0\4U\1"])
def test_rubbish_ends_its_connection_and_no_other(arm, rubbish):
    with socket.create_connection((arm, 30004), 5.0) as link:
        link.sendall(rubbish)
        link.shutdown(socket.SHUT_WR)
        link.settimeout(5.0)
        assert link.recv(100) == b""
    with socket.create_connection((arm, 30004), 5.0) as link:
        assert _exchange(link, rtde.REQUEST_VERSION, b"\0\2") == b"\1"


def test_a_recipe_comes_back_as_it_was_sent():
    recipe = rtde.Recipe.of(
        3, ["timestamp", "actual_q", "robot_mode", "joint_mode", "actual_digital_input_bits", "payload_cog"]
    )
    values = {
        "timestamp": 1.25,
        "actual_q": tuple(map(float, range(6))),
        "robot_mode": -1,
        "joint_mode": (253,) * 6,
        "actual_digital_input_bits": 2**63 + 5,
        "payload_cog": (0.1, 0.2, 0.3),
    }
    packed = recipe.pack(values)
    assert packed[0] == 3 and recipe.unpack(packed[1:]) == values
    assert recipe.unpack(recipe.pack({})[1:])["actual_q"] == (0.0,) * 6


def test_types_of_registers_end_where_a_controllers_do():
    assert rtde.type_of("output_int_register_47") == "INT32"
    assert rtde.type_of("output_int_register_48") == "NOT_FOUND"
    assert rtde.type_of("input_bit_register_64") == "BOOL"
