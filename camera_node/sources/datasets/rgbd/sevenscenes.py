"""7-Scenes (Shotton et al., "Scene Coordinate Regression Forests", CVPR 2013): one hand-held Kinect.

    frame-000000.color.png  640 x 480
    frame-000000.depth.png  millimeters, 65535 where nothing was measured; not registered to the image
    frame-000000.pose.txt   camera-to-world (4 x 4) of the depth camera, OpenCV axes, meters

The data set gives a focal length of 585 px for depth, and neither the image's lens nor the place of the depth sensor.
Here they are nominal: a focal length of 525 px, and the sensor 25.6 mm beside the camera, not turned. On eight frames
of the red kitchen edges of depth then lie on those of the image to 2 px (contrast 2.1; with the calibration of another
Kinect that public code uses, which also turns the sensor by .6 degrees, 1.2).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageFiles, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, file_within
from camera_node.sources.datasets.rgbd.depth_file import DepthFile
from freshfield.geometry import Pinhole, Pose, se3_inverse
from freshfield.untrusted import read_text

FILES = ("frame-000000.pose.txt",)
FPS = 30.0
NOTHING = 65535
DEPTH_LENS = Pinhole(640, 480, 585.0, 585.0, 320.0, 240.0)
_LENS = Lens(640, 480, 525.0, 525.0, 320.0, 240.0)
_DEPTH_TO_CAMERA = Pose((1.0, 0.0, 0.0, 0.0), (-0.0256, 0.0, 0.0))


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The frames of a sequence's folder that have an image and a pose. Raises DatasetError."""
    folder = path if path.is_dir() else path.parent
    to_depth = se3_inverse(_DEPTH_TO_CAMERA.matrix())
    found = ImageFiles(folder, options, str(folder))
    for file in sorted(folder.glob("frame-*.pose.txt")):
        name = file.name.removesuffix(".pose.txt")
        depth = file_within(folder, f"{name}.depth.png")
        reader = DepthFile(depth, nothing=NOTHING, lens=DEPTH_LENS, to_camera=_DEPTH_TO_CAMERA).read if depth else None
        number = name.removeprefix("frame-")
        if not number.isdecimal():
            raise DatasetError(f"{file}: expected frame-NUMBER.pose.txt")
        pose, time_s = _pose(file) @ to_depth, int(number) / FPS
        endings = (".png", ".jpg")  # redistributions have JPEGs
        found.add(name, f"{name}.color", _LENS, pose, str(file), endings=endings, time_s=time_s, depth=reader)
    return found.dataset()


def _pose(file: Path) -> np.ndarray:
    try:
        matrix = np.array(read_text(file).split(), dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{file}: expected a matrix of 4 x 4 numbers: {error}") from None
    return matrix
