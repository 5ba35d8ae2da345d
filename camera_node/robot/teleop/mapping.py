"""Maps poses of the stylus to target poses of the flange: a scaled map with a clutch (4.1).

``p_ee = p_ee0 + S R (p_h - p_h0)``: both references are the poses of arm and stylus when the clutch is
pressed. So pressing it commands no motion, wherever the stylus is. A stylus that jumps from one message to
the next, or that was silent, gets new references too.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from camera_node.robot.arm.settings import TeleopConfig
from camera_node.robot.teleop.one_euro_filter import OneEuro
from camera_node.robot.teleop.stylus import StylusSample
from freshfield.geometry import Array, matrix_to_quaternion, quaternion_to_matrix


@dataclass
class Mapping:
    """Turns samples into targets. target: base-from-flange (4, 4), or None to stay.

    counts: messages taken and refused (invalid, or older than the last), jumps (stylus found elsewhere), how often the
        clutch was pressed, and silences (watchdog expired).
    """

    config: TeleopConfig
    target: Array | None = None
    counts: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        yaw = math.radians(self.config.yaw_deg)
        c, s = math.cos(yaw), math.sin(yaw)
        self._axes = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._scale = np.array(self.config.scale)
        self._low, self._high = np.array(self.config.workspace_low_m), np.array(self.config.workspace_high_m)
        self._filter = OneEuro(self.config.filter_hz, self.config.filter_hz_s_m)
        # Flange pose (4, 4), and position (3,) and rotation (3, 3) of the stylus, when the clutch was pressed.
        self._reference: tuple[Array, Array, Array] | None = None
        self._last: tuple[int, Array, Array] | None = None
        # A clutch that is held in the first message does not count: it must be released once.
        self._released = False

    def add_sample(self, sample: StylusSample, flange: Array) -> bool:
        """Process a message. flange: the commanded pose (4, 4). Returns False for a message that is invalid or
        older than the last one, which is counted and otherwise ignored."""
        if not sample.is_valid() or (self._last is not None and sample.t_ns <= self._last[0]):
            self.counts["refused"] += 1
            return False
        position, quaternion = sample.arrays()
        jumped = self._last is not None and self._jumped(position, quaternion)
        dt_s = 0.0 if self._last is None else (sample.t_ns - self._last[0]) / 1e9
        self._last = (sample.t_ns, position, quaternion)
        self.counts["taken"] += 1
        self.counts["jumps"] += jumped
        if jumped or not sample.clutch:
            self._release()
        if not sample.clutch:
            self._released = True
        elif self._released:
            self._follow(position, quaternion, dt_s, flange)
        return True

    def silence(self) -> None:
        """Stop following, because no message came for too long. The clutch must then be pressed again, and
        the stylus's clock may restart."""
        if self._last is not None:
            self.counts["silences"] += 1
        self._release()
        self._last, self._released = None, False

    def _release(self) -> None:
        self._reference = self.target = None
        self._filter.reset()

    def _jumped(self, position: Array, quaternion: Array) -> bool:
        assert self._last is not None
        _, before, turned = self._last
        angle = 2.0 * math.acos(min(1.0, abs(float(turned @ quaternion))))
        return bool(np.abs(position - before).max() > self.config.jump_m or angle > self.config.jump_rad)

    def _follow(self, position: Array, quaternion: Array, dt_s: float, flange: Array) -> None:
        position, quaternion = self._filter(position, quaternion, dt_s)
        rotation = quaternion_to_matrix(quaternion)
        if self._reference is None:
            self._reference = flange.copy(), position.copy(), rotation
            self.counts["pressed"] += 1
        flange_0, position_0, rotation_0 = self._reference
        target = flange_0.copy()
        moved = flange_0[:3, 3] + self._scale * (self._axes @ (position - position_0))
        # The target stays inside the box and returns from its wall together with the stylus.
        target[:3, 3] = np.clip(moved, self._low, self._high)
        if self.config.orientation:
            turn = self._axes @ rotation @ rotation_0.T @ self._axes.T
            # Products of rotations drift; the conversion to a quaternion keeps them rigid.
            target[:3, :3] = quaternion_to_matrix(matrix_to_quaternion(turn)) @ flange_0[:3, :3]
        self.target = target
