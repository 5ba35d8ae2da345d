"""``camera-node drive-arm`` with the real control interface and a simulated arm; joint states from a controller, and
every way in which they can stop coming."""

import contextlib
import os
import signal
import socket
import sys
import threading
import time

import numpy as np
import pytest

from camera_node.clocks import ArrivalClock
from camera_node.pose.providers import PoseGapError
from camera_node.robot.arm import ArmError
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.control import stop_event
from camera_node.robot.arm.joint_states import ArmStream, FlangePoses
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.arm.tour_planning import plan_tour
from camera_node.robot.flange_camera import TruthClient
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.settings import source_config
from freshfield.clock import WallClock
from freshfield.scenario import load
from tests.camera_node.robot.arm.simulated import simulated_arm, start_cli, wait_until_moving, write_cell
from tests.support import refused, wait_until

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


WITHIN_S = 20.0  # of a busy machine; what is waited for takes a fraction of it


@contextlib.contextmanager
def listening(host, answer):
    """A program on a controller's port that says ``answer`` to everybody, and then nothing."""
    with socket.create_server((host, 30004)) as server:
        held = []

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    held.append(server.accept()[0])
                    held[-1].recv(100)
                    held[-1].sendall(answer)

        threading.Thread(target=serve, daemon=True).start()
        yield
        server.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (b"", "no answer on port 30004"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "does not speak"),
        pytest.param(b"\x00\x04V\x01", "no joint states come", marks=pytest.mark.slow),
    ],
)
def test_a_port_without_a_controller_is_one_clear_line(host, answer, message):
    begin = time.monotonic()
    with listening(host, answer), pytest.raises(ArmError, match=message):
        ArmStream(host, WallClock()).start()
    assert time.monotonic() - begin < 4.0


def test_joints_come_with_their_times_and_a_state_that_stands_still_is_not_believed(host):
    """The library goes on returning the last joints of a controller that has stopped: stamps tell."""
    clock, stream = WallClock(), ArmStream(host, WallClock())
    with simulated_arm(host) as process, contextlib.ExitStack() as at_the_end:
        stream.start()
        at_the_end.callback(stream.stop)
        joints, gap_ns = stream.at(clock.now_ns(), WITHIN_S)
        assert np.allclose(joints, HOME_RAD) and gap_ns < 1_000_000_000
        wait_until(lambda: stream.received > 20, "too few joints")
        assert stream.trouble == "" and stream.connections == 1
        hand = FlangePoses(stream, UR3E, np.eye(4), WITHIN_S)
        assert np.allclose(hand.at(clock.now_ns())[0].matrix(), UR3E.forward(HOME_RAD), atol=1e-12)
        process.send_signal(signal.SIGSTOP)
        wait_until(lambda: "stood still" in stream.trouble or "no answer" in stream.trouble, "it is believed")
        refused(PoseGapError, "", stream.at, clock.now_ns(), 0.0)
        process.send_signal(signal.SIGCONT)
        wait_until(lambda: not stream.trouble, "it does not go on")


def test_arrivals_tell_the_offset_of_a_clock_that_drifts():
    rng = np.random.default_rng(1)
    clock, worst_ms = ArrivalClock(), []
    for k in range(20_000):  # 160 s at 125 a second
        true_ns = k * 8_000_000
        stamp_ns = round(true_ns * (1 - 50e-6)) + 77_000_000_000
        arrived_ns = true_ns + 300_000 + round(rng.exponential(2e6))
        worst_ms.append(abs(clock.host_ns(stamp_ns, arrived_ns) - true_ns) / 1e6)
    settled = np.array(worst_ms[625:])
    # The delay that all samples share (0.3 ms) stays in, and what drifts within the window (0.25 ms).
    assert settled.max() < 0.6 and settled.min() > 0.04


@pytest.mark.parametrize(
    "mode, safety, says",
    [(7, 1, ""), (7, 2, ""), (5, 1, "idle: brakes engaged"), (7, 3, "protective stop"), (99, 1, "99")],
)
def test_an_arm_that_cannot_move_says_why(mode, safety, says):
    stream = ArmStream("127.0.0.1", WallClock())
    stream._check_modes(mode, safety)
    assert says in stream.trouble and bool(stream.trouble) == bool(says)


TALKATIVE = """
import os
class RTDEReceiveInterface:
    def __init__(self, host, frequency_hz, variables):
        self.stamp = 0
        if host == "nowhere":
            raise RuntimeError("no robot")
    def isConnected(self):
        for output in (1, 2):
            os.write(output, b"x" * 100_000)
        self.stamp += 1
        return self.stamp <= 20
    getTimestamp = lambda self: float(self.stamp)
    getActualQ = lambda self: list(range(6))
    getRobotMode = lambda self: 7
    getSafetyMode = lambda self: 1
"""


@pytest.mark.parametrize(
    ("host", "received", "says"), [("127.0.0.1", 20, "the connection was lost"), ("nowhere", 0, "nowhere: no robot")]
)
def test_a_library_that_talks_much_does_not_stop_the_joints(monkeypatch, tmp_path, host, received, says):
    """More than a pipe holds before every sample."""
    (tmp_path / "rtde_receive.py").write_text(TALKATIVE)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    stream = ArmStream(host, WallClock())
    assert stream._read() == bool(received) and stream.received == received
    assert says in stream.trouble
