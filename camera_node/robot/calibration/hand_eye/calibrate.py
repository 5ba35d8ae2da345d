"""Hand-eye calibration from samples or streams by every method, with uncertainty and warnings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from camera_node.robot.arm.hand_eye_mount import MAX_OFFSET_S
from camera_node.robot.calibration import DEFAULT_METHOD, MAX_GAP_S, CalibrationError
from camera_node.robot.calibration.files import Track
from camera_node.robot.calibration.hand_eye.closed_form import METHODS, Residuals, residuals, solve
from camera_node.robot.calibration.hand_eye.joint_refinement import Refinement, refine
from camera_node.robot.calibration.hand_eye.samples import Array, Diversity, Samples, angles, require_diversity
from camera_node.robot.calibration.hand_eye.time_offset import StreamCalibration, calibrate_streams

REFINED = DEFAULT_METHOD
ALL_METHODS = (*METHODS, REFINED)
# With fewer poses, each method's own scatter is as large as the differences between methods.
_GOOD_POSES = 10
_LARGE_RESIDUAL_DEG, _LARGE_RESIDUAL_MM = 3.0, 20.0
# Larger values mean wrong input: inverted poses, millimeters, or poses of another body.
_WORST_DEG, _WORST_MM, _FARTHEST_M = 15.0, 100.0, 5.0
_ADVICE = "are the poses hand in base and target in camera, not their inverses, in meters, and is the set-up right?"
_EXACT_ARM = (1e-6, 1e-6)  # radians, meters: negligible beside the noise of any camera


@dataclass(frozen=True)
class MethodResult:
    """Result of one method.

    transform, residuals: None if the method found no solution; ``error`` then says why.
    from_refined_deg, from_refined_mm: distance from the refinement's result.
    """

    method: str
    transform: Array | None
    residuals: Residuals | None
    from_refined_deg: float = 0.0
    from_refined_mm: float = 0.0
    error: str = ""


@dataclass(frozen=True)
class Calibration:
    """Result of a hand-eye calibration.

    method: the one asked for; transform, residuals: its X (4, 4) and residuals.
    rows: results of every method.
    exact_arm: the refinement with the arm taken as exact, if the target's covariance is known.
    timed: the time offset, for two streams.
    warnings: one line each.
    """

    samples: Samples
    method: str
    transform: Array
    residuals: Residuals
    rows: tuple[MethodResult, ...]
    refined: Refinement
    diversity: Diversity
    exact_arm: MethodResult | None = None
    timed: StreamCalibration | None = None
    warnings: tuple[str, ...] = ()

    @property
    def time_offset_s(self) -> float:
        return 0.0 if self.timed is None else self.timed.offset_s

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON, as ``--json`` prints it."""
        return {
            "transform": self.transform.tolist(),
            "time_offset_s": self.time_offset_s,
            "residual_mm": self.residuals.rms_mm,
            "residual_deg": self.residuals.rms_deg,
            "method": self.method,
            "std_mm": self.refined.std_mm,
            "std_deg": self.refined.std_deg,
            "warnings": list(self.warnings),
        }


def calibrate(samples: Samples, method: str = REFINED) -> Calibration:
    """Calibrate with every method; ``method`` names the one that gives the result. Raises CalibrationError if
    the samples do not determine X."""
    spread = require_diversity(samples)
    return _calibration(samples, method, refine(samples), spread, None)


def calibrate_tracks(
    hand: Track, target: Track, setup: str, method: str = REFINED, max_gap_s: float = MAX_GAP_S
) -> Calibration:
    """Calibrate from two streams with an unknown time offset; see ``calibrate``. Raises CalibrationError."""
    timed = calibrate_streams(hand, target, setup, max_gap_s)
    return _calibration(timed.samples, method, timed.refined, require_diversity(timed.samples), timed)


def angle_deg(a: Array, b: Array) -> float:
    """Angle between the rotations of two transforms (4, 4)."""
    return float(np.degrees(angles(a[:3, :3].T @ b[:3, :3])))


def distance_mm(a: Array, b: Array) -> float:
    """Distance between the origins of two transforms (4, 4) in meters."""
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]) * 1e3)


def _calibration(
    samples: Samples, method: str, refined: Refinement, spread: Diversity, timed: StreamCalibration | None
) -> Calibration:
    def row(name: str, find: Callable[[], Array]) -> MethodResult:
        try:
            x = find()
        except CalibrationError as error:
            return MethodResult(name, None, None, error=str(error))
        return MethodResult(name, x, residuals(samples, x), angle_deg(refined.x, x), distance_mm(refined.x, x))

    rows = [row(name, lambda name=name: solve(samples, name)) for name in METHODS]  # type: ignore[misc]
    rows.append(row(REFINED, lambda: refined.x))
    chosen = next(r for r in rows if r.method == method)
    if chosen.transform is None or chosen.residuals is None:
        raise CalibrationError(chosen.error)
    _require_plausible(chosen.transform, chosen.residuals)
    exact = None
    if samples.covariance is not None:
        start = (refined.x, refined.y)
        exact = row("exact arm", lambda: refine(samples, start, arm_noise=_EXACT_ARM).x)
    return Calibration(
        samples,
        method,
        chosen.transform,
        chosen.residuals,
        tuple(rows),
        refined,
        spread,
        exact,
        timed,
        tuple(_warnings(samples, refined, chosen.residuals, spread, timed)),
    )


def _require_plausible(transform: Array, off: Residuals) -> None:
    """Raise CalibrationError for a result that cannot be right. Medians ignore a few outliers."""
    median_mm, median_deg = off.medians
    if median_mm > _WORST_MM or median_deg > _WORST_DEG:
        raise CalibrationError(
            f"the poses do not fit together (residuals {median_mm:.0f} mm, {median_deg:.1f} degrees in the "
            f"median): {_ADVICE}"
        )
    distance_m = float(np.linalg.norm(transform[:3, 3]))
    if distance_m > _FARTHEST_M:
        raise CalibrationError(f"the camera would be {distance_m:.1f} m away: {_ADVICE}")


def _warnings(
    samples: Samples, refined: Refinement, off: Residuals, spread: Diversity, timed: StreamCalibration | None
) -> list[str]:
    out = []
    if len(samples) < _GOOD_POSES:
        out.append(f"{len(samples)} poses: {_GOOD_POSES} to 20 well spread ones are worth their time")
    if spread.half_turns:
        out.append(
            f"{spread.half_turns} of {spread.motions} motions turn by nearly 180 degrees, which upsets Tsai-Lenz"
        )
    median_mm, median_deg = off.medians
    if median_mm > _LARGE_RESIDUAL_MM or median_deg > _LARGE_RESIDUAL_DEG:
        out.append(f"residuals are large ({median_mm:.1f} mm, {median_deg:.1f} degrees in the median): {_ADVICE}")
    for i in refined.outliers[:5]:
        out.append(
            f"{samples.name(i)} does not fit the others (off by {off.mm[i]:.1f} mm, {off.deg[i]:.2f} "
            f"degrees) and counts for {refined.weights[i]:.2f}"
        )
    if timed is not None and abs(timed.offset_s) >= MAX_OFFSET_S:
        out.append(
            f"the time offset is {timed.offset_s:.0f} s: the two streams count from different beginnings, "
            "and no node can use it: give both on the clocks that it will meet"
        )
    if timed is not None and timed.unpaired:
        out.append(f"{timed.unpaired} target poses have no hand pose near enough in time and are not used")
    return out
