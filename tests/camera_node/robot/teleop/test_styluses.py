from __future__ import annotations

import json
import os
import pty
import socket
import time

import numpy as np
import pytest

from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.command import open_stylus
from camera_node.robot.teleop.gamepad import SPEED_M_S, TURN_RAD_S, AxisRange, GamepadState
from camera_node.robot.teleop.keyboard import KeyboardStylus
from camera_node.robot.teleop.network_stylus import MAX_BYTES, NetworkStylus, encode, parse
from camera_node.robot.teleop.stylus import PoseIntegrator
from tests.camera_node.robot.teleop.checks import sample

GOOD = {"t_ns": 5, "p": [0.1, 0.2, 0.3], "q": [1, 0, 0, 0], "clutch": True}


def send(stylus: NetworkStylus, *datagrams: bytes, sender: socket.socket | None = None) -> None:
    one = sender or socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for data in datagrams:
        one.sendto(data, ("127.0.0.1", stylus.port))
    if sender is None:
        one.close()


def received(stylus: NetworkStylus, now_ns: int = 0) -> list:
    for _ in range(200):
        found = stylus.poll(now_ns)
        if found:
            return found
        time.sleep(0.005)
    return []


def test_a_message_arrives_as_it_was_sent():
    stylus = NetworkStylus("127.0.0.1", 0)
    sent = sample(7, (0.1, -0.2, 0.3))
    send(stylus, encode(sent))
    assert received(stylus) == [sent]
    assert stylus.poll(0) == []
    stylus.close()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"[1, 2]",
        b"\xff\xfe",
        b"null",
        b"7",
        b"[" * 1500,
        json.dumps({**GOOD, "p": [0, 0]}).encode(),
        json.dumps({**GOOD, "q": "none"}).encode(),
        json.dumps({**GOOD, "p": [[1], 0, 0]}).encode(),
        json.dumps({**GOOD, "clutch": 1}).encode(),
        json.dumps({**GOOD, "t_ns": 1.5}).encode(),
        json.dumps({**GOOD, "t_ns": True}).encode(),
        json.dumps({"t_ns": 1}).encode(),
        json.dumps({**GOOD, "more": "x" * MAX_BYTES}).encode(),
    ],
)
def test_what_is_no_message_is_none(data):
    assert parse(data) is None


def test_numbers_that_make_no_pose_are_left_to_the_mapping():
    message = parse(json.dumps({**GOOD, "p": [float("nan"), 0, 0]}).encode())
    assert message is not None and not message.is_valid()


def test_bad_datagrams_are_counted_and_a_second_sender_is_not_heard():
    stylus = NetworkStylus("127.0.0.1", 0)
    first, second = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    send(stylus, b"nonsense", encode(sample(1)), sender=first)
    assert [s.t_ns for s in received(stylus, 0)] == [1]
    send(stylus, encode(sample(2)), sender=second)
    send(stylus, encode(sample(3)), sender=first)
    assert [s.t_ns for s in received(stylus, 10)] == [3]
    send(stylus, encode(sample(4)), sender=second)
    assert [s.t_ns for s in received(stylus, 2_000_000_000)] == [4], "the first has been silent for long"
    for each in (first, second):
        each.close()
    stylus.close()


def test_a_taken_port_is_one_clear_line():
    stylus = NetworkStylus("127.0.0.1", 0)
    with pytest.raises(TeleopError, match=r"cannot listen at .*name another port"):
        NetworkStylus("127.0.0.1", stylus.port)
    stylus.close()


@pytest.mark.parametrize("text", ["mouse", "network", "network:x", "network:0", "network:99999", "keyboard:2"])
def test_unknown_styluses_are_refused(text):
    with pytest.raises(TeleopError, match="--stylus: expected"):
        open_stylus(text)


