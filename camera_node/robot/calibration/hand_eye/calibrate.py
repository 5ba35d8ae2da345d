"""Hand-eye calibration by every method, with uncertainty and warnings, and the YAML that the node loads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND
from camera_node.robot.calibration import DEFAULT_METHOD, CalibrationError
from camera_node.robot.calibration import calibration_constants as tuned
from camera_node.robot.calibration.hand_eye.closed_form import METHODS, Residuals, solve
from camera_node.robot.calibration.hand_eye.refinement import Refinement, refine
from camera_node.robot.calibration.hand_eye.samples import (
    Array,
    Diversity,
    Samples,
    angle_deg,
    distance_mm,
    diversity,
    rotation_vectors,
)
from freshfield import files
from freshfield.untrusted import YamlWriter

REFINED = DEFAULT_METHOD
ALL_METHODS = (*METHODS, REFINED)
_ADVICE = "are the poses flange in base and target in camera, not their inverses, in meters, and is the set-up right?"


@dataclass(frozen=True)
class Calibration:
    """Result of a hand-eye calibration.

    method: the one asked for; transform, residuals: its X (4, 4) and residuals.
    results: X (4, 4) by every method, or why it found none.
    warnings: one line each.
    """

    samples: Samples
    method: str
    transform: Array
    residuals: Residuals
    results: dict[str, Array | str]
    refined: Refinement
    diversity: Diversity
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The result as JSON, as ``--json`` prints it."""
        residual_mm, residual_deg = self.residuals.rms
        return {
            "transform": self.transform.tolist(),
            "residual_mm": residual_mm,
            "residual_deg": residual_deg,
            "method": self.method,
            "std_mm": self.refined.std_mm,
            "std_deg": self.refined.std_deg,
            "warnings": list(self.warnings),
        }

    def show(self) -> str:
        """Format all methods' residuals, the result, its uncertainty and the warnings."""
        what = "camera in flange" if self.samples.setup == EYE_IN_HAND else "camera in base"
        x, y, z = self.transform[:3, 3]
        turn = ", ".join(f"{v:.5f}" for v in rotation_vectors(self.transform[:3, :3]))
        lines = [
            f"{len(self.samples)} poses, {self.samples.setup}; turns up to {self.diversity.largest_turn_deg:.0f} "
            f"degrees, axes spread by {self.diversity.axis_spread_deg:.0f} degrees "
            "(35 where they point everywhere alike)",
            "",
            f"{'method':12} {'residual mm':>12} {'degrees':>9}   {'from refined mm':>16} {'degrees':>9}",
            *(self._row(name, x) for name, x in self.results.items()),
            "",
            f"{what} ({self.method}): x {x:.5f}  y {y:.5f}  z {z:.5f} m, turned ({turn}) rad",
            f"  standard deviation {self.refined.std_mm:.3f} mm, {self.refined.std_deg:.4f} degrees",
            f"  the arm's noise, estimated: {self.refined.arm_noise_m * 1e3:.3f} mm, "
            f"{np.degrees(self.refined.arm_noise_rad):.4f} degrees an axis",
        ]
        return "\n".join([*lines, *(f"note: {warning}" for warning in self.warnings)])

    def _row(self, method: str, x: Array | str) -> str:
        if isinstance(x, str):
            return f"{method:12} {x}"
        mm, deg = Residuals.of(self.samples, x).rms
        away_mm, away_deg = distance_mm(self.refined.x, x), angle_deg(self.refined.x, x)
        return f"{method:12} {mm:12.3f} {deg:9.4f}   {away_mm:16.3f} {away_deg:9.4f}"

    def write(self, path: Path) -> None:
        """Write the file that ``hand_eye_mount.read_hand_eye`` reads. Raises CalibrationError."""
        answer = self.to_dict()
        data = {
            "setup": self.samples.setup,
            "transform": [[round(v, 9) for v in row] for row in answer.pop("transform")],
            "time_offset_s": 0.0,
            **answer,
            "poses": len(self.samples),
            "arm_noise_mm": self.refined.arm_noise_m * 1e3,
            "arm_noise_deg": float(np.degrees(self.refined.arm_noise_rad)),
        }
        text = yaml.dump(data, Dumper=YamlWriter, sort_keys=False, default_flow_style=None, width=200)
        try:
            files.write_text(path, text)
        except OSError as error:
            raise CalibrationError(f"--out: {path}: {error.strerror}") from None


