"""Joint states from a controller, and every way in which they can stop coming."""

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
from camera_node.robot.arm.joint_states import ArmStream, FlangePoses
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.simulated_controller.controller import HOME_RAD
from freshfield.clock import WallClock
from tests.camera_node.robot.arm.simulated import simulated_arm
from tests.support import refused, wait_until

WITHIN_S = 20.0  # of a busy machine; what is waited for takes a fraction of it


@contextlib.contextmanager
def listening(host, answer):
    """A program on a controller's port that says ``answer`` to everybody, and then nothing."""
    with socket.create_server((host, 30004)) as server:
        held = []

        def serve():
            with contextlib.suppress(OSError):
                while True:
                    link, _ = server.accept()
                    held.append(link)
                    if answer:
                        link.recv(100)
                        link.sendall(answer)

        threading.Thread(target=serve, daemon=True).start()
        yield
        server.shutdown(socket.SHUT_RDWR)
        for link in held:
            link.close()


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
