import contextlib
import csv
import itertools
import json
import math
import os
import pty
import socket
import threading
import time
from collections.abc import Iterator
from unittest.mock import MagicMock

import numpy as np
import pytest
from msgspec.json import encode

from camera_node.cli import main
from camera_node.robot.arm import ArmError
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.arm.settings import TeleopConfig
from camera_node.robot.teleop import sinks, teleop_command
from camera_node.robot.teleop.stylus import KeyboardStylus, NetworkStylus, open_stylus, parse
from camera_node.robot.teleop.teleoperator import Command, Teleoperator
from tests.camera_node.robot.arm.simulated import write_cell
from tests.camera_node.robot.teleop.test_teleoperator import HOME, sample
from tests.freshfield.test_ledger import no_file_longer_than
from tests.support import free_port, refusal, refused, wait_until


@contextlib.contextmanager
def moving_stylus(port: int) -> Iterator[None]:
    """A stylus that moves along y for as long as the block lasts; its clutch is pressed after a while."""
    over = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            for k in itertools.count(1):
                if over.wait(0.005):
                    return
                position = (0.0, 0.06 * math.sin(0.02 * k), 0.0)
                one.sendto(encode(sample(k * 5_000_000, position, k % 200 > 20)), ("127.0.0.1", port))

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    yield
    over.set()
    thread.join()


def test_a_dry_run_writes_a_trajectory_within_its_limits(tmp_path, capsys):
    port, file = free_port(), tmp_path / "path.csv"
    teleop = {"speed_rad_s": 0.5, "scale": [1, 2, 1]}
    scenario = write_cell(tmp_path, "127.0.0.2", teleop=teleop)
    words = ["teleop", str(scenario), "--stylus", f"network:{port}", "--seconds", "2", "--dry-run", str(file)]
    with moving_stylus(port):
        assert main(words) == 0
    said = capsys.readouterr().out
    assert "clutch pressed 0 times" not in said
    rows = list(csv.DictReader(file.open()))
    assert f"of {len(rows)} ticks late" in said and len(rows) <= 2 * 125 + 40, "it keeps its pace"
    joints = np.array([[float(row[f"q{k}_rad"]) for k in range(1, 7)] for row in rows])
    assert np.allclose(joints[0], HOME, atol=0.01)
    assert np.abs(np.diff(joints, axis=0)).max() * 125.0 <= 0.5 + 1e-6
    flange = np.array([[float(row[f"{axis}_m"]) for axis in "xyz"] for row in rows])
    assert np.ptp(flange[:, 1]) > 0.01
    assert np.allclose(flange[-1], UR3E.forward(joints[-1])[:3, 3], atol=1e-6)


def test_a_trajectory_that_a_full_disk_cuts_is_said_in_one_line(tmp_path, capsys):
    words = ["teleop", str(write_cell(tmp_path, "127.0.0.2")), "--stylus", f"network:{free_port()}", "--seconds", "0.2"]
    with no_file_longer_than(1000):
        assert main([*words, "--dry-run", str(tmp_path / "path.csv")]) == 1
    assert "camera-node: [Errno 27] File too large" in capsys.readouterr().err


def test_an_arm_that_has_been_stopped_is_sent_nothing_more(monkeypatch):
    control, stream = MagicMock(), MagicMock(host="10.0.0.1", trouble="")
    stream.now.return_value = HOME
    monkeypatch.setattr(sinks, "connect_control", lambda host: control)
    sink, still = sinks.ServoSink(stream, 0.01), Command(HOME, np.zeros(6), "holding")
    sink.send(0.0, still)
    assert control.servoJ.call_count == 1
    for lag_rad, says in ((0.34, ""), (0.36, "21 degrees behind its target")):
        stream.now.return_value = HOME - np.eye(6)[2] * lag_rad
        with pytest.raises(ArmError, match=says) if says else contextlib.nullcontext():
            sink.send(0.0, still)
    assert control.servoJ.call_count == 2
    stream.trouble = "arm at 10.0.0.1: safety: protective stop"
    refused(ArmError, "protective stop: stopped", sink.send, 0.01, still)
    assert control.servoJ.call_count == 2
    monkeypatch.setattr("camera_node.robot.arm.control.STOPPING_S", 0.02)
    monkeypatch.setattr("signal.setitimer", lambda *_: None)  # the test's own timeout
    confirmed = threading.Event()
    control.stopScript.side_effect = confirmed.wait
    refused(ArmError, "has not confirmed its stop", sink.close)
    confirmed.set()
    sink.close()


