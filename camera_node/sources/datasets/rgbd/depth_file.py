"""A file of a depth image: 16-bit PNG or TIFF, numpy's npy, or EXR, in the unit that its format or data set says."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.sources import source_constants as tuned
from camera_node.sources.datasets.image_reading import decode_file, read_numbers, shrink
from camera_node.sources.datasets.lens import Lens, pinhole, undistort
from camera_node.sources.datasets.photo import Photo
from camera_node.sources.datasets.records import DatasetError
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole, Pose
from freshfield.limits import USUAL_DEPTH_M

MILLIMETER = 0.001
_MOST_COUNTS = 65535


@dataclass(frozen=True)
class DepthFile:
    """A depth image, which is checked and converted when it is read.

    unit_m: meters of a 1 in the file; None: .001 for whole numbers, 1 for floating point.
    nothing: number that says, as 0 does, that nothing was measured.
    lens, to_camera: as in ``DepthImage``, of depth that is not registered to the image.
    """

    path: Path
    unit_m: float | None = None
    nothing: int = 0
    lens: Pinhole | None = None
    to_camera: Pose | None = None

    def read(self, photo: Photo) -> DepthImage:
        """The depth that belongs to ``photo``, as ``to_counts`` and ``registered`` make it. Raises DatasetError."""
        counts, unit = to_counts(_numbers(self.path), self.unit_m, str(self.path), self.nothing)
        if self.lens is None:
            return DepthImage(registered(counts, photo.lens, photo.options.scale, str(self.path)), unit)
        lens = self.lens.scaled(counts.shape[1] / self.lens.width)  # of a smaller copy
        if counts.shape != (lens.height, lens.width):
            raise DatasetError(f"{self.path}: {_size(counts)}, its sensor {self.lens.width} x {self.lens.height}")
        return DepthImage(counts, unit, lens, self.to_camera)


def to_counts(
    values: NDArray[Any], unit_m: float | None, where: str, nothing: int = 0
) -> tuple[NDArray[np.uint16], float]:
    """Counts of a depth image, and meters a count. Whole numbers stay as they are, others become whole millimeters.

    values: (H, W), 16 bits or floating point. unit_m, nothing: as in ``DepthFile``. where: for error messages.
    Raises DatasetError if the unit cannot be right.
    """
    unit = unit_m or (1.0 if values.dtype.kind == "f" else MILLIMETER)
    measured = np.isfinite(values) & (values > 0) & (values != nothing)
    middle_m = float(np.median(values[measured])) * unit if measured.any() else 1.0
    if not USUAL_DEPTH_M[0] <= middle_m <= USUAL_DEPTH_M[1]:
        raise DatasetError(
            f"{where}: the median of its depth is {middle_m:.3g} m, if a 1 in it is {unit:g} m: say the unit of its "
            "numbers in meters (depth_unit_scale_factor of a transforms.json)"
        )
    if values.dtype.kind == "f":
        values = np.rint(np.where(measured, values, 0).astype(np.float64) * (unit / MILLIMETER))
        measured &= values <= _MOST_COUNTS
        unit = MILLIMETER
    return np.where(measured, values, 0).astype(np.uint16), unit


def registered(counts: NDArray[np.uint16], lens: Lens, scale: float, where: str) -> NDArray[np.uint16]:
    """Depth that is registered to images of ``lens``, undistorted and shrunk by ``scale`` as they are, and no larger.
    Raises DatasetError if it has another shape."""
    height, width = counts.shape
    if abs((width / lens.width) / (height / lens.height) - 1.0) > tuned.SAME_DEPTH_SHAPE:
        raise DatasetError(
            f"{where}: depth is {_size(counts)}, its image {lens.width} x {lens.height}: another shape; register it "
            "to the image"
        )
    counts = undistort(lens.resized(width, height), counts, nearest=True)
    small = shrink(pinhole(lens), scale)
    if width > small.width:
        size = (small.width, small.height)
        counts = np.asarray(cv2.resize(counts, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint16)
    return counts


def _numbers(path: Path) -> NDArray[Any]:
    """The file's numbers, (H, W), 16 bits or floating point. Raises DatasetError."""
    if path.suffix.lower() == ".npy":
        found: NDArray[Any] | None = read_numbers(path)
    else:
        os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # asked when the first EXR file is read
        found = decode_file(path, cv2.IMREAD_UNCHANGED)
    if found is None:
        raise DatasetError(f"{path}: missing, damaged, or no depth image that OpenCV can read")
    values = np.squeeze(found)
    if values.ndim == 3 and values.dtype.kind == "f":  # EXR files may name their one channel R, or repeat it
        used = [c for c in range(values.shape[2]) if values[..., c].any()] or [0]
        if all(np.array_equal(values[..., used[0]], values[..., c], equal_nan=True) for c in used):
            values = values[..., used[0]]
    if values.ndim != 2 or values.dtype.kind not in "uf" or values.dtype == np.uint8 or values.size == 0:
        raise DatasetError(
            f"{path}: {values.dtype} of shape {values.shape}: expected one number a pixel, of 16 bits or floating point"
        )
    if values.dtype.kind == "u" and values.max(initial=0) > _MOST_COUNTS:
        raise DatasetError(f"{path}: its numbers exceed 16 bits: store floating point, in meters")
    return values


def _size(counts: NDArray[np.uint16]) -> str:
    return f"{counts.shape[1]} x {counts.shape[0]}"
