"""Poses and lenses of a rig from sightings of one target: start values, bundle adjustment, and what it is worth."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.calibration_constants import (
    FEW_SHARED,
    LARGEST_PX,
    MIN_SHARED,
    OUTLIER_ERROR,
    OUTLIER_PX,
)
from camera_node.robot.calibration.hand_eye.samples import medoid
from camera_node.robot.calibration.rig.bundle_adjustment import Bundle, Sighting, adjust
from camera_node.robot.calibration.targets import Array, Corners, estimate_pose
from camera_node.sources.calibration_file import calibration_entry
from freshfield.geometry import Pinhole, se3_inverse

# From a target's axes (y down, z away from the viewer) to the world's (z up where the target lies on the floor).
_UP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class RigCalibration:
    """A calibrated rig.

    poses: camera -> camera to world (4, 4). The world's axes are those of the target at ``origin``: origin in its top
        left corner, x to its right, y up along it, z out of it towards the viewer.
    lenses: by camera. error_px: root mean square reprojection error by camera.
    std_mm, std_deg: standard deviation of a camera's place and rotation relative to the first one, on each axis.
    moments: number of moments at which the target was seen.
    shared: moments that a pair of cameras saw the target at.
    unused: reason for each image that was left out.
    """

    poses: Mapping[str, Array]
    lenses: Mapping[str, Pinhole]
    error_px: Mapping[str, float]
    std_mm: Mapping[str, float]
    std_deg: Mapping[str, float]
    moments: int
    shared: Mapping[tuple[str, str], int]
    origin: str
    unused: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """The calibration file that source kinds camera, oak, realsense and video read."""
        return {
            camera: {**calibration_entry(self.lenses[camera], pose), "error_px": self.error_px[camera]}
            for camera, pose in self.poses.items()
        }

    def show(self) -> str:
        """The result for people."""
        first = next(iter(self.poses))
        lines = [f"{self.moments} moments; world: the target as it lay at {self.origin}, z out of it, meters"]
        for camera, pose in self.poses.items():
            at, sure = pose[:3, 3], f"+- {self.std_mm[camera]:.1f} mm, {self.std_deg[camera]:.2f} degrees"
            lines.append(
                f"{camera}: at {at[0]:.3f} {at[1]:.3f} {at[2]:.3f}, reprojection {self.error_px[camera]:.2f} px, "
                + (f"{sure} to {first}" if camera != first else "the reference")
            )
        lines += [f"{a} and {b} saw the target together at {count}" for (a, b), count in self.shared.items()]
        lines += [f"note: {name}: {why}" for name, why in self.unused.items()]
        lines += [
            f"note: {camera}: shares few moments with any other camera: hold the target where two see it"
            for camera in self.poses
            if max((n for pair, n in self.shared.items() if camera in pair), default=0) < FEW_SHARED
        ]
        return "\n".join(lines)


def calibrate_rig(
    views: Mapping[str, Mapping[str, Corners]],
    lenses: Mapping[str, Pinhole],
    refine_lenses: bool,
    origin: str | None = None,
) -> RigCalibration:
    """Calibrate a rig.

    views: camera -> moment -> corners of the target, which stood still at that moment.
    lenses: start values. refine_lenses: estimate them together with the poses.
    origin: the moment at which the target lay where the world's origin shall be; None: the first.
    Raises CalibrationError if two cameras are not connected by what they saw, or ``origin`` was not seen.
    """
    unused: dict[str, str] = {}
    seen: dict[tuple[str, str], Array] = {}
    for camera, in_view in views.items():
        for moment, corners in in_view.items():
            try:
                seen[camera, moment] = estimate_pose(corners, lenses[camera])
            except CalibrationError as error:
                unused[f"{camera} at {moment}"] = str(error)
    shared = _shared(seen)
    cameras = _chain(list(views), shared, seen)
    # A moment that one camera alone saw tells of its lens, not of the rig.
    moments = sorted({moment for _, moment in seen}, key=_natural)
    boards = {m: medoid([se3_inverse(cameras[c]) @ seen[c, m] for c in cameras if (c, m) in seen]) for m in moments}
    sightings = [Sighting(c, m, views[c][m]) for c in cameras for m in moments if (c, m) in seen]
    bundle = adjust(sightings, cameras, boards, lenses, refine_lenses)
    usual_px = float(np.median(bundle.error_px))
    if usual_px > LARGEST_PX:
        raise CalibrationError(
            f"what the cameras saw does not fit together (reprojection {usual_px:.0f} px): pictures of one moment are "
            "not of one instant, or the target moved: hold it still for longer"
        )
    limit = max(OUTLIER_PX, OUTLIER_ERROR * usual_px)
    if bundle.error_px.max() > limit:
        kept = [s for s, error in zip(sightings, bundle.error_px) if error <= limit]
        left_out = [s for s in sightings if s not in kept]
        unused |= {f"{s.camera} at {s.moment}": "does not fit the others, left out" for s in left_out}
        remaining = {s.moment for s in kept}
        lost = [c for c in cameras if not any(s.camera == c for s in kept)]
        if lost:
            raise CalibrationError(f"{lost[0]}: nothing that it saw fits the other cameras: one moment, one name?")
        boards = {m: pose for m, pose in bundle.boards.items() if m in remaining}
        sightings, bundle = kept, adjust(kept, bundle.cameras, boards, bundle.lenses, refine_lenses)
    origin = next(iter(bundle.boards)) if origin is None else origin
    if origin not in bundle.boards:
        raise CalibrationError(
            f"--origin {origin}: no camera saw the target then; there are {', '.join([*bundle.boards][:8])}"
        )
    return _result(list(views), bundle, sightings, origin, unused)


def _result(
    names: list[str], bundle: Bundle, sightings: list[Sighting], origin: str, unused: Mapping[str, str]
) -> RigCalibration:
    to_world = _UP @ se3_inverse(bundle.boards[origin])
    squares = {c: [e**2 for s, e in zip(sightings, bundle.error_px) if s.camera == c] for c in names}
    return RigCalibration(
        {c: to_world @ se3_inverse(bundle.cameras[c]) for c in names},
        {c: bundle.lenses[c] for c in names},
        {c: float(np.sqrt(np.mean(squares[c]))) for c in names},
        {c: float(np.sqrt(np.mean(bundle.std[c][3:] ** 2)) * 1e3) for c in names},
        {c: float(np.degrees(np.sqrt(np.mean(bundle.std[c][:3] ** 2)))) for c in names},
        len(bundle.boards),
        _shared({(s.camera, s.moment): None for s in sightings}),
        origin,
        unused,
    )


def _shared(seen: Mapping[tuple[str, str], Any]) -> dict[tuple[str, str], int]:
    """How many moments each pair of cameras has in common."""
    cameras = list(dict.fromkeys(camera for camera, _ in seen))
    at = {c: {m for camera, m in seen if camera == c} for c in cameras}
    return {(a, b): len(at[a] & at[b]) for a, b in itertools.combinations(cameras, 2)}


def _chain(
    names: list[str], shared: Mapping[tuple[str, str], int], seen: Mapping[tuple[str, str], Array]
) -> dict[str, Array]:
    """Start values of the cameras (4, 4), from the first one's axes to theirs.

    Each is joined to the one that it shares most moments with (a maximum spanning tree). Raises CalibrationError where
    there is none.
    """
    placed = {names[0]: np.eye(4)}
    while len(placed) < len(names):
        ways = {pair: n for pair, n in shared.items() if len(placed.keys() & set(pair)) == 1 and n >= MIN_SHARED}
        if not ways:
            lost = ", ".join(name for name in names if name not in placed)
            raise CalibrationError(
                f"{lost}: never saw the target at the same moment as {', '.join(placed)} (at least {MIN_SHARED} moments"
                " are needed): hold it where both see it"
            )
        pair = max(ways, key=lambda each: ways[each])
        known, new = pair if pair[0] in placed else pair[::-1]
        both = [m for c, m in seen if c == known and (new, m) in seen]
        placed[new] = medoid([seen[new, m] @ se3_inverse(seen[known, m]) for m in both]) @ placed[known]
    return placed


def _natural(name: str) -> list[tuple[float, str]]:
    """Key that sorts names by the numbers in them: 9 before 10."""
    return [(float(part), "") if part.isdecimal() else (-1.0, part) for part in re.split(r"(\d+)", name)]
