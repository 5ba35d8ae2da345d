"""A simulated arm with a camera over a target, with known truth: X is CAMERA_IN_FLANGE, Y TARGET_IN_BASE. Everything
is within half a meter of the base, as on the table of a UR3e."""

from __future__ import annotations

import numpy as np

from camera_node.robot.calibration.hand_eye.samples import Array, Rotation
from freshfield.geometry import look_at, se3, se3_inverse, so3_exp

# The arm's noise in the project's results.
ARM_RAD, ARM_M = 0.002, 0.0005
REACH_M = 0.5


def _rigid(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> Array:
    return se3(so3_exp(turn), np.array(shift))


# The target lies on the table with its pattern upwards, so its z points into the table.
CAMERA_IN_FLANGE = _rigid((0.02, -0.03, 1.55), (0.055, -0.035, 0.045))
TARGET_IN_BASE = _rigid((np.pi, 0.0, 0.0), (0.14, 0.02, 0.0))
TARGET_MIDDLE = (0.22, -0.04, 0.0)


def random_flanges(count: int, rng: np.random.Generator, tilt_deg: float = 50.0) -> Array:
    """Flanges in base (N, 4, 4), with the camera looking at the target from all sides and with any roll.
    tilt_deg: largest angle of view from the vertical."""
    out: list[Array] = []
    while len(out) < count:
        azimuth, slope = rng.uniform(-np.pi, np.pi), np.deg2rad(tilt_deg) * np.sqrt(rng.uniform())
        camera = _camera(azimuth, slope, rng.uniform(0.17, 0.30), rng.uniform(-0.9, 0.9))
        camera[:3, 3] += rng.normal(0.0, 0.01, 3)
        flange = camera @ se3_inverse(CAMERA_IN_FLANGE)
        if np.linalg.norm(flange[:3, 3]) < REACH_M:
            out.append(flange)
    return np.array(out)


def _camera(azimuth: float, slope: float, distance_m: float, roll: float) -> Array:
    middle = np.array(TARGET_MIDDLE)
    to = [np.sin(slope) * np.cos(azimuth), np.sin(slope) * np.sin(azimuth), np.cos(slope)]
    out = look_at(middle + distance_m * np.array(to), middle, up=(1.0, 0.0, 0.0))
    out[:3, :3] = out[:3, :3] @ so3_exp([0.0, 0.0, roll])
    return out


def observed_targets(flanges: Array) -> Array:
    """Exact targets in camera (N, 4, 4)."""
    return np.asarray(se3_inverse(CAMERA_IN_FLANGE) @ se3_inverse(flanges) @ TARGET_IN_BASE)


def add_noise(poses: Array, rng: np.random.Generator, rad: float, meters: float) -> Array:
    """Poses with Gaussian noise: a rotation vector about the body's own axes, and a translation."""
    turns = Rotation.from_rotvec(rng.normal(0.0, rad, (len(poses), 3))).as_matrix()
    shifts = rng.normal(0.0, meters, (len(poses), 3))
    return se3(poses[:, :3, :3] @ turns, poses[:, :3, 3] + shifts)
