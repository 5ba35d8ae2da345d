"""A picture of a rig: where its cameras stand, where they look, and where the target was."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.targets import Array


def draw_rig(file: Path, poses: Mapping[str, Array], boards: Mapping[str, Array]) -> None:
    """Write the picture. poses: camera -> camera to world (4, 4). boards: moment -> target to world. Raises
    CalibrationError where matplotlib or the folder is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise CalibrationError("--plot needs matplotlib (pip install 'freshfield[calibrate]')") from None
    figure = Figure(figsize=(10, 5), layout="constrained")
    places = np.array([pose[:3, 3] for pose in poses.values()])
    reach = 0.2 * max(0.1, float(np.ptp(places, axis=0).max()))
    for axes, (across, up), title in zip(figure.subplots(1, 2), ((0, 1), (0, 2)), ("from above", "from the side")):
        for pose in boards.values():
            axes.plot(pose[across, 3], pose[up, 3], "s", color="0.6", markersize=3)
        names: dict[tuple[float, float], list[str]] = {}  # by place: cameras may stand behind each other
        for camera, pose in poses.items():
            at, ahead = pose[:3, 3], pose[:3, 3] + reach * pose[:3, 2]
            axes.plot([at[across], ahead[across]], [at[up], ahead[up]], color="tab:blue")
            axes.plot(at[across], at[up], "o", color="tab:blue")
            x, y = (reach / 4 * round(4 / reach * float(at[axis])) for axis in (across, up))
            names.setdefault((x, y), []).append(camera)
        for place, cameras in names.items():
            axes.annotate(", ".join(cameras), place, textcoords="offset points", xytext=(4, 4))
        axes.plot(0, 0, "+", color="black")
        axes.margins(0.2)
        axes.set(title=title, xlabel="x, m", ylabel=f"{'xyz'[up]}, m", aspect="equal", adjustable="datalim")
        axes.grid(alpha=0.3)
    try:
        figure.savefig(file, dpi=120)
    except (OSError, ValueError) as error:
        raise CalibrationError(f"--plot: {file}: {error}") from None
