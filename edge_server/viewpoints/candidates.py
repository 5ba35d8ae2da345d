"""Candidate viewpoints: discrete camera poses around a target (thesis 4.9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge_server.viewpoints import viewpoint_constants as tuned
from freshfield.geometry import Pinhole, look_at

Array = NDArray[np.float64]

_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


class ViewpointError(ValueError):
    """Viewpoints that cannot be planned; the message says what to change."""


@dataclass(frozen=True)
class Candidates:
    """Viewpoints to choose from.

    poses: (N, 4, 4) camera-to-world, meters.
    lens: intrinsics of the camera that is carried from one to the next.
    target: (3,) the point that is looked at; paths go round it.
    reachable: (N,) whether the robot gets there; all of them unless ``within`` says otherwise.
    bounds: (2, 3) lower and upper corner of the object; None: not known.
    """

    poses: Array
    lens: Pinhole
    target: Array
    reachable: NDArray[np.bool_]
    bounds: Array | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def within(self, reachable: ArrayLike) -> Candidates:
        """The same candidates, reachable where they were and where ``reachable`` (N,) is true."""
        return replace(self, reachable=self.reachable & np.asarray(reachable, bool))

    @property
    def directions(self) -> Array:
        """(N, 3) unit vectors from the target to the cameras."""
        away = self.poses[:, :3, 3] - self.target
        return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)


def half_hemisphere(
    target: ArrayLike,
    radius_m: float,
    lens: Pinhole,
    count: int,
    azimuths_deg: tuple[float, float] = (-90.0, 90.0),
    offset: float = 0.5,
) -> Candidates:
    """``count`` viewpoints that cover a sector of a sphere evenly and look at its center.

    target: (3,) center of the sphere, meters. lens: intrinsics of the camera.
    azimuths_deg: of the sector; azimuth 0 is on the target's -y side, 90 on its +x side.
    offset: shifts the azimuths, in parts of the sector: two sets of different offsets share no viewpoint.

    Raises ViewpointError unless ``count`` is 1 to MOST_CANDIDATES and ``radius_m`` is positive.
    """
    if not 1 <= count <= tuned.MOST_CANDIDATES or not radius_m > 0.0:
        raise ViewpointError(
            f"expected 1 to {tuned.MOST_CANDIDATES} candidates at a radius above 0, got {count} at {radius_m:g} m"
        )
    target = np.asarray(target, np.float64)
    k = np.arange(count)
    low, high = np.sin(np.deg2rad(tuned.CANDIDATE_ELEVATIONS_DEG))
    elevation = np.arcsin(low + (high - low) * (k + 0.5) / count)  # equal areas
    first, last = np.deg2rad(azimuths_deg)
    azimuth = first + (last - first) * ((offset + _GOLDEN * k) % 1.0)
    away = np.stack([np.cos(elevation) * np.sin(azimuth), -np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], -1)
    return from_poses([look_at(target + radius_m * a, target) for a in away], lens, target)


def from_poses(poses: Sequence[ArrayLike], lens: Pinhole, target: ArrayLike | None = None) -> Candidates:
    """Candidates at any poses (4, 4), all reachable.

    lens: intrinsics of the camera.
    target: (3,); None takes the point nearest to all lines of sight.
    Raises ViewpointError for no poses, or for poses that are not finite.
    """
    array = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    if not len(array):
        raise ViewpointError("no candidate viewpoints: give at least one pose")
    if not np.isfinite(array).all():
        raise ViewpointError("a candidate's pose is not finite")
    center = _looked_at(array) if target is None else np.asarray(target, np.float64)
    return Candidates(array, lens, center, np.ones(len(array), bool))


def _looked_at(poses: Array) -> Array:
    """(3,) the point with the least sum of squared distances to the cameras' lines of sight."""
    forward = poses[:, :3, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    right = (across @ poses[:, :3, 3, None]).sum(axis=0)[:, 0]
    # Parallel lines meet nowhere: of all points that fit, the one nearest to the origin.
    return np.linalg.lstsq(across.sum(axis=0), right, rcond=1e-9)[0]
