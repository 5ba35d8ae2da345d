"""Styluses: what an operator holds, read once per tick as samples of pose, clutch and time.

The keyboard is one: keys move it by steps, the space bar presses and releases the clutch. Drivers of other devices
(a 3D Systems Touch, a VR controller, a script) send samples over the network; ``camera-node teleop --help`` describes
the datagrams. No stylus knows the arm; ``limits`` makes every sample safe for it.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import select
import socket
import sys
import termios
import tty
from typing import Protocol

import msgspec
import numpy as np

from camera_node.robot.arm import ArmError
from camera_node.robot.teleop import teleop_constants as tuned
from freshfield.access import is_loopback
from freshfield.geometry import Array, matrix_to_quaternion, quaternion_multiply, quaternion_normalize, so3_exp

log = logging.getLogger("camera-node.teleop")

KEYS = """\
  w s   forwards, back (x)       i k   tip up, down
  a d   left, right (y)          j l   turn left, right
  r f   up, down (z)             u o   roll
  space clutch: press, release   q     end"""

# Key -> axis and sign of its step.
_MOVES = {
    key: (axis, sign)
    for axis, keys in enumerate(("ws", "ad", "rf", "ou", "ki", "jl"))
    for key, sign in zip(keys, (1, -1))
}
_ESCAPE, _END_OF_FILE, _MAX_BYTES = "\x1b", "\x04", 32
MAX_BYTES = 2048


class StylusSample(msgspec.Struct, frozen=True, rename={"position_m": "p", "quaternion": "q"}):
    """One sample of a stylus, as JSON the message of a network stylus.

    t_ns: on any clock; only differences are used.
    position_m: (3,) in the stylus's own axes.
    quaternion: (4,), w first.
    clutch: the arm follows while it is pressed.
    """

    t_ns: int
    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    clutch: bool

    def is_valid(self) -> bool:
        """Whether this is a possible pose: finite, with a quaternion of about unit length, and not too
        far."""
        values = (*self.position_m, *self.quaternion)
        if len(values) != 7 or not all(map(math.isfinite, values)):
            return False
        norm = math.sqrt(sum(v * v for v in self.quaternion))
        return (
            max(map(abs, self.position_m)) <= tuned.FARTHEST_M
            and tuned.LEAST_NORM < norm < tuned.MOST_NORM
            and 0 <= self.t_ns < 2**63
        )

    def arrays(self) -> tuple[Array, Array]:
        """Position (3,) and unit quaternion (4,) of a valid sample."""
        return np.array(self.position_m), quaternion_normalize(self.quaternion)


class Stylus(Protocol):
    """An input device in the operator's hand."""

    @property
    def ended(self) -> bool:
        """Whether the operator asked to stop, or the device is gone."""
        ...

    def poll(self, now_ns: int) -> list[StylusSample]:
        """Samples since the last call, oldest first. Never blocks, and never raises for bad input."""
        ...

    def close(self) -> None: ...


