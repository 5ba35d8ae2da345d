"""Record3D, the export "EXR + JPG sequence": one moving iPhone or iPad with LiDAR.

    metadata.json  w, h, fps, K (3 x 3, column by column), poses [qx qy qz qw tx ty tz] (camera-to-world, OpenGL axes),
                   and perhaps perFrameIntrinsicCoeffs [fx fy cx cy], frameTimestamps
    rgb/N.jpg      depth/N.exr  meters, smaller than the image and registered to it

The keys are read as nerfstudio's ``ns-process-data record3d`` reads them. Archives (``.r3d``), whose depth is
compressed with LZFSE, are not read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageFiles, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, errors_at, file_within, read_array, read_json
from camera_node.sources.datasets.rgbd.depth_file import DepthFile
from freshfield.geometry import OPENGL_TO_OPENCV, quaternion_to_matrix, se3

FILES = ("metadata.json",)


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The frames of an export's folder, or of its ``metadata.json``. Raises DatasetError."""
    file = path / FILES[0] if path.is_dir() else path
    data = read_json(file)
    if not isinstance(data, dict) or not isinstance(data.get("poses"), list) or not data["poses"]:
        raise DatasetError(f"{file}: expected Record3D's mapping with a list 'poses'")
    where, count = str(file), len(data["poses"])
    poses = read_array(data, "poses", (count, 7), where)
    width, height, fps = (float(read_array(data, key, (), where)) for key in ("w", "h", "fps"))
    k = read_array(data, "K", (3, 3), where).T
    lenses = np.tile([k[0, 0], k[1, 1], k[0, 2], k[1, 2]], (count, 1))
    if data.get("perFrameIntrinsicCoeffs"):
        lenses = read_array(data, "perFrameIntrinsicCoeffs", (count, 4), where)
    times = np.arange(count) / max(fps, 1e-3)
    if data.get("frameTimestamps"):
        times = read_array(data, "frameTimestamps", (count,), where)
    found = ImageFiles(file.parent, options, where)
    for n in range(count):
        name, here = f"rgb/{n}", f"{where}: frame {n}"
        with errors_at(here):
            depth = file_within(file.parent, f"depth/{n}.exr")
            x, y, z, w = poses[n, :4]
            pose = se3(quaternion_to_matrix([w, x, y, z]), poses[n, 4:]) @ OPENGL_TO_OPENCV
            lens = Lens(int(width), int(height), *lenses[n].tolist())
        time_s, reader = float(times[n] - times[0]), DepthFile(depth, 1.0).read if depth else None
        found.add(name, name, lens, pose, here, endings=(".jpg", ".png"), time_s=time_s, depth=reader)
    return found.dataset()