def test_the_keyboard_of_a_real_terminal():
    controller, terminal = pty.openpty()
    stylus = KeyboardStylus(terminal)
    assert stylus.poll(0)[0].clutch is False
    os.write(controller, b" wwaR")
    time.sleep(0.05)
    (held,) = stylus.poll(1)
    assert held.clutch
    assert held.position_m == pytest.approx((0.010, 0.005, 0.005))
    os.write(controller, b"jj\x1b[A")  # turns, and an arrow key that means nothing
    time.sleep(0.05)
    turned = stylus.poll(2)[0].quaternion
    assert turned[3] == pytest.approx(np.sin(0.02)) and turned[1:3] == pytest.approx((0, 0), abs=1e-12)
    os.write(controller, b"q")
    time.sleep(0.05)
    assert not stylus.poll(3)[0].clutch and stylus.ended
    stylus.close()
    os.close(controller)
    os.close(terminal)


def test_a_keyboard_that_is_no_terminal_is_refused():
    read, write = os.pipe()
    with pytest.raises(TeleopError, match="needs a terminal"):
        KeyboardStylus(read)
    os.close(read)
    os.close(write)


def test_a_terminal_that_is_gone_ends_it():
    controller, terminal = pty.openpty()
    stylus = KeyboardStylus(terminal)
    os.close(controller)
    stylus.poll(0)
    assert stylus.ended
    os.close(terminal)


def test_a_pad_gives_speeds_outside_its_dead_zone_only():
    stick, trigger = AxisRange(-32768, 32767, 1000), AxisRange(0, 255)
    pad = GamepadState({0: stick, 1: stick, 2: trigger, 3: stick, 4: stick, 5: trigger})
    for code in (0, 1, 3, 4):
        pad.update(3, code, 1500)
    assert not np.any(np.concatenate(pad.speeds()))
    pad.update(3, 1, -32768)
    pad.update(3, 5, 255)
    pad.update(3, 3, 32767)
    speed, turn = pad.speeds()
    assert speed == pytest.approx([SPEED_M_S, 0.0, SPEED_M_S])
    assert turn == pytest.approx([0.0, 0.0, -TURN_RAD_S])
    assert not pad.clutch
    pad.update(1, 0x130, 1)
    assert pad.clutch
    pad.update(1, 0x130, 0)
    assert not pad.clutch
    pad.update(3, 1, 10**9)
    assert pad.speeds()[0][0] == pytest.approx(-SPEED_M_S)


def test_a_pad_through_the_kernel():
    """The real library and a virtual device, where this machine has them."""
    evdev = pytest.importorskip("evdev", reason="needs evdev: pip install -e '.[gamepad]'")
    if not os.access("/dev/uinput", os.W_OK):
        pytest.skip("needs /dev/uinput, writable")
    from camera_node.robot.teleop.gamepad import GamepadStylus

    axis = evdev.AbsInfo(0, -32768, 32767, 0, 128, 0)
    with evdev.UInput({1: [0x130], 3: [(0, axis), (1, axis)]}, name="freshfield test pad") as device:
        time.sleep(0.5)
        stylus = GamepadStylus(device.device.path)
        device.write(3, 1, -32768)
        device.write(1, 0x130, 1)
        device.syn()
        time.sleep(0.1)
        stylus.poll(0)
        (held,) = stylus.poll(20_000_000)
        assert held.clutch and held.position_m[0] > 0
        stylus.close()


def test_a_hand_moves_with_time_and_not_over_a_standstill():
    hand = PoseIntegrator()
    hand.advance(0, (1.0, 0.0, 0.0), np.zeros(3), True)
    assert hand.advance(10_000_000, (1.0, 0.0, 0.0), np.zeros(3), True).position_m[0] == pytest.approx(0.01)
    assert hand.advance(10**10, (1.0, 0.0, 0.0), np.zeros(3), True).position_m[0] == pytest.approx(0.06)
    assert hand.advance(0, (1.0, 0.0, 0.0), np.zeros(3), True).position_m[0] == pytest.approx(0.06)
