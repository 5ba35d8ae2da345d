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
from camera_node.robot.teleop.stylus import PoseIntegrator, StylusSample

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
        self._hand, self._clutch = PoseIntegrator(), False
        try:
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)
        except termios.error:
            raise TeleopError("--stylus keyboard needs a terminal: run it in one, or use network:PORT") from None

    def poll(self, now_ns: int) -> list[StylusSample]:
        """See ``Stylus``. Returns one sample, also if no key was pressed."""
        shift = np.zeros(6)
        for key in self._read():
            if key in ("q", _END_OF_FILE):
                self.ended = True
            elif key == " ":
                self._clutch = not self._clutch
            elif key in _MOVES:
                axis, sign = _MOVES[key]
                shift[axis] += sign * (_STEP_M if axis < 3 else _STEP_RAD)
        self._hand.shift(shift[:3], shift[3:])
        return [self._hand.advance(now_ns, np.zeros(3), np.zeros(3), self._clutch and not self.ended)]

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
