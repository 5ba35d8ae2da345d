"""The real client library against the simulated controller."""

import socket
import time

import numpy as np
import pytest

from camera_node.robot.arm.rtde_process import VARIABLES
from camera_node.robot.simulated_controller import rtde_protocol as rtde
from camera_node.robot.simulated_controller.controller import HOME_RAD
from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde, simulated_arm
from tests.support import refused, wait_until


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


@pytest.mark.parametrize("wrong", ["beyond", "not simulated", "kinematics"])
def test_what_it_cannot_do_stops_the_program_and_is_not_called_done(control, receive, wrong):
    """As a fault does on a real one."""
    before = receive.getActualQ()
    if wrong == "kinematics":
        refused(RuntimeError, "did not succeed", control.getForwardKinematics, before, [0.0] * 6)
        done = False
    elif wrong == "not simulated":
        done = control.moveL([0.2, 0.2, 0.2, 0.0, 3.0, 0.0], 0.1, 0.5)
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
