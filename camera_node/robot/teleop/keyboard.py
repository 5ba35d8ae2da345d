"""The keyboard as a stylus: keys move it by steps, the space bar presses and releases the clutch.

A terminal reports presses, not whether a key is held. Every press, and every repetition of a held key, is one
step. The filter turns the steps into a smooth motion.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty

import numpy as np

from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.stylus import FARTHEST_M, StylusSample
from freshfield.geometry import matrix_to_quaternion, quaternion_multiply, quaternion_normalize, so3_exp

KEYS = """\
  w s   forwards, back (x)       i k   tip up, down
  a d   left, right (y)          j l   turn left, right
  r f   up, down (z)             u o   roll
  space clutch: press, release   q     end"""

_STEP_M, _STEP_RAD = 0.005, 0.02
_MOVES = {
    "w": (0, 1),
    "s": (0, -1),
    "a": (1, 1),
    "d": (1, -1),
    "r": (2, 1),
    "f": (2, -1),
    "o": (3, 1),
    "u": (3, -1),
    "k": (4, 1),
    "i": (4, -1),
    "j": (5, 1),
    "l": (5, -1),
}
_ESCAPE, _END_OF_FILE, _MAX_BYTES = "\x1b", "\x04", 32


class KeyboardStylus:
    """Reads the terminal ``fd`` without blocking; its line mode is off until ``close``. Raises TeleopError if
    it is not a terminal."""

    def __init__(self, fd: int | None = None) -> None:
        self._fd = sys.stdin.fileno() if fd is None else fd
        self.ended = False
        self._clutch = False
        self._position, self._quaternion = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
        try:
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)
        except termios.error:
            raise TeleopError("--stylus keyboard needs a terminal: run it in one, or use network:PORT") from None

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
                step[axis] += sign * (_STEP_M if axis < 3 else _STEP_RAD)
        half = 0.5 * FARTHEST_M  # with the clutch open it may move without end
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