def test_the_operator_ends_it_and_the_arm_comes_to_rest(capsys):
    """The stylus moves, and is put down on the way."""
    stylus, sink = MagicMock(ended=False), MagicMock()
    sent: list[Command] = []
    sink.send.side_effect = lambda t_s, command: sent.append(command)

    def poll(now_ns):
        stylus.ended = len(sent) == 60
        return [sample(now_ns, (0.001 * len(sent), 0.0, 0.0), len(sent) > 0)]

    stylus.poll.side_effect = poll
    assert teleop_command._run_loop(Teleoperator(UR3E, TeleopConfig(), HOME), stylus, sink, None) == 0
    assert np.abs(sent[60].speeds).max() > 0.0 and not sent[-1].speeds.any() and 61 < len(sent) < 200
    sink.close.assert_called_once()
    assert "clutch pressed 1 times" in capsys.readouterr().out
    stylus.ended, sink.close.side_effect = True, ArmError("it has not confirmed its stop")
    assert teleop_command._run_loop(Teleoperator(UR3E, TeleopConfig(), HOME), stylus, sink, None) == 1


def test_wrong_settings_are_refused_by_name(tmp_path, capsys):
    for section, part in (
        ({"speed_rad_s": 99}, "source.arm.teleop.speed_rad_s"),
        ({"acceleration_rad_s2": 0.06}, "too low to come to rest"),
    ):
        words = ["teleop", write_cell(tmp_path, "127.0.0.2", teleop=section), "--stylus", f"network:{free_port()}"]
        assert part in refusal(capsys, main, *words, "--dry-run", tmp_path / "x.csv")


GOOD = {"t_ns": 5, "p": [0.1, 0.2, 0.3], "q": [1, 0, 0, 0], "clutch": True}


def received(stylus: NetworkStylus, now_ns: int, *sent: tuple[socket.socket, bytes]) -> list:
    for sender, data in sent:
        sender.sendto(data, ("127.0.0.1", stylus.port))
    return wait_until(lambda: stylus.poll(now_ns), "nothing arrives")


def test_messages_of_one_sender_arrive_as_they_were_sent():
    stylus = NetworkStylus("127.0.0.1", 0)
    first, second = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    sent = [sample(k, (0.1, -0.2, 0.3)) for k in range(5)]
    assert received(stylus, 0, (first, b"nonsense"), (first, encode(sent[1]))) == [sent[1]]
    assert stylus.poll(0) == []
    assert received(stylus, 10, (second, encode(sent[2])), (first, encode(sent[3]))) == [sent[3]]
    assert received(stylus, 1_000_000_010, (second, encode(sent[4]))) == [sent[4]], "the first has been silent"
    refused(ArmError, r"cannot listen at .*name another port", NetworkStylus, "127.0.0.1", stylus.port)
    for each in (first, second, stylus):
        each.close()


def test_what_is_no_message_is_none():
    for data in (
        b"",
        b"\xff\xfe",
        b"[" * 1500,
        json.dumps({**GOOD, "p": [0, 0]}).encode(),
        json.dumps({**GOOD, "clutch": 1}).encode(),
        json.dumps({**GOOD, "t_ns": 1.5}).encode(),
        json.dumps({**GOOD, "p": [float("nan"), 0, 0]}).encode(),
        json.dumps({**GOOD, "more": "x" * 2048}).encode(),
    ):
        assert parse(data) is None


@pytest.mark.parametrize("text", ["mouse", "network:x", "network:0", "network:99999", "keyboard:2"])
def test_unknown_styluses_are_refused_and_those_that_other_machines_reach(text):
    refused(ArmError, "--stylus: expected", open_stylus, text)
    for host in ("0.0.0.0", "[::]", "example.com"):
        refused(ArmError, r"other machines reach .*driver on this machine", open_stylus, f"network:{host}:7010")


def test_the_keyboard_of_a_real_terminal():
    """Forwards is x, left y, up z; turns follow the right hand, but k and i: the tip goes down and up."""
    controller, terminal = pty.openpty()
    stylus = KeyboardStylus(terminal)

    def typed(keys: bytes):
        os.write(controller, keys)
        time.sleep(0.05)
        return stylus.poll(1)[0]

    assert stylus.poll(0)[0].clutch is False
    for axis, (there, back) in enumerate(("ws", "ad", "rf", "ou", "ki", "jl")):
        moved = np.eye(6)[axis] * (0.005 if axis < 3 else np.sin(0.01))
        for key, expected in ((there, moved), (back, 0.0 * moved)):
            found = typed(key.encode())
            np.testing.assert_allclose([*found.position_m, *found.quaternion[1:]], expected, atol=1e-12)
    held = typed(b" wwaR")
    assert held.clutch and held.position_m == pytest.approx((0.010, 0.005, 0.005))
    turned = typed(b"jj\x1b[A").quaternion  # turns, and an arrow key that means nothing
    assert turned[3] == pytest.approx(np.sin(0.02)) and turned[1:3] == pytest.approx((0, 0), abs=1e-12)
    assert not typed(b"q").clutch and stylus.ended
    stylus.close()
    gone = KeyboardStylus(terminal)
    os.close(controller)
    gone.poll(0)
    assert gone.ended, "its terminal is gone"
    os.close(terminal)
    with open(os.devnull) as nothing, pytest.raises(ArmError, match="needs a terminal"):
        KeyboardStylus(nothing.fileno())
