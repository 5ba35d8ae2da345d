"""Polycam, raw data of a LiDAR capture: one moving iPhone or iPad.

    keyframes/cameras/ID.json  width height fx fy cx cy, t_00 .. t_23 (camera-to-world, rows, OpenGL axes, y up)
    keyframes/images/ID.jpg    keyframes/depth/ID.png  millimeters, smaller than the image and registered to it

ID is the time in microseconds. Where Polycam has optimized the poses, ``corrected_cameras`` and ``corrected_images``
are read instead, as photos: without times, which say that a tracker (ARKit) gave the poses, so that they are refined.
The keys are read as nerfstudio's ``ns-process-data polycam`` reads them; the world is turned so that z points up.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageFiles, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, errors_at, file_within, read_array, read_json
from camera_node.sources.datasets.rgbd.depth_file import DepthFile
from freshfield.geometry import OPENGL_TO_OPENCV

FILES = ("keyframes/corrected_cameras", "keyframes/cameras")
_LENS = ("width", "height", "fx", "fy", "cx", "cy")
_MATRIX = [f"t_{row}{column}" for row in range(3) for column in range(4)]
_Y_UP_TO_Z_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The keyframes of a capture: its folder, or one of its folders of cameras. Raises DatasetError."""
    cameras = next((path / name for name in FILES if (path / name).is_dir()), path)
    folder, which = cameras.parent, cameras.name.removesuffix("cameras")
    found = ImageFiles(folder, options, str(cameras))
    files = sorted(cameras.glob("*.json"), key=lambda file: (len(file.stem), file.stem))  # of numbers: by time
    tracked = not which and all(file.stem.isdecimal() for file in files)
    for file in files:
        where, entry = str(file), read_json(file)
        if not isinstance(entry, dict):
            raise DatasetError(f"{file}: expected Polycam's mapping of a camera")
        width, height, fx, fy, cx, cy = (float(read_array(entry, key, (), where)) for key in _LENS)
        pose = np.array([float(read_array(entry, key, (), where)) for key in _MATRIX]).reshape(3, 4)
        with errors_at(where):
            lens = Lens(int(width), int(height), fx, fy, cx, cy)
            depth = file_within(folder, f"depth/{file.stem}.png")
        turned = _Y_UP_TO_Z_UP @ pose @ OPENGL_TO_OPENCV
        time_s = (int(file.stem) - int(files[0].stem)) / 1e6 if tracked else None
        image, reader = f"{which}images/{file.stem}", DepthFile(depth).read if depth else None
        found.add(file.stem, image, lens, turned, where, endings=(".jpg", ".png"), time_s=time_s, depth=reader)
    return found.dataset()
