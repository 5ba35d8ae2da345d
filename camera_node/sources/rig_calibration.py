"""Calibration JSON of a video rig: one entry a camera, in OpenCV's terms.

    {"cam01": {"width": 1080, "height": 1920, "K": [[...]], "dist_k1k2p1p2": [...],
               "R_world_to_cam": [[...]], "t_world_to_cam": [...]}, ...}

``K`` counts pixel centres as whole numbers, as OpenCV does, and gains 0.5 here. ``R`` and ``t`` take world
points to camera axes (metres); they may be absent where a trajectory gives the poses.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError
from freshfield.geometry import GeometryError, Pinhole, Pose, se3_inverse


@dataclass(frozen=True)
class Calibrated:
    intrinsics: Pinhole
    pose: Pose | None


def load_calibration(file: Path) -> dict[str, Calibrated]:
    """Cameras by name. Raises DatasetError naming file, camera and entry."""
    try:
        data = json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DatasetError(f"{file}: cannot be read as JSON: {error}") from None
    if not isinstance(data, dict) or not data or not all(isinstance(c, dict) for c in data.values()):
        raise DatasetError(f"{file}: expected a mapping from camera name to its calibration")
    return {str(name): _camera(entry, f"{file}: {name}") for name, entry in data.items()}


def _camera(entry: dict[str, Any], where: str) -> Calibrated:
    k = _array(entry, "K", (3, 3), where)
    distortion = _array(entry, "dist_k1k2p1p2", (4,), where) if "dist_k1k2p1p2" in entry else np.zeros(4)
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
        return Calibrated(intrinsics, None)
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = _array(entry, "R_world_to_cam", (3, 3), where)
    world_to_camera[:3, 3] = _array(entry, "t_world_to_cam", (3,), where)
    try:
        return Calibrated(intrinsics, Pose.from_matrix(se3_inverse(world_to_camera)))
    except GeometryError as error:
        raise DatasetError(f"{where}.R_world_to_cam: {error}") from None


def _array(entry: dict[str, Any], key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    try:
        value = np.array(entry[key], dtype=np.float64)
    except KeyError:
        raise DatasetError(f"{where}: {key} is missing") from None
    except (ValueError, TypeError):
        raise DatasetError(f"{where}.{key}: expected numbers") from None
    if value.shape != shape or not np.all(np.isfinite(value)):
        raise DatasetError(f"{where}.{key}: expected finite numbers of shape {shape}, got {value.shape}")
    return value
