"""DyNeRF (Neural 3D Video): ``camXX.mp4`` files and ``poses_bounds.npy``, which LLFF defined.

``poses_bounds.npy`` has one row of 17 numbers a camera, in the order of the videos' names. The first 15 are a
3 x 5 matrix, row by row, with the columns: the camera's down, right and backwards axes in the world, its
position, and (height, width, focal length) of the images used for calibration. The last two, the nearest and
farthest depth, are not used. The principal point is the image center, and there is no distortion.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from camera_node.sources.calibration_file import CalibratedCamera
from camera_node.sources.datasets.image_reading import read_numbers
from camera_node.sources.datasets.photo import FULL_SIZE, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, errors_at, file_within
from camera_node.sources.datasets.video import Clip, rig_dataset
from camera_node.sources.source_constants import SAME_SHAPE
from freshfield.geometry import Pinhole, Pose

POSES = "poses_bounds.npy"
FILES = (POSES,)


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """Every frame of every video of a folder, or of its ``poses_bounds.npy``, as an image. Raises DatasetError."""
    file = path if path.is_file() else path / POSES
    rows = _rows(file)
    videos = sorted(file.parent.glob("cam*.mp4"))
    if len(videos) != len(rows):
        raise DatasetError(
            f"{file}: has poses of {len(rows)} cameras, its folder {len(videos)} videos cam*.mp4: "
            "they belong together in the order of their names"
        )
    with errors_at(str(file)):
        clips = [Clip(video) for video in videos if file_within(file.parent, video.name)]
    cameras = [_camera(row, clip, f"{file}: row {k}") for k, (row, clip) in enumerate(zip(rows, clips))]
    return rig_dataset({clip.path.stem: (camera, clip) for camera, clip in zip(cameras, clips)}, path, options)


def _rows(file: Path) -> np.ndarray:
    rows = read_numbers(file)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows) or rows.dtype.kind not in "fiu":
        raise DatasetError(f"{file}: expected numbers of shape (cameras, 17), got {rows.shape}")
    rows = rows.astype(np.float64)
    if not np.all(np.isfinite(rows)):
        raise DatasetError(f"{file}: row {int(np.argmin(np.isfinite(rows).all(axis=1)))} is not finite")
    return rows


def _camera(row: np.ndarray, clip: Clip, where: str) -> CalibratedCamera:
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4]
    if min(height, width, focal) <= 0:
        raise DatasetError(f"{where}: height, width, focal length are {height:g}, {width:g}, {focal:g}")
    x, y = clip.width / width, clip.height / height
    if not abs(x / y - 1.0) <= SAME_SHAPE:
        raise DatasetError(
            f"{where}: is of images of {width:g} x {height:g}, {clip.path.name} has {clip.width} x {clip.height}"
        )
    down, right, backwards, position = matrix[:, :4].T
    with errors_at(where):
        pose = Pose.from_matrix(np.stack([right, down, -backwards, position], axis=-1))
    lens = Pinhole(clip.width, clip.height, focal * x, focal * y, clip.width / 2.0, clip.height / 2.0)
    return CalibratedCamera(lens, pose)
