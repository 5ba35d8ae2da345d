"""Trajectories in the format of the TUM RGB-D benchmark, which evo and others read: one pose per line.

``t tx ty tz qx qy qz qw``: camera-to-world, meters, seconds, quaternions w-last.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from edge_server.export import ExportError
from freshfield.files import write_text
from freshfield.geometry import Pose


def write_tum(path: Path, poses: Iterable[tuple[int, Pose]]) -> int:
    """Write (ns, pose) pairs, sorted by time; returns their number. ExportError: none."""
    rows = sorted(poses, key=lambda row: row[0])
    if not rows:
        raise ExportError("no pose is known: there is nothing to write")
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for t_ns, pose in rows:
        w, x, y, z = pose.quaternion
        values = " ".join(repr(float(v)) for v in (*pose.translation_m, x, y, z, w))
        lines.append(f"{t_ns // 10**9}.{t_ns % 10**9:09d} {values}")  # no float holds nanoseconds since 1970
    write_text(path, "\n".join(lines) + "\n")
    return len(rows)
