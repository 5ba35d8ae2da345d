"""Hand-eye calibration from samples or streams by every method, with uncertainty and warnings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from camera_node.robot.arm.hand_eye_mount import MAX_OFFSET_S
from camera_node.robot.calibration import DEFAULT_METHOD, MAX_GAP_S, CalibrationError
from camera_node.robot.calibration.hand_eye.closed_form import METHODS, Residuals, solve
from camera_node.robot.calibration.hand_eye.refinement import Refinement, refine
from camera_node.robot.calibration.hand_eye.samples import Array, Diversity, Samples, require_diversity
from camera_node.robot.calibration.hand_eye.time_offset import StreamCalibration, calibrate_streams
from camera_node.robot.calibration.inputs import Track

REFINED = DEFAULT_METHOD
ALL_METHODS = (*METHODS, REFINED)
# With fewer poses, each method's own scatter is as large as the differences between methods.
_GOOD_POSES = 10
_LARGE_RESIDUAL_DEG, _LARGE_RESIDUAL_MM = 3.0, 20.0
# Of a sample that does not fit the others: less is the detector's noise, beside an arm that has nearly none.
_NOTABLE_DEG, _NOTABLE_MM = 0.5, 1.0
# Larger values mean wrong input: inverted poses, millimeters, or poses of another body.
_WORST_DEG, _WORST_MM, _FARTHEST_M = 15.0, 100.0, 5.0
_ADVICE = "are the poses flange in base and target in camera, not their inverses, in meters, and is the set-up right?"


@dataclass(frozen=True)
class Calibration:
    """Result of a hand-eye calibration.

    method: the one asked for; transform, residuals: its X (4, 4) and residuals.
    results: X (4, 4) by every method, or why it found none.
    timed: the time offset, for two streams.
    warnings: one line each.
    """

    samples: Samples
    method: str
    transform: Array
    residuals: Residuals
    results: dict[str, Array | str]
    refined: Refinement
    diversity: Diversity
    timed: StreamCalibration | None
    warnings: tuple[str, ...]

    @property
    def time_offset_s(self) -> float:
        return 0.0 if self.timed is None else self.timed.offset_s

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON, as ``--json`` prints it."""
        residual_mm, residual_deg = self.residuals.rms
        return {
            "transform": self.transform.tolist(),
            "time_offset_s": self.time_offset_s,
            "residual_mm": residual_mm,
            "residual_deg": residual_deg,
            "method": self.method,
            "std_mm": self.refined.std_mm,
            "std_deg": self.refined.std_deg,
            "warnings": list(self.warnings),
        }


def calibrate(samples: Samples, method: str = REFINED) -> Calibration:
    """Calibrate with every method; ``method`` names the one that gives the result. Raises CalibrationError if
    the samples do not determine X."""
    require_diversity(samples)
    return _calibration(samples, method, refine(samples), None)


def calibrate_tracks(
    flange: Track, target: Track, setup: str, method: str = REFINED, max_gap_s: float = MAX_GAP_S
) -> Calibration:
    """Calibrate from two streams with an unknown time offset; see ``calibrate``. Raises CalibrationError."""
    timed = calibrate_streams(flange, target, setup, max_gap_s)
    return _calibration(timed.samples, method, timed.refined, timed)


def _calibration(samples: Samples, method: str, refined: Refinement, timed: StreamCalibration | None) -> Calibration:
    results: dict[str, Array | str] = {}
    for name in METHODS:
        try:
            results[name] = solve(samples, name)
        except CalibrationError as error:
            results[name] = str(error)
    results[REFINED] = refined.x
    chosen = results[method]
    if isinstance(chosen, str):
        raise CalibrationError(chosen)
    off, spread = Residuals.of(samples, chosen), require_diversity(samples)
    _require_plausible(chosen, off)
    warnings = tuple(_warnings(samples, refined, off, spread, timed))
    return Calibration(samples, method, chosen, off, results, refined, spread, timed, warnings)


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
    noticed = [i for i in refined.outliers if off.mm[i] > _NOTABLE_MM or off.deg[i] > _NOTABLE_DEG]
    for i in noticed[:5]:
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
        out.append(f"{timed.unpaired} target poses have no flange pose near enough in time and are not used")
    return out
