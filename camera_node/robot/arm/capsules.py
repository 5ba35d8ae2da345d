"""The arm as capsules: clearances between its parts and to the floor, for many postures at once.

The upper arm and the forearm are offset from the lines that the Denavit-Hartenberg parameters connect; their
offsets along the elbow's axis are those of the manufacturer's description (ur_description, ur3e). Radii are
read off the data sheet's drawing and rounded up.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from camera_node.robot.arm.kinematics import ArmModel
from freshfield.geometry import Array

PARTS = ("base", "shoulder", "upper arm", "forearm", "wrist 1", "wrist 2", "wrist 3", "tool")
# Pairs of parts that share a joint, or whose distance no joint changes.
_TOUCHING = {(0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (3, 5), (4, 5), (4, 6), (5, 6), (5, 7), (6, 7)}
PAIRS = tuple(pair for pair in itertools.combinations(range(len(PARTS)), 2) if pair not in _TOUCHING)
ABOVE_FLOOR = (3, 4, 5, 6, 7)
_UPPER_ARM_M, _FOREARM_M = 0.1198, 0.0273
_RADII_M = (0.064, 0.055, 0.046, 0.04, 0.036, 0.036, 0.033)


@dataclass(frozen=True)
class CapsuleModel:
    """Capsules of one arm with its tool.

    tool_m, tool_radius_m: length and radius of the tool, along the flange's axis, from the flange.
    """

    arm: ArmModel
    tool_m: float
    tool_radius_m: float

    def segments(self, frames: Array) -> tuple[Array, Array]:
        """Ends (T, 8, 3), (T, 8, 3) of the parts' axes, in the order of PARTS, from the ``link_frames``
        (T, 7, 4, 4) of the arm's ``nominal_model``."""
        at, z = frames[:, :, :3, 3], frames[:, :, :3, 2]
        upper, fore = _UPPER_ARM_M * z[:, 1], _FOREARM_M * z[:, 1]
        zero = np.zeros_like(at[:, 0])
        # A capsule extends one radius beyond each end of its axis; the tool's must begin at the flange.
        near = at[:, 6] + self.tool_radius_m * z[:, 6]
        far = at[:, 6] + max(self.tool_m - self.tool_radius_m, self.tool_radius_m) * z[:, 6]
        a = [zero, at[:, 1], at[:, 1] + upper, at[:, 2] + fore, at[:, 3] + fore, at[:, 4], at[:, 5], near]
        b = [at[:, 1], at[:, 1] + upper, at[:, 2] + upper, at[:, 3] + fore, at[:, 4], at[:, 5], at[:, 6], far]
        return np.stack(a, axis=1), np.stack(b, axis=1)

    @property
    def radii(self) -> Array:
        """(8,) meters, in the order of PARTS."""
        return np.array([*_RADII_M, self.tool_radius_m])

    def clearance(self, frames: Array) -> tuple[Array, Array]:
        """Clearances in meters, from the ``link_frames`` (T, 7, 4, 4) of the arm's ``nominal_model``: (T,
        pairs) between the surfaces of PAIRS, negative where they overlap, and the height (T,) of the lowest
        point beyond the upper arm."""
        a, b = self.segments(frames)
        first, second = np.array(PAIRS).T
        radii = self.radii
        apart = segment_distance(a[:, first], b[:, first], a[:, second], b[:, second])
        beyond = list(ABOVE_FLOOR)
        lowest = np.minimum(a[:, beyond, 2], b[:, beyond, 2]) - radii[beyond]
        return apart - (radii[first] + radii[second]), lowest.min(axis=1)


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances (...) between segments a-b and c-d, each end (..., 3); either may be a point.

    Ericson, Real-Time Collision Detection, 5.1.9.
    """
    u, v, r = b - a, d - c, a - c
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    ur, vr = _dot(u, r), _dot(v, r)
    tiny = 1e-18
    denominator = uu * vv - uv * uv
    # For parallel segments any point of one will do: the nearest point of the other is found and clamped.
    s = np.where(denominator > 1e-12 * uu * vv, (uv * vr - ur * vv) / np.maximum(denominator, tiny), 0.0).clip(0.0, 1.0)
    t = np.where(vv > tiny, (uv * s + vr) / np.maximum(vv, tiny), 0.0)
    clamped = t.clip(0.0, 1.0)
    s = np.where(uu > tiny, (clamped * uv - ur) / np.maximum(uu, tiny), 0.0).clip(0.0, 1.0)
    between = r + s[..., None] * u - clamped[..., None] * v
    return np.sqrt(_dot(between, between))


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("...i,...i->...", a, b)
