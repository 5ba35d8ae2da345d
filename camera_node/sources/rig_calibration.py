"""Calibration JSON of a camera rig: one entry a camera, in OpenCV's conventions.

    {"cam01": {"width": 1080, "height": 1920, "K": [[...]], "dist_k1k2p1p2": [...],
               "R_world_to_cam": [[...]], "t_world_to_cam": [...]}, ...}

In ``K`` pixel centers are whole numbers, as in OpenCV, so 0.5 is added here. ``R`` and ``t`` take world
points to camera axes (meters); they may be missing if a trajectory or an arm gives the poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError, camera_to_world, errors_at, read_array, read_json
from camera_node.sources.datasets.transforms_keys import refuse_suspect, says_something
from freshfield.geometry import Pinhole, Pose

_READ = {"width", "height", "K", "dist_k1k2p1p2", "R_world_to_cam", "t_world_to_cam"}


@dataclass(frozen=True)
class CalibratedCamera:
    """A calibrated camera. pose: None if the file has none."""

    intrinsics: Pinhole
    pose: Pose | None


def load_calibration(file: Path) -> dict[str, CalibratedCamera]:
    """Cameras by name. Raises DatasetError naming file, camera and entry."""
    data = read_json(file)
    if not isinstance(data, dict) or not data or not all(isinstance(c, dict) for c in data.values()):
        raise DatasetError(f"{file}: expected a mapping from camera name to its calibration")
    return {str(name): _camera(entry, f"{file}: {name}") for name, entry in data.items()}


def _camera(entry: dict[str, Any], where: str) -> CalibratedCamera:
    for key in entry.keys() - _READ:
        if says_something(entry[key]):
            refuse_suspect(key, where)
    k = read_array(entry, "K", (3, 3), where)
    distortion = read_array(entry, "dist_k1k2p1p2", (4,), where) if "dist_k1k2p1p2" in entry else np.zeros(4)
    size = [entry.get(key) for key in ("width", "height")]
    if not all(isinstance(v, int) and v > 0 for v in size):
        raise DatasetError(f"{where}: width and height are {size}, expected positive whole numbers")
    if k[0, 0] <= 0 or k[1, 1] <= 0 or abs(k[0, 1]) > 1e-6 * k[0, 0]:
        raise DatasetError(f"{where}.K: expected positive focal lengths and no skew")
    intrinsics = Pinhole(
        int(entry["width"]),
        int(entry["height"]),
        float(k[0, 0]),
        float(k[1, 1]),
        float(k[0, 2]) + 0.5,
        float(k[1, 2]) + 0.5,
        tuple(map(float, distortion)),  # type: ignore[arg-type]
    )
    if "R_world_to_cam" not in entry:
        return CalibratedCamera(intrinsics, None)
    rotation = read_array(entry, "R_world_to_cam", (3, 3), where)
    translation = read_array(entry, "t_world_to_cam", (3,), where)
    with errors_at(f"{where}.R_world_to_cam"):
        return CalibratedCamera(intrinsics, Pose.from_matrix(camera_to_world(rotation, translation)))
