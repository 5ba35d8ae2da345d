"""Output of a hand-eye calibration: a table, the YAML that the node loads, a plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, MAX_OFFSET_S
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.calibrate import Calibration
from camera_node.robot.calibration.hand_eye.closed_form import Residuals, target_at_rest
from camera_node.robot.calibration.hand_eye.samples import Array, angle_deg, distance_mm, rotation_vectors
from freshfield import files
from freshfield.untrusted import YamlWriter

_BLUE, _RED = "#0072B2", "#D55E00"


def show(found: Calibration) -> str:
    """Format all methods' residuals, the result, its uncertainty and the warnings."""
    what = "camera in flange" if found.samples.setup == EYE_IN_HAND else "camera in base"
    spread = found.diversity
    x, y, z = found.transform[:3, 3]
    turn = ", ".join(f"{v:.5f}" for v in rotation_vectors(found.transform[:3, :3]))
    lines = [
        f"{len(found.samples)} poses, {found.samples.setup}; turns up to {spread.largest_turn_deg:.0f} "
        f"degrees, axes spread by {spread.axis_spread_deg:.0f} degrees "
        "(35 where they point everywhere alike)",
        "",
        f"{'method':12} {'residual mm':>12} {'degrees':>9}   {'from refined mm':>16} {'degrees':>9}",
        *(_row(found, name, x) for name, x in found.results.items()),
        "",
        f"{what} ({found.method}): x {x:.5f}  y {y:.5f}  z {z:.5f} m, turned ({turn}) rad",
        f"  standard deviation {found.refined.std_mm:.3f} mm, {found.refined.std_deg:.4f} degrees",
        f"  the arm's noise, estimated: {found.refined.arm_noise_m * 1e3:.3f} mm, "
        f"{np.degrees(found.refined.arm_noise_rad):.4f} degrees an axis",
    ]
    if found.timed is not None:
        lines.append(
            f"time offset: {found.timed.offset_s * 1e3:.3f} ms (standard deviation "
            f"{found.refined.offset_std_s * 1e3:.3f} ms) to add to the camera's stamps to have the arm's; "
            f"correlation of the angular speeds {found.timed.correlation:.3f}"
        )
    return "\n".join([*lines, *(f"note: {warning}" for warning in found.warnings)])


def write_yaml(found: Calibration, path: Path) -> None:
    """Write the file that ``hand_eye_mount.read_hand_eye`` reads, with details of the calibration. Raises
    CalibrationError, also for a time offset that the node would refuse."""
    if abs(found.time_offset_s) >= MAX_OFFSET_S:
        raise CalibrationError(
            f"--out: {path} is not written: the node would refuse a time offset of "
            f"{found.time_offset_s:.0f} s: give both streams on clocks with one beginning"
        )
    answer = found.to_dict()
    warnings = answer.pop("warnings")
    data = {
        "setup": found.samples.setup,
        "transform": [[round(v, 9) for v in row] for row in answer.pop("transform")],
        **answer,
        "poses": len(found.samples),
        "arm_noise_mm": found.refined.arm_noise_m * 1e3,
        "arm_noise_deg": float(np.degrees(found.refined.arm_noise_rad)),
        "warnings": warnings,
    }
    text = yaml.dump(data, Dumper=YamlWriter, sort_keys=False, default_flow_style=None, width=200)
    try:
        files.write_text(path, text)
    except OSError as error:
        raise CalibrationError(f"--out: {path}: {error.strerror}") from None


def plot(found: Calibration, path: Path) -> None:
    """Plot residuals, rotation axes and each pose's target position. Raises CalibrationError."""
    try:
        with files.picture(path, 1, 3, size=(13, 4)) as ((bars, ball, places),):
            _plot_residuals(found, bars)
            _plot_axes(found, ball)
            _plot_places(found, places)
    except files.PlotError as error:
        raise CalibrationError(f"--plot: {error}") from None


def _plot_residuals(found: Calibration, bars: Any) -> None:
    count = np.arange(1, len(found.samples) + 1)
    bars.bar(count, found.residuals.mm, color=_BLUE)
    for i in found.refined.outliers:
        bars.bar(count[i], found.residuals.mm[i], color=_RED)
    bars.set(xlabel="pose", ylabel="residual (mm; red: not believed)")
    right = bars.twinx()
    right.plot(count, found.residuals.deg, ".", color="black")
    right.set_ylabel("residual (degrees, dots)")


def _plot_axes(found: Calibration, ball: Any) -> None:
    rotation = found.samples.subsample(40).moved[:, :3, :3]
    first, second = np.triu_indices(len(rotation), 1)
    turns = rotation_vectors(np.swapaxes(rotation[first], 1, 2) @ rotation[second])
    angle = np.linalg.norm(turns, axis=1)
    axes = turns / np.maximum(angle, 1e-12)[:, None]
    axes *= np.where(axes[:, 2:] < 0, -1.0, 1.0)  # an axis and its opposite are one
    drawn = ball.scatter(axes[:, 0], axes[:, 1], c=np.degrees(angle), s=8, vmin=0, vmax=180)
    ball.set(
        xlim=(-1.1, 1.1),
        ylim=(-1.1, 1.1),
        aspect="equal",
        xlabel="x",
        ylabel="y",
        title="axes of the turns, seen along z",
    )
    ball.figure.colorbar(drawn, ax=ball, label="turn (degrees)")


def _plot_places(found: Calibration, places: Any) -> None:
    put = target_at_rest(found.samples, found.transform)[:, :3, 3]
    put = (put - put.mean(axis=0)) * 1e3
    drawn = places.scatter(put[:, 0], put[:, 1], c=put[:, 2], s=25)
    places.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal", title="where each pose puts the target")
    places.figure.colorbar(drawn, ax=places, label="z (mm)")


def _row(found: Calibration, method: str, x: Array | str) -> str:
    if isinstance(x, str):
        return f"{method:12} {x}"
    mm, deg = Residuals.of(found.samples, x).rms
    away_mm, away_deg = distance_mm(found.refined.x, x), angle_deg(found.refined.x, x)
    return f"{method:12} {mm:12.3f} {deg:9.4f}   {away_mm:16.3f} {away_deg:9.4f}"
