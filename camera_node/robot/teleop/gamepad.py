"""A gamepad as a stylus, through the kernel's event devices (evdev, extra ``gamepad``).

Left stick: x and y. Right stick: turn and tip. Triggers: down and up. Shoulder buttons: roll. The arm follows
while the south button (A, cross) is held, and stops when it is let go. The pad's own dead zone counts.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.pose_integrator import PoseIntegrator
from camera_node.robot.teleop.stylus import StylusSample

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
    """What an axis reports at its ends, and around its middle without meaning anything."""

    low: int
    high: int
    flat: int = 0


class GamepadState:
    """State of a pad from its events: axes in [-1, 1] (triggers in [0, 1]) and buttons."""

    def __init__(self, spans: dict[int, AxisRange]) -> None:
        self._spans = spans
        self._axes = dict.fromkeys((*_STICKS, *_TRIGGERS), 0.0)
        self._pressed: set[int] = set()

    def update(self, kind: int, code: int, value: int) -> None:
        """One event of the kernel's."""
        if kind == _EV_KEY:
            self._pressed.discard(code) if value == 0 else self._pressed.add(code)
        elif kind == _EV_ABS and code in self._axes and code in self._spans:
            span = self._spans[code]
            if span.high <= span.low:
                return
            share = min(max((value - span.low) / (span.high - span.low), 0.0), 1.0)
            if code in _STICKS:
                share = 2.0 * share - 1.0
                dead = max(_DEAD_ZONE, 2.0 * span.flat / (span.high - span.low))
                # From the edge of the dead zone on, so that a stick does not begin with a jerk.
                share = np.sign(share) * max(abs(share) - dead, 0.0) / max(1.0 - dead, 1e-6)
            self._axes[code] = float(share)

    @property
    def clutch(self) -> bool:
        return _SOUTH in self._pressed

    def speeds(self) -> tuple[np.ndarray, np.ndarray]:
        """Speeds (3,) m/s and (3,) rad/s that the sticks ask for."""
        a = self._axes
        roll = float(_RIGHT_SHOULDER in self._pressed) - float(_LEFT_SHOULDER in self._pressed)
        speed = np.array([-a[_Y], -a[_X], a[_RZ] - a[_Z]]) * SPEED_M_S
        return speed, np.array([roll, a[_RY], -a[_RX]]) * TURN_RAD_S


class GamepadStylus:
    """The pad at ``path``, or the first there is. Raises TeleopError where there is none."""

    def __init__(self, path: str | None = None) -> None:
        self._device = _open(path)
        spans = {
            code: AxisRange(i.min, i.max, i.flat) for code, i in self._device.capabilities().get(_EV_ABS, [])
        }
        self._pad, self._hand = GamepadState(spans), PoseIntegrator()
        self.ended = False
        log.info("gamepad: %s (%s)", self._device.name, self._device.path)

    def poll(self, now_ns: int) -> list[StylusSample]:
        """See ``Stylus``; a pad that is pulled out says nothing more."""
        try:
            for event in self._device.read():
                self._pad.update(event.type, event.code, event.value)
        except BlockingIOError:
            pass
        except OSError:
            log.error("gamepad: it is gone: the arm stops")
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