def calibrate(
    samples: Samples, method: str = REFINED, square_m: float | None = None, fit_size: bool = False
) -> Calibration:
    """Calibrate with every method; ``method`` names the one that gives the result.

    square_m: side of the target's squares as said; None: unknown.
    fit_size: take the target's size from the arm's motion, where that shows another one than was said.
    Raises CalibrationError if the samples do not determine X.
    """
    spread = diversity(samples)
    if spread.reason is not None:
        raise CalibrationError(spread.reason)
    for what, poses in (("targets", samples.target), ("flanges", samples.flange)):
        if np.median(np.linalg.norm(poses[:, :3, 3], axis=1)) > tuned.MILLIMETERS_M:
            raise CalibrationError(f"{what} seem to be in millimeters: targets and flanges must be in meters")
    scaled = _refined_with_scale(samples) if fit_size else None
    if scaled is not None:
        samples = samples.rescaled(scaled.scale)
    refined = refine(samples)
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
    off = Residuals.of(samples, chosen)
    _require_plausible(chosen, off)
    if not fit_size:  # late: what does not fit together at all has been refused
        scaled = _refined_with_scale(samples)
    size = () if scaled is None else (_about_size(scaled, refined, square_m, fit_size),)
    warnings = (*size, *_warnings(samples, refined, off, spread))
    return Calibration(samples, method, chosen, off, results, refined, spread, warnings)


def _refined_with_scale(samples: Samples) -> Refinement | None:
    """The refinement with the target's size, where the arm's motion shows another one than was said."""
    if len(samples) < tuned.POSES_FOR_SCALE:
        return None
    found = refine(samples, with_scale=True)
    plausible = 1.0 / tuned.LARGEST_SCALE < found.scale < tuned.LARGEST_SCALE
    sure = abs(found.scale - 1.0) > max(tuned.NOTABLE_SCALE, tuned.SURE * found.scale_std)
    return found if plausible and sure else None


def _about_size(scaled: Refinement, refined: Refinement, square_m: float | None, fit_size: bool) -> str:
    percent, which = 100 * abs(scaled.scale - 1.0), "large" if scaled.scale > 1.0 else "small"
    squares = ""
    if square_m is not None:
        squares = f"your squares are {1e3 * square_m / scaled.scale:.3g} mm, not {1e3 * square_m:.3g}; "
    if fit_size:
        what = "this result is for that size"
    else:
        moved_mm = float(distance_mm(scaled.x, refined.x))
        what = f"measure it, or take it so with --fit-size, which puts the camera {moved_mm:.1f} mm elsewhere"
    return f"the board's size as said is {percent:.1f} % too {which} (+- {100 * scaled.scale_std:.1f}): {squares}{what}"


def _require_plausible(transform: Array, off: Residuals) -> None:
    """Raise CalibrationError for a result that cannot be right. Medians ignore a few outliers."""
    median_mm, median_deg = off.medians
    if median_mm > tuned.WORST_MM or median_deg > tuned.WORST_DEG:
        raise CalibrationError(
            f"the poses do not fit together (residuals {median_mm:.0f} mm, {median_deg:.1f} degrees in the "
            f"median): {_ADVICE}"
        )
    distance_m = float(np.linalg.norm(transform[:3, 3]))
    if distance_m > tuned.FARTHEST_M:
        raise CalibrationError(f"the camera would be {distance_m:.1f} m away: {_ADVICE}")


def _warnings(samples: Samples, refined: Refinement, off: Residuals, spread: Diversity) -> list[str]:
    out = []
    if len(samples) < tuned.GOOD_POSES:
        out.append(f"{len(samples)} poses: {tuned.GOOD_POSES} to 20 well spread ones are worth their time")
    if spread.half_turns:
        out.append(
            f"{spread.half_turns} of {spread.motions} motions turn by nearly 180 degrees, which upsets Tsai-Lenz"
        )
    median_mm, median_deg = off.medians
    if median_mm > tuned.LARGE_RESIDUAL_MM or median_deg > tuned.LARGE_RESIDUAL_DEG:
        out.append(f"residuals are large ({median_mm:.1f} mm, {median_deg:.1f} degrees in the median): {_ADVICE}")
    noticed = [i for i in refined.outliers if off.mm[i] > tuned.NOTABLE_MM or off.deg[i] > tuned.NOTABLE_DEG]
    for i in noticed[: tuned.WARNED_OUTLIERS]:
        out.append(
            f"{samples.name(i)} does not fit the others (off by {off.mm[i]:.1f} mm, {off.deg[i]:.2f} "
            f"degrees) and counts for {refined.weights[i]:.2f}"
        )
    return out
