"""Samples of a hand-eye calibration, their relative motions (4.4), (4.5), and whether they suffice.

Both setups are one problem, G_i X T_i = Y, with T_i the target in the camera: for eye-in-hand G_i = H_i (flange
in base), X = camera in flange, Y = target in base; for eye-to-hand G_i = H_i^-1, X = camera in base, Y = target
in flange.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, SETUPS
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration import calibration_constants as tuned
from freshfield.geometry import Array, se3_inverse


@dataclass(frozen=True)
class Samples:
    """Samples of one setup.

    flange: (N, 4, 4) flange in base.
    target: (N, 4, 4) target in camera.
    names: for messages.
    Raises CalibrationError for other shapes and for numbers that are not finite.
    """

    flange: Array
    target: Array
    setup: str = EYE_IN_HAND
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.setup not in SETUPS:
            raise CalibrationError(f"setup: expected {' or '.join(SETUPS)}, got {self.setup!r}")
        for name, value in (("flange", self.flange), ("target", self.target)):
            if value.ndim != 3 or value.shape[1:] != (4, 4) or not np.isfinite(value).all():
                raise CalibrationError(f"{name}: expected finite 4 x 4 matrices, got shape {value.shape}")
        if len(self.flange) != len(self.target):
            raise CalibrationError(f"{len(self.flange)} poses of the flange, {len(self.target)} of the target")

    def __len__(self) -> int:
        return len(self.flange)

    @property
    def moved(self) -> Array:
        """G_i (N, 4, 4): flange in base, or base in flange."""
        return self.flange if self.setup == EYE_IN_HAND else se3_inverse(self.flange)

    def name(self, index: int) -> str:
        return self.names[index] if self.names else f"pose {index + 1}"

    def rescaled(self, scale: float) -> Samples:
        """The samples with distances to the target divided by ``scale``."""
        target = self.target.copy()
        target[:, :3, 3] /= scale
        return replace(self, target=target)

    def subsample(self, most: int) -> Samples:
        """At most ``most`` samples, evenly spaced over the recording, without their names."""
        if len(self) <= most:
            return self
        at = np.linspace(0, len(self) - 1, most).round().astype(np.intp)
        return replace(self, flange=self.flange[at], target=self.target[at], names=())


def rotation_vectors(rotations: Array) -> Array:
    """Rotation vectors (..., 3) of one or N rotation matrices (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotations).as_rotvec(), dtype=np.float64)


def angle_deg(a: Array, b: Array) -> Array:
    """Angles (...) between the rotations of transforms (..., 4, 4)."""
    turns = np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3]
    return np.asarray(np.degrees(np.linalg.norm(rotation_vectors(turns), axis=-1)))


def distance_mm(a: Array, b: Array) -> Array:
    """Distances (...) between the origins of transforms (..., 4, 4) in meters."""
    return np.asarray(np.linalg.norm(a[..., :3, 3] - b[..., :3, 3], axis=-1) * 1e3)


def medoid(poses: ArrayLike) -> Array:
    """The pose (4, 4) of several (N, 4, 4) that is nearest to all others: one that is wrong does not move it."""
    given = np.asarray(poses, dtype=np.float64)
    distance = np.linalg.norm(given[:, None] - given, axis=(2, 3))
    return given[int(np.argmin(np.median(distance, axis=1)))]


@dataclass(frozen=True)
class Diversity:
    """Whether the motions between the samples determine X.

    motions: number of all pairs.
    half_turns: number of rotations by nearly half a turn, which do not count.
    axis_spread_deg: angle by which the axes of the other rotations deviate from parallel (35 if uniform).
    reason: why no calibration is possible, or None.
    """

    motions: int
    half_turns: int
    largest_turn_deg: float
    axis_spread_deg: float
    reason: str | None


def diversity(samples: Samples) -> Diversity:
    """Examine the motions between all pairs of samples (of at most 80)."""
    chosen = samples.subsample(tuned.MAX_SAMPLES)
    if len(chosen) < 2:
        return Diversity(0, 0, 0.0, 0.0, _too_few(len(samples)))
    first, second = np.triu_indices(len(chosen), 1)
    rotation = chosen.moved[:, :3, :3]
    turns = rotation_vectors(np.swapaxes(rotation[first], 1, 2) @ rotation[second])
    angles_deg = np.degrees(np.linalg.norm(turns, axis=1))
    small, half = angles_deg < tuned.MIN_TURN_DEG, angles_deg > 180.0 - tuned.HALF_TURN_MARGIN_DEG
    usable = ~small & ~half
    axes = turns[usable] / np.linalg.norm(turns[usable], axis=1, keepdims=True)
    # The mean of u u^T treats axes u and -u as one. Its second eigenvalue is sin^2 of the half angle of the
    # fan in which the axes lie, and 1/3 if they are uniform.
    values = np.linalg.eigh(axes.T @ axes / max(1, len(axes)))[0]
    spread_deg = float(np.degrees(np.arcsin(np.sqrt(np.clip(values[1], 0.0, 1.0)))))
    reason: str | None = None
    if len(samples) < tuned.MIN_POSES:
        reason = _too_few(len(samples))
    elif usable.sum() >= 2 and spread_deg < tuned.MIN_SPREAD_DEG:
        reason = (
            f"the flange has turned about parallel axes only (they spread by {spread_deg:.1f} degrees, at least "
            f"{tuned.MIN_SPREAD_DEG:g} are needed): the translation along them stays unknown; tilt it about another "
            "axis too"
        )
    elif usable.sum() < 2 and half.sum() >= small.sum():
        reason = "turns are near 180 degrees, where the axis' sign is lost; add poses turned by 20 to 90 degrees"
    elif usable.sum() < 2:
        reason = (
            f"the flange has hardly turned (by {angles_deg.max():.1f} degrees at most, {tuned.MIN_TURN_DEG:g} are "
            "needed): moving without turning says nothing about the translation; turn it by 20 to 90 degrees"
        )
    return Diversity(len(angles_deg), int(half.sum()), float(angles_deg.max()), spread_deg, reason)


def _too_few(count: int) -> str:
    return f"too few poses: {count}, at least {tuned.MIN_POSES} are needed and 10 to 20 are good"
