"""A gamepad as a stylus, through the kernel's event devices (evdev, extra ``gamepad``).

Left stick: x and y. Right stick: turn and tip. Triggers: down and up. Shoulder buttons: roll. The arm follows
while the south button (A, cross) is held. The dead zone is the pad's own, or 8 % if that is smaller.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.stylus import PoseIntegrator, StylusSample

log = logging.getLogger("camera-node.teleop")

SPEED_M_S, TURN_RAD_S = 0.15, 0.8
_DEAD_ZONE = 0.08
# linux/input-event-codes.h
_EV_KEY, _EV_ABS = 1, 3
_SOUTH, _LEFT_SHOULDER, _RIGHT_SHOULDER = 0x130, 0x136, 0x137
_X, _Y, _Z, _RX, _RY, _RZ = 0, 1, 2, 3, 4, 5
_STICKS = (_X, _Y, _RX, _RY)
_TRIGGERS = (_Z, _RZ)


@dataclass(frozen=True)
class AxisRange:
    """Range of an axis. flat: its dead zone around the middle."""

    low: int
    high: int
    flat: int = 0


class GamepadState:
    """State of a pad from its events: axes in [-1, 1] (triggers in [0, 1]) and buttons."""

    def __init__(self, ranges: dict[int, AxisRange]) -> None:
        self._ranges = ranges
        self._axes = dict.fromkeys((*_STICKS, *_TRIGGERS), 0.0)
        self._pressed: set[int] = set()

    def update(self, kind: int, code: int, value: int) -> None:
        """Process one event of the kernel."""
        if kind == _EV_KEY:
            self._pressed.discard(code) if value == 0 else self._pressed.add(code)
        elif kind == _EV_ABS and code in self._axes and code in self._ranges:
            axis = self._ranges[code]
            width = axis.high - axis.low
            if width <= 0:
                return
            position = min(max((value - axis.low) / width, 0.0), 1.0)
            if code in _STICKS:
                position = 2.0 * position - 1.0
                dead = max(_DEAD_ZONE, 2.0 * axis.flat / width)
                # Zero at the edge of the dead zone, so that a stick does not start with a jump.
                position = np.sign(position) * max(abs(position) - dead, 0.0) / max(1.0 - dead, 1e-6)
            self._axes[code] = float(position)

    @property
    def clutch(self) -> bool:
        return _SOUTH in self._pressed

    def speeds(self) -> tuple[np.ndarray, np.ndarray]:
        """Speeds (3,) m/s and (3,) rad/s that the sticks command."""
        a = self._axes
        roll = float(_RIGHT_SHOULDER in self._pressed) - float(_LEFT_SHOULDER in self._pressed)
        speed = np.array([-a[_Y], -a[_X], a[_RZ] - a[_Z]]) * SPEED_M_S
        return speed, np.array([roll, a[_RY], -a[_RX]]) * TURN_RAD_S


class GamepadStylus:
    """The pad at ``path``, or the first one. Raises TeleopError if there is none."""

    def __init__(self, path: str | None) -> None:
        self._device = _open(path)
        axes = self._device.capabilities().get(_EV_ABS, [])
        self._pad = GamepadState({code: AxisRange(i.min, i.max, i.flat) for code, i in axes})
        self._hand = PoseIntegrator()
        self.ended = False
        log.info("gamepad: %s (%s)", self._device.name, self._device.path)

    def poll(self, now_ns: int) -> list[StylusSample]:
        """See ``Stylus``. A pad that was unplugged gives no more samples."""
        try:
            for event in self._device.read():
                self._pad.update(event.type, event.code, event.value)
        except BlockingIOError:
            pass
        except OSError:
            log.error("gamepad: it was unplugged: the arm stops")
            self.ended = True
            return []
        return [self._hand.advance(now_ns, *self._pad.speeds(), self._pad.clutch)]

    def close(self) -> None:
        self._device.close()


def _open(path: str | None) -> Any:
    try:
        import evdev
    except ModuleNotFoundError:
        raise TeleopError("--stylus gamepad needs evdev: pip install 'freshfield[gamepad]'") from None
    try:
        paths = [path] if path is not None else sorted(evdev.list_devices())
        for each in paths:
            device = evdev.InputDevice(each)
            known = device.capabilities()
            axes = {code for code, _ in known.get(_EV_ABS, [])}
            if _SOUTH in known.get(_EV_KEY, []) and {_X, _Y} <= axes:
                return device
            device.close()
    except OSError as error:
        raise TeleopError(f"--stylus gamepad: {path or '/dev/input'}: {error.strerror or error}") from None
    raise TeleopError(
        f"--stylus gamepad: {path or 'none of the input devices'} is no gamepad with sticks; is it plugged "
        "in, and are you in the group input?"
    )
