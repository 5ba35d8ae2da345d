"""Poses along a recorded trajectory.

A trajectory is a TUM file with lines ``t tx ty tz qx qy qz qw``: seconds, meters, camera-to-world, OpenCV
camera axes, w last in the quaternion (it is first everywhere else in this project).
"""

from __future__ import annotations

import itertools
from decimal import Decimal
from pathlib import Path

import numpy as np

from camera_node.node_constants import MAX_STAMP_S
from camera_node.pose.pairing import SampleBuffer
from camera_node.sources.datasets.records import DatasetError
from freshfield.geometry import GeometryError, Pose, quaternion_normalize
from freshfield.untrusted import read_text

_COLUMN_NAMES = ("t", "time", "timestamp")


def read_tum(
    path: Path, interpolate: bool = True, max_gap_ns: int = 50_000_000, start_ns: int = 0
) -> SampleBuffer[Pose]:
    """Read a trajectory file.

    interpolate: slerp of the rotation and a straight line for the translation between the two samples around an
        instant; False takes the nearest sample (thesis 4.3.3).
    max_gap_ns: an instant farther than this from every sample has no pose.
    start_ns: time in the file that becomes 0.
    Raises DatasetError.
    """
    times, poses = read_samples(path)
    if not times or any(b <= a for a, b in itertools.pairwise(times)):
        raise DatasetError(f"{path}: expected at least one sample, and times that increase")
    # As long as the recording: nothing is dropped.
    track = SampleBuffer(Pose.interpolate if interpolate else None, max_gap_ns, times[-1] - times[0] + 1)
    for t_ns, pose in zip(times, poses):
        track.add(t_ns - start_ns, pose)
    return track


def read_samples(path: Path) -> tuple[list[int], list[Pose]]:
    """Times (ns) and poses of a trajectory file, in the file's order.

    Fields are separated by spaces or commas. Lines that are empty, start with # or name the columns
    (``t,x,...``) are skipped. Raises DatasetError naming file and line.
    """
    try:
        lines = read_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read: {error}") from None
    found = (read_sample(line, f"{path}:{number}") for number, line in enumerate(lines, 1))
    samples = [sample for sample in found if sample is not None]
    return [t_ns for t_ns, _ in samples], [pose for _, pose in samples]


def read_sample(line: str, where: str) -> tuple[int, Pose] | None:
    """Time (ns) and pose of a line of a trajectory; None: it holds none. Raises DatasetError, which begins with
    ``where``."""
    fields = line.replace(",", " ").split()
    if not fields or fields[0].startswith("#") or fields[0] in _COLUMN_NAMES:
        return None
    try:
        t, x, y, z, qx, qy, qz, qw = map(float, fields)
        if not np.all(np.isfinite([t, x, y, z])):
            raise ValueError
        q = quaternion_normalize((qw, qx, qy, qz))
    except GeometryError as error:
        raise DatasetError(f"{where}: {error}") from None
    except ValueError:
        raise DatasetError(f"{where}: expected t tx ty tz qx qy qz qw") from None
    if abs(t) > MAX_STAMP_S:
        raise DatasetError(f"{where}: the time {t:g} cannot be in seconds: is it in milliseconds or nanoseconds?")
    # Stamps in UTC seconds have more digits than a float holds: 1305031102.175304 is off by 100 ns.
    return int(Decimal(fields[0]) * 10**9), Pose(tuple(map(float, q)), (x, y, z))  # type: ignore[arg-type]
