"""Cameras of a COLMAP model, scaled by a known distance between two of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.targets import Array
from camera_node.sources.datasets.colmap import load_dataset
from camera_node.sources.rig_calibration import calibration_entry
from freshfield.geometry import Pinhole


@dataclass(frozen=True)
class ScaledModel:
    """Cameras in meters, in the model's axes.

    poses: camera -> camera to world (4, 4). lenses: by camera. scale: meters in a unit of the model.
    """

    poses: Mapping[str, Array]
    lenses: Mapping[str, Pinhole]
    scale: float

    def to_json(self) -> dict[str, Any]:
        """The calibration file that source kinds camera, oak, realsense and video read."""
        return {camera: calibration_entry(self.lenses[camera], pose) for camera, pose in self.poses.items()}

    def show(self) -> str:
        lines = [f"{len(self.poses)} cameras; a unit of the model is {self.scale:.6g} m; world: the model's axes"]
        lines += [
            f"{name}: at {x:.3f} {y:.3f} {z:.3f}" for name, (x, y, z) in ((n, p[:3, 3]) for n, p in self.poses.items())
        ]
        return "\n".join(lines)


def read_scaled_model(folder: Path, first: str, second: str, meters: str) -> ScaledModel:
    """Read a model with its images.

    folder: of the model. first, second: cameras whose distance is ``meters``.
    An image belongs to the camera that its folder, else its file, is named after; the first one of a camera counts.
    Raises CalibrationError, and DatasetError where the model cannot be read.
    """
    try:
        length = float(meters)
    except ValueError:
        length = math.nan
    if not 1e-3 <= length <= 1e4:
        raise CalibrationError(f"--length: expected meters, 0.001 to 10000, got {meters!r}")
    poses: dict[str, Array] = {}
    lenses: dict[str, Pinhole] = {}
    for image in load_dataset(folder).images:
        path = PurePosixPath(image.name)
        camera = path.parts[-2] if len(path.parts) > 1 else path.stem
        if camera not in poses:
            poses[camera], lenses[camera] = np.array(image.camera_to_world), image.intrinsics
    for name in (first, second):
        if name not in poses:
            raise CalibrationError(f"--length: the model has no camera {name}; it has {', '.join(list(poses)[:8])}")
    apart = float(np.linalg.norm(poses[first][:3, 3] - poses[second][:3, 3]))
    if not apart > 1e-9:
        raise CalibrationError(f"--length: {first} and {second} stand at one place in the model")
    scale = length / apart
    for pose in poses.values():
        pose[:3, 3] *= scale
    return ScaledModel(poses, lenses, scale)
