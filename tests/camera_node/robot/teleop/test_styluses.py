from __future__ import annotations

import json
import os
import pty
import socket
import time

import numpy as np
import pytest

from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.keyboard import KeyboardStylus
from camera_node.robot.teleop.network_stylus import MAX_BYTES, NetworkStylus, encode, parse
from camera_node.robot.teleop.teleop_command import open_stylus
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
