from __future__ import annotations

import json
import os
import pty
import socket
import time

import numpy as np
import pytest
from msgspec.json import encode

from camera_node.robot.arm import ArmError
from camera_node.robot.teleop.stylus import KeyboardStylus, NetworkStylus, open_stylus, parse
from tests.camera_node.robot.teleop.checks import sample

GOOD = {"t_ns": 5, "p": [0.1, 0.2, 0.3], "q": [1, 0, 0, 0], "clutch": True}


def received(stylus: NetworkStylus, now_ns: int, *sent: tuple[socket.socket, bytes]) -> list:
    for sender, data in sent:
        sender.sendto(data, ("127.0.0.1", stylus.port))
    for _ in range(200):
        found = stylus.poll(now_ns)
        if found:
            return found
        time.sleep(0.005)
    return []


def test_messages_of_one_sender_arrive_as_they_were_sent():
    stylus = NetworkStylus("127.0.0.1", 0)
    first, second = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    sent = [sample(k, (0.1, -0.2, 0.3)) for k in range(5)]
    assert received(stylus, 0, (first, b"nonsense"), (first, encode(sent[1]))) == [sent[1]]
    assert stylus.poll(0) == []
    assert received(stylus, 10, (second, encode(sent[2])), (first, encode(sent[3]))) == [sent[3]]
    assert received(stylus, 1_000_000_010, (second, encode(sent[4]))) == [sent[4]], "the first has been silent"
    with pytest.raises(ArmError, match=r"cannot listen at .*name another port"):
        NetworkStylus("127.0.0.1", stylus.port)
    for each in (first, second, stylus):
        each.close()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xfe",
        b"[" * 1500,
        json.dumps({**GOOD, "p": [0, 0]}).encode(),
        json.dumps({**GOOD, "q": "none"}).encode(),
        json.dumps({**GOOD, "clutch": 1}).encode(),
        json.dumps({**GOOD, "t_ns": 1.5}).encode(),
        json.dumps({"t_ns": 1}).encode(),
        json.dumps({**GOOD, "p": [float("nan"), 0, 0]}).encode(),
        json.dumps({**GOOD, "more": "x" * 2048}).encode(),
    ],
)
def test_what_is_no_message_is_none(data):
    assert parse(data) is None


@pytest.mark.parametrize("text", ["mouse", "network:x", "network:0", "network:99999", "keyboard:2"])
def test_unknown_styluses_are_refused_and_those_that_other_machines_reach(text):
    with pytest.raises(ArmError, match="--stylus: expected"):
        open_stylus(text)
    for host in ("0.0.0.0", "[::]", "example.com"):
        with pytest.raises(ArmError, match=r"other machines reach .*driver on this machine"):
            open_stylus(f"network:{host}:7010")


AXES = {"w": 0, "s": 0, "a": 1, "d": 1, "r": 2, "f": 2, "o": 3, "u": 3, "k": 4, "i": 4, "j": 5, "l": 5}


def test_every_key_moves_along_or_turns_about_its_axis(monkeypatch):
    """Forwards is x, left y, up z; turns follow the right hand, but k and i: the tip goes down and up."""
    for key, axis in AXES.items():
        controller, terminal = pty.openpty()
        stylus = KeyboardStylus(terminal)
        monkeypatch.setattr(stylus, "_read", lambda key=key: key)
        (found,) = stylus.poll(0)
        expected = np.eye(6)[axis] * (0.005 if axis < 3 else np.sin(0.01)) * (1 if key in "warokj" else -1)
        np.testing.assert_allclose([*found.position_m, *found.quaternion[1:]], expected, atol=1e-12)
        stylus.close()
        os.close(controller)
        os.close(terminal)


def test_the_keyboard_of_a_real_terminal():
    controller, terminal = pty.openpty()
    stylus = KeyboardStylus(terminal)

    def typed(keys: bytes):
        os.write(controller, keys)
        time.sleep(0.05)
        return stylus.poll(1)[0]

    assert stylus.poll(0)[0].clutch is False
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
