"""Smooths tremor out of the stylus's poses."""

from __future__ import annotations

import math

import numpy as np

from camera_node.robot.teleop import teleop_constants as tuned
from freshfield.geometry import Array, quaternion_multiply, quaternion_to_matrix, slerp, so3_log


class OneEuro:
    """The one-euro filter (Casiez, Roussel and Vogel, CHI 2012): little noise at low speed, little lag at high.

    Low-pass of position (3,) and quaternion (4,), w first, with a cutoff of ``hz + hz_per_speed * speed``,
    each by its own speed (m/s, rad/s). After ``reset`` the next sample passes unchanged.
    """

    def __init__(self, hz: float, hz_per_speed: float) -> None:
        self._hz, self._slope = hz, hz_per_speed
        self.reset()

    def reset(self) -> None:
        self._position: Array | None = None
        self._quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        self._speeds = np.zeros(2)

    def __call__(self, position: Array, quaternion: Array, dt_s: float) -> tuple[Array, Array]:
        """The filtered pose ``dt_s`` after the last one."""
        if self._position is None:
            self._position, self._quaternion, self._speeds = position.copy(), quaternion.copy(), np.zeros(2)
            return self._position, self._quaternion
        dt = min(max(dt_s, tuned.LEAST_STEP_S), tuned.MOST_STEP_S)
        step = position - self._position
        inverse = self._quaternion * np.array([1.0, -1.0, -1.0, -1.0])
        turn = so3_log(quaternion_to_matrix(quaternion_multiply(quaternion, inverse)))
        now = np.array([np.linalg.norm(step), np.linalg.norm(turn)]) / dt
        self._speeds = self._speeds + _smoothing_factor(tuned.SPEED_HZ, dt) * (now - self._speeds)
        shares = [_smoothing_factor(self._hz + self._slope * speed, dt) for speed in self._speeds]
        self._position = self._position + shares[0] * step
        self._quaternion = slerp(self._quaternion, quaternion, shares[1])
        return self._position, self._quaternion


def _smoothing_factor(cutoff_hz: float, dt_s: float) -> float:
    """Share of the difference to a new value that a first-order low-pass follows within ``dt_s``."""
    rate = 2.0 * math.pi * cutoff_hz * dt_s
    return rate / (rate + 1.0)
