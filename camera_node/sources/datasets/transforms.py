"""Data sets described by a ``transforms.json``: nerfstudio, instant-ngp and NeRF-synthetic.

Poses are camera-to-world with OpenGL camera axes, converted to OpenCV's here. Intrinsics are given per file
or per frame (``fl_x fl_y cx cy w h k1 k2 p1 p2``, or ``camera_angle_x``); their pixel origin is the image's
corner, as in COLMAP. If frames have a ``time`` and a ``camera`` (or ``camera_label``), the data set is a
recording of a moving scene by several cameras.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any, get_args

import numpy as np

from camera_node.settings import Background
from camera_node.sources.datasets.imaging import read_image
from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageOptions, Photo, posed_photo
from camera_node.sources.datasets.records import Dataset, DatasetError, errors_at, find_files, path_within, read_json
from freshfield.geometry import OPENGL_TO_OPENCV

# First the files from which nerfstudio and NeRF-synthetic start a training.
FILES = ("transforms.json", "transforms_train.json", "transforms*.json")
_EXTENSIONS = ("", ".png", ".jpg", ".jpeg")
_FISHEYE = ("OPENCV_FISHEYE", "EQUIRECTANGULAR", "ORTHOPHOTO")


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The images of a transforms JSON, or of the first one in a folder that has images.

    Entries without an image file are counted as missing. Raises DatasetError.
    """
    if options.background not in get_args(Background):
        raise DatasetError(f"background is {options.background!r}: expected one of {', '.join(get_args(Background))}")
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    tried = []
    for file in [path] if path.is_file() else find_files(path, FILES):
        dataset = _load(file, options)
        if dataset.images:
            return dataset
        tried.append(f"{file.name} (all {dataset.missing} images missing)")
    raise DatasetError(f"{path}: no usable transforms JSON: {'; '.join(tried) or 'none found'}")


def _load(file: Path, options: ImageOptions) -> Dataset:
    data = read_json(file)
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise DatasetError(f"{file}: expected a mapping with a list 'frames'")
    images, missing = [], 0
    sizes: dict[str, tuple[int, int]] = {}
    for number, frame in enumerate(frames):
        where = f"{file}: frames[{number}]"
        image = _find_image(file.parent, frame, where)
        if image is None:
            missing += 1
            continue
        camera = str(frame.get("camera", frame.get("camera_label", "")))
        photo = Photo(image, _lens({**data, **frame}, image, sizes, camera, where), options)
        time_s = _number(frame, "time", where) if "time" in frame else None
        images.append(posed_photo(photo, frame["file_path"], _pose(frame, where), where, camera, time_s))
    fps = _number(data, "fps", str(file)) if "fps" in data else None
    with errors_at(str(file)):
        return Dataset(tuple(images), missing, fps)


def _find_image(folder: Path, frame: dict[str, Any], where: str) -> Path | None:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise DatasetError(f"{where}: 'file_path' is missing")
    with errors_at(where):
        path_within(name)
    for extension in _EXTENSIONS:
        path = folder / (name + extension)
        if path.is_file():
            return path
    return None


def _pose(frame: dict[str, Any], where: str) -> np.ndarray:
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
        if matrix.shape != (4, 4):
            raise ValueError(f"its shape is {matrix.shape}")
        return matrix @ OPENGL_TO_OPENCV
    except KeyError:
        raise DatasetError(f"{where}: 'transform_matrix' is missing") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise DatasetError(f"{where}: transform_matrix is no camera-to-world matrix: {error}") from None


def _lens(d: dict[str, Any], image: Path, sizes: dict[str, tuple[int, int]], camera: str, where: str) -> Lens:
    if d.get("camera_model") in _FISHEYE:
        raise DatasetError(f"{where}: camera_model {d['camera_model']} is no pinhole; undistort the images")
    for name in ("k3", "k4", "k5", "k6"):
        if d.get(name):
            raise DatasetError(f"{where}: {name} is not zero; only k1, k2, p1, p2 are supported")
    if "w" in d and "h" in d:
        width, height = int(_number(d, "w", where)), int(_number(d, "h", where))
    else:  # NeRF-synthetic: all images of a camera have the size of its first one
        if camera not in sizes:
            sizes[camera] = read_image(image).shape[1::-1]
        width, height = sizes[camera]
    if "fl_x" in d:
        fx = _number(d, "fl_x", where)
        fy = _number(d, "fl_y", where) if "fl_y" in d else fx
    elif "camera_angle_x" in d:
        angle = _number(d, "camera_angle_x", where)
        if not 0 < angle < math.pi:
            raise DatasetError(f"{where}: camera_angle_x is {angle:g}, expected radians from 0 to pi")
        fx = fy = 0.5 * width / math.tan(0.5 * angle)
    else:
        raise DatasetError(f"{where}: neither 'fl_x' nor 'camera_angle_x' is given")
    if width < 1 or height < 1 or not (fx > 0 and fy > 0):
        raise DatasetError(f"{where}: size {width} x {height}, focal lengths {fx:g}, {fy:g} are impossible")
    k1, k2, p1, p2 = (_number(d, name, where) if name in d else 0.0 for name in ("k1", "k2", "p1", "p2"))
    cx = _number(d, "cx", where) if "cx" in d else width / 2.0
    cy = _number(d, "cy", where) if "cy" in d else height / 2.0
    with errors_at(where):
        return Lens(width, height, fx, fy, cx, cy, (k1, k2), (p1, p2))


def _number(d: dict[str, Any], key: str, where: str) -> float:
    value = d[key]
    # Compared, not converted: an integer of hundreds of digits fits no float.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise DatasetError(f"{where}: {key} is {value!r:.60}, expected a number")
    return float(value)
