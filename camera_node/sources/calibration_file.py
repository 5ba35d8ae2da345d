"""Calibration JSON of a camera rig: one entry a camera, in OpenCV's conventions.

    {"cam01": {"width": 1080, "height": 1920, "K": [[...]], "dist_k1k2p1p2": [...],
               "R_world_to_cam": [[...]], "t_world_to_cam": [...]}, ...}

In ``K`` pixel centers are whole numbers, as in OpenCV, so 0.5 is added here. ``R`` and ``t`` take world
points to camera axes (meters); they may be missing if a trajectory or an arm gives the poses. Any other key that says
something is refused, unless it is known to be harmless: names and numbers of cameras, errors of calibrations, dates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError, camera_to_world, errors_at, read_array, read_json
from camera_node.sources.datasets.transforms_keys import says_something
from freshfield.geometry import Array, Pinhole, Pose, se3_inverse

_READ = ("width", "height", "K", "dist_k1k2p1p2", "R_world_to_cam", "t_world_to_cam")
_HARMLESS = """
error_px std_fx_fy_cx_cy_k1_k2_p1_p2 camera_center_m
error errors error_std rms rmse rms_px rms_error reprojection_error reprojection_errors reprojection_error_px
mean_reprojection_error avg_reprojection_error per_view_errors views num_images images
name camera camera_name label id camera_id serial serial_number device make
date created calibrated_at calibration_date timestamp version comment description notes
"""
_MODELS = ("OPENCV", "opencv", "PINHOLE", "pinhole", "perspective", "plumb_bob")  # what is read, by its names
_UNITS = ("m", "meter", "meters", "metre", "metres", "px", "pixel", "pixels")


@dataclass(frozen=True)
class CalibratedCamera:
    """A calibrated camera. pose: None if the file has none."""

    intrinsics: Pinhole
    pose: Pose | None


def load_calibration(file: Path) -> dict[str, CalibratedCamera]:
    """Cameras by name. Raises DatasetError naming file, camera and entry."""
    if not file.exists():
        raise DatasetError(f"{file}: no such file: camera-node calibrate rig (or intrinsics, lenses alone) makes it")
    data = read_json(file)
    if not isinstance(data, dict) or not data or not all(isinstance(c, dict) for c in data.values()):
        raise DatasetError(f"{file}: expected a mapping from camera name to its calibration")
    return {str(name): _camera(entry, f"{file}: {name}") for name, entry in data.items()}


def calibration_entry(lens: Pinhole, camera_to_world: Array | None = None) -> dict[str, Any]:
    """A camera's entry, as ``load_calibration`` reads it. camera_to_world: (4, 4); None: the pose is not known."""
    matrix, distortion = lens.opencv()
    size = {"width": lens.width, "height": lens.height}
    entry: dict[str, Any] = {**size, "K": matrix.tolist(), "dist_k1k2p1p2": distortion.tolist()}
    if camera_to_world is not None:
        to_camera = se3_inverse(camera_to_world)
        entry |= {"R_world_to_cam": to_camera[:3, :3].tolist(), "t_world_to_cam": to_camera[:3, 3].tolist()}
    return entry


def _camera(entry: dict[str, Any], where: str) -> CalibratedCamera:
    entry = {key: value for key, value in entry.items() if value is not None}
    size = [entry.get(key) for key in ("width", "height")]
    # Keys that may repeat what is read -> what they may say.
    repeated: dict[str, Sequence[Any]] = dict.fromkeys(("camera_model", "model", "distortion_model"), _MODELS)
    repeated |= {"units": _UNITS, "unit": _UNITS, "image_width": size[:1], "image_height": size[1:]}
    repeated |= {key: [size] for key in ("image_size", "size", "resolution")}
    for key in sorted(entry.keys() - {*_HARMLESS.split(), *_READ}):
        if says_something(entry[key]) and entry[key] not in repeated.get(key, ()):
            raise DatasetError(
                f"{where}: {key} is not understood and may change the camera: say it by {', '.join(_READ)}, or "
                "undistort the pictures, and leave it out"
            )
    k = read_array(entry, "K", (3, 3), where)
    distortion = read_array(entry, "dist_k1k2p1p2", (4,), where) if "dist_k1k2p1p2" in entry else np.zeros(4)
    if not all(isinstance(v, int) and v > 0 for v in size):
        raise DatasetError(f"{where}: width and height are {size}, expected positive whole numbers")
    if k[0, 0] <= 0 or k[1, 1] <= 0 or abs(k[0, 1]) > 1e-6 * k[0, 0]:
        raise DatasetError(f"{where}.K: expected positive focal lengths and no skew")
    intrinsics = Pinhole.from_opencv(entry["width"], entry["height"], k, distortion)
    if "R_world_to_cam" not in entry:
        return CalibratedCamera(intrinsics, None)
    rotation = read_array(entry, "R_world_to_cam", (3, 3), where)
    translation = read_array(entry, "t_world_to_cam", (3,), where)
    with errors_at(f"{where}.R_world_to_cam"):
        return CalibratedCamera(intrinsics, Pose.from_matrix(camera_to_world(rotation, translation)))
