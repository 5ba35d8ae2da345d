"""A simulated arm with a camera over a target, with known truth: X is CAMERA_IN_FLANGE, Y TARGET_IN_BASE. Everything
is within half a meter of the base, as on the table of a UR3e."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from camera_node.robot.calibration.hand_eye.samples import Array, Rotation
from camera_node.robot.calibration.inputs import Track
from freshfield.geometry import look_at, se3, se3_inverse, so3_exp

# The arm's noise in the project's results.
ARM_RAD, ARM_M = 0.002, 0.0005
REACH_M = 0.5
# Error of a detected target pose at this distance (measured with rendered images).
_DETECTION_RAD, _DETECTION_M = 0.0005, 0.0003


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


@dataclass(frozen=True)
class Sweep:
    """A flange that moves over the target along incommensurate sines, so that the motion never repeats.

    speed_m_per_s: mean speed of the camera, along the same path at every speed.
    """

    speed_m_per_s: float = 0.1

    # Mean speed at rate 1, measured over ten minutes.
    _NATURAL_M_PER_S = 0.1036

    def flanges(self, t_s: NDArray[np.float64]) -> Array:
        """Flange in base (N, 4, 4) at instants (N,)."""
        return np.asarray(self.cameras(t_s) @ se3_inverse(CAMERA_IN_FLANGE))

    def cameras(self, t_s: NDArray[np.float64]) -> Array:
        """Camera in base (N, 4, 4) at instants (N,)."""
        u = np.asarray(t_s) * (self.speed_m_per_s / self._NATURAL_M_PER_S)
        x = 0.55 * np.sin(0.61 * u) + 0.22 * np.sin(1.37 * u + 0.4)
        y = 0.50 * np.sin(0.83 * u + 1.1) + 0.20 * np.sin(1.73 * u)
        distance_m = 0.235 + 0.045 * np.sin(0.47 * u + 0.7)
        roll = 0.6 * np.sin(0.71 * u + 0.3) + 0.25 * np.sin(1.93 * u)
        slope, azimuth = np.hypot(x, y), np.arctan2(y, x)
        return np.array([_camera(*row) for row in zip(azimuth, slope, distance_m, roll)]).reshape(-1, 4, 4)


def streams(sweep: Sweep, seconds: float, offset_s: float, rng: np.random.Generator) -> tuple[Track, Track]:
    """Tracks of the flange at 125 Hz and of the target at 15 Hz, both noisy, with ``offset_s`` between their
    stamps."""
    flange_s = np.arange(0.0, seconds, 1 / 125.0)
    seen_s = np.arange(0.1, seconds - 0.1, 1 / 15.0) + float(rng.uniform(0.0, 0.05))
    flanges = add_noise(sweep.flanges(flange_s), rng, ARM_RAD, ARM_M)
    targets = observed_targets(sweep.flanges(seen_s))
    targets = add_noise(targets, rng, _DETECTION_RAD, _DETECTION_M)
    flange_ns = np.round((flange_s + offset_s) * 1e9).astype(np.int64)
    seen_ns = np.round(seen_s * 1e9).astype(np.int64)
    return Track(flange_ns, flanges), Track(seen_ns, targets)
