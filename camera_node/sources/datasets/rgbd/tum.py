"""TUM RGB-D (Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012): one hand-held Kinect.

    rgb.txt, depth.txt  seconds file
    groundtruth.txt     seconds tx ty tz qx qy qz qw, camera-to-world, OpenCV axes, meters

Each image gets the depth and the pose nearest in time, within 20 ms, as with the benchmark's ``associate.py``; images
without a pose are left out. Depth is registered to the image, 5000 counts a meter. The files hold no intrinsics: the
benchmark recommends ROS's defaults, and gives others for ``freiburg3``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from camera_node.node_constants import MAX_STAMP_S
from camera_node.pose.pairing import PoseGapError
from camera_node.pose.trajectory_file import read_tum
from camera_node.sources import source_constants as tuned
from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageFiles, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, errors_at, file_within
from camera_node.sources.datasets.rgbd.depth_file import DepthFile
from freshfield.untrusted import read_text

FILES = ("rgb.txt",)
METERS_PER_COUNT = 1.0 / 5000.0
# Published with pixel centers at whole numbers, so .5 is added.
_LENS = Lens(640, 480, 525.0, 525.0, 320.0, 240.0)
_FREIBURG3 = Lens(640, 480, 535.4, 539.2, 320.6, 248.1)


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The images of a sequence's folder, or of its ``rgb.txt``. Raises DatasetError."""
    folder = path if path.is_dir() else path.parent
    poses = read_tum(folder / "groundtruth.txt", interpolate=False, max_gap_ns=tuned.TUM_NEAR_NS)
    listed = _listed(folder / "rgb.txt")
    depth = dict(_listed(folder / "depth.txt"))
    times = np.array(sorted(depth), dtype=np.int64)
    lens = _FREIBURG3 if "freiburg3" in folder.resolve().name else _LENS
    found = ImageFiles(folder, options, str(folder / "rgb.txt"))
    unposed = 0
    for t_ns, name in listed:
        try:
            pose, _ = poses.at(t_ns)
        except PoseGapError:
            unposed += 1
            continue
        nearest = int(times[np.abs(times - t_ns).argmin()]) if times.size else t_ns + 2 * tuned.TUM_NEAR_NS
        with errors_at(f"{folder / 'depth.txt'}"):
            measured = file_within(folder, depth[nearest]) if abs(nearest - t_ns) <= tuned.TUM_NEAR_NS else None
        reader = DepthFile(measured, METERS_PER_COUNT).read if measured else None
        where, time_s = f"{folder / 'rgb.txt'}: {name}", (t_ns - listed[0][0]) / 1e9
        found.add(name, name, lens, pose.matrix(), where, time_s=time_s, depth=reader)
    left_out = f"{unposed} of {len(listed)} images have no pose within {tuned.TUM_NEAR_NS // 10**6} ms: left out"
    if listed and unposed == len(listed):
        raise DatasetError(f"{folder}: {left_out}")
    return found.dataset(notes=[left_out] if unposed else [])


def _listed(file: Path) -> list[tuple[int, str]]:
    """Times (ns) and files of a list. Raises DatasetError."""
    try:
        lines = [line.split() for line in read_text(file).splitlines() if line.strip() and line.strip()[0] != "#"]
        listed = [(float(seconds), name) for seconds, name in lines]
    except (OSError, ValueError) as error:
        raise DatasetError(f"{file}: expected lines of seconds and file: {error}") from None
    for time_s, _ in listed:
        if not abs(time_s) <= MAX_STAMP_S:
            raise DatasetError(f"{file}: the time {time_s:g} cannot be in seconds")
    return [(round(time_s * 1e9), name) for time_s, name in listed]