class KeyboardStylus:
    """Reads the terminal ``fd`` without blocking; its line mode is off until ``close``. Raises ArmError if
    it is not a terminal.

    A terminal reports presses, not whether a key is held. Every press, and every repetition of a held key, is one
    step. The filter turns the steps into a smooth motion.
    """

    def __init__(self, fd: int | None = None) -> None:
        self._fd = sys.stdin.fileno() if fd is None else fd
        self.ended = False
        self._clutch = False
        self._position, self._quaternion = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        try:
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)
        except termios.error:
            raise ArmError("--stylus keyboard needs a terminal: run it in one, or use network:PORT") from None

    def poll(self, now_ns: int) -> list[StylusSample]:
        """See ``Stylus``. Returns one sample, also if no key was pressed."""
        step = np.zeros(6)
        for key in self._read():
            if key in ("q", _END_OF_FILE):
                self.ended = True
            elif key == " ":
                self._clutch = not self._clutch
            elif key in _MOVES:
                axis, sign = _MOVES[key]
                step[axis] += sign * (tuned.STEP_M if axis < 3 else tuned.STEP_RAD)
        half = 0.5 * tuned.FARTHEST_M  # with the clutch open it may move without end
        self._position = np.clip(self._position + step[:3], -half, half)
        turned = matrix_to_quaternion(so3_exp(step[3:]))
        self._quaternion = quaternion_normalize(quaternion_multiply(turned, self._quaternion))
        (x, y, z), (qw, qx, qy, qz) = self._position.tolist(), self._quaternion.tolist()
        return [StylusSample(now_ns, (x, y, z), (qw, qx, qy, qz), self._clutch and not self.ended)]

    def close(self) -> None:
        """Restore the terminal's settings."""
        with contextlib.suppress(termios.error):
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def _read(self) -> str:
        """Keys typed since the last call, without arrow and function keys."""
        if not select.select([self._fd], [], [], 0.0)[0]:
            return ""
        try:
            data = os.read(self._fd, _MAX_BYTES)
        except OSError:
            data = b""
        if not data:
            self.ended = True  # the terminal is gone
        typed = data.decode("ascii", errors="ignore").lower()
        return typed.split(_ESCAPE)[0]


class NetworkStylus:
    """Listens at ``host``:``port``; port 0 takes a free one, which ``port`` then tells. Raises ArmError, also for an
    address that other machines reach: whoever sends a datagram moves the arm.

    Only the first sender counts, until it has been silent for a second.
    """

    ended = False

    def __init__(self, host: str, port: int) -> None:
        if not is_loopback(host):
            raise ArmError(
                f"--stylus network: other machines reach {host}, and a message moves the arm: run the stylus's driver "
                "on this machine, and name network:PORT"
            )
        self._owner: tuple[str, int] | None = None
        self._heard_ns = 0
        try:
            kind = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.socket(kind, socket.SOCK_DGRAM)
            self._socket.bind((host, port))
        except OSError as error:
            raise ArmError(
                f"--stylus network: cannot listen at {host}:{port}: {error.strerror}; name another port"
            ) from None
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]

    def poll(self, now_ns: int) -> list[StylusSample]:
        """See ``Stylus``."""
        found = []
        for _ in range(tuned.MAX_MESSAGES):
            try:
                data, sender = self._socket.recvfrom(MAX_BYTES + 1)
            except OSError:
                break  # nothing there
            if self._owner is not None and sender[:2] != self._owner and now_ns - self._heard_ns < tuned.OWNED_NS:
                continue
            sample = parse(data)
            if sample is None:
                continue
            if self._owner != sender[:2]:
                log.info("stylus: messages come from %s:%d", *sender[:2])
            self._owner, self._heard_ns = sender[:2], now_ns
            found.append(sample)
        return found

    def close(self) -> None:
        self._socket.close()


def parse(data: bytes) -> StylusSample | None:
    """Parse a message; None if it is malformed. Its numbers are checked later (``StylusSample.is_valid``)."""
    try:
        return msgspec.json.decode(data, type=StylusSample) if len(data) <= MAX_BYTES else None
    except (msgspec.DecodeError, ValueError, RecursionError):
        return None


def open_stylus(text: str) -> Stylus:
    """Open a stylus by its name on the command line: ``keyboard``, ``network:PORT`` or ``network:HOST:PORT``. Raises
    ArmError."""
    kind, _, rest = text.partition(":")
    if kind == "keyboard" and not rest:
        keyboard = KeyboardStylus()
        print(KEYS, file=sys.stderr)
        return keyboard
    if kind == "network":
        host, _, port = rest.rpartition(":")
        if not port.isdigit() or not 0 < int(port) < 65536:
            raise ArmError(f"--stylus: expected network:PORT or network:HOST:PORT, got {text!r}")
        stylus = NetworkStylus(host.strip("[]") or "127.0.0.1", int(port))
        log.info("waiting for a stylus at UDP port %d", stylus.port)
        return stylus
    raise ArmError(f"--stylus: expected keyboard or network:PORT, got {text!r}")
