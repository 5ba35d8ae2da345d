"""``camera-node drive-arm`` with the real control interface and a simulated arm."""

import signal
import socket
import time

import numpy as np
import pytest

from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.control import stop_event
from camera_node.robot.arm.viewpoint_tour import plan_tour
from camera_node.robot.flange_camera import TruthClient
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.settings import source_config
from freshfield.clock import WallClock
from freshfield.scenario import load
from tests.camera_node.robot.arm.simulated import simulated_arm, start_cli, wait_until_moving, write_cell
from tests.support import wait_until

PATH = {
    "azimuths_deg": [-150, -120],
    "elevations_deg": [60],
    "rolls_deg": [0],
    "speed_rad_s": 3.0,
    "acceleration_rad_s2": 20.0,
}


@pytest.fixture
def cell(tmp_path, host):
    """A cell with a short and fast path: its file, its address."""
    return write_cell(tmp_path, host, PATH), host


def real(cell, **path):
    """The same cell, its arm taken for a real one: no patience, and questions."""
    file, host = cell
    return write_cell(file.parent, host, PATH | path, simulated=False)


def near(file):
    """Degrees (6,) of an arm that stands before the first viewpoint; --joints of it."""
    angles = np.add(np.rad2deg(stops_of(file)[0]), [30, 10, 0, 0, 0, 0]).round(3)
    return angles, "--joints=" + ",".join(map(str, angles))


def at_rest(truth):
    before = truth.joints(WallClock().now_ns())
    time.sleep(0.1)
    return np.array_equal(truth.joints(WallClock().now_ns()), before)


def shown(text):
    """Joint angles (N, 6) of the numbered lines, degrees."""
    lines = [line.split() for line in text.splitlines()]
    return np.array([line[1:] for line in lines if line and line[0].isdigit() and len(line) == 7], float)


def stops_of(file):
    scenario = load(file)
    config = source_config(scenario).arm
    mount = load_hand_eyes(scenario, config, ["hand"])["hand"].transform
    return plan_tour(arm_model(scenario, config), base_matrix(config), mount, config.path, HOME_RAD).stops


def test_a_round_visits_every_viewpoint_and_ends(cell):
    file, host = cell
    with simulated_arm(host):
        truth, clock = TruthClient(host), WallClock()
        process = start_cli("drive-arm", file, "--rounds", "1")
        seen = []
        while process.poll() is None:
            seen.append(truth.joints(clock.now_ns()))
            time.sleep(0.005)
        said = process.communicate()
        assert process.returncode == 0, said
        np.testing.assert_allclose(shown(said[0]), np.rad2deg(stops_of(file)), atol=0.006)
        for stop in stops_of(file):
            assert min(np.abs(q - stop).max() for q in seen) < 0.02
        assert np.abs(truth.joints(clock.now_ns()) - stops_of(file)[-1]).max() < 2e-3


def test_a_drive_that_is_killed_leaves_no_arm_moving(cell):
    """The controller's own watchdog misses it."""
    file, host = cell
    with simulated_arm(host, near(file)[1]):
        truth = TruthClient(host)
        process = start_cli("drive-arm", real(cell, speed_rad_s=0.1), "--yes")  # the first move takes many seconds
        wait_until_moving(truth, process)
        process.kill()
        process.communicate()
        wait_until(lambda: at_rest(truth), "it moves on", 5.0)
        assert np.abs(truth.joints(WallClock().now_ns()) - stops_of(file)[0]).max() > 0.2


def test_a_program_stopped_at_the_pendant_and_a_signal_end_the_drive(cell):
    file, host = cell
    with simulated_arm(host):
        truth = TruthClient(host)
        process = start_cli("drive-arm", file)
        wait_until_moving(truth, process)
        with socket.create_connection((host, 29999), 5.0) as dashboard:
            dashboard.sendall(b"stop\n")
            assert process.wait(20.0) == 1
        assert "its program was ended" in process.communicate()[1]
        wait_until(lambda: at_rest(truth), "it moves on", 5.0)
        process = start_cli("drive-arm", file)
        wait_until_moving(truth, process)
        process.send_signal(signal.SIGTERM)  # ends it in order
        assert process.wait(20.0) == 0
        wait_until(lambda: at_rest(truth), "it moves on", 0.3)


@pytest.mark.parametrize("under_nohup", [False, True])
def test_signals_end_a_motion_and_a_closed_terminal_too_unless_it_is_ignored(under_nohup):
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    signal.signal(signal.SIGHUP, signal.SIG_IGN if under_nohup else signal.SIG_DFL)
    try:
        for number in numbers:
            requested = stop_event()
            signal.raise_signal(number)
            assert requested.is_set() != (under_nohup and number == signal.SIGHUP)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_real_arm_is_asked_about_first_and_not_driven_through_half_the_bench(cell):
    file, host = cell
    stands_deg, joints = near(file)
    with simulated_arm(host, joints):
        process = start_cli("drive-arm", real(cell))
        out, said = process.communicate(timeout=20)
        assert process.returncode == 2 and "say that its space is clear with --yes" in said
        now = TruthClient(host).joints(WallClock().now_ns())
        assert np.allclose(now, np.deg2rad(stands_deg), atol=1e-4)
        # Before the question, and from the nearest viewpoint on.
        first_deg = np.abs(shown(out)[0] - stands_deg).max()
        assert f"the first move turns a joint by {first_deg:.0f}" in out and 0 < first_deg <= 30.01
    with simulated_arm(host, "--joints=-20,-90,90,-90,90,0"):
        process = start_cli("drive-arm", real(cell), "--yes")
        said = process.communicate(timeout=20)[1]
        assert process.returncode == 2 and "the first move would turn a joint by" in said
