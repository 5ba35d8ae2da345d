"""Poses of cameras: fixed ones, and ones that follow a recorded trajectory.

A trajectory is a TUM file, ``t tx ty tz qx qy qz qw`` a line: seconds, meters, camera-to-world, OpenCV camera
axes, the quaternion's w last (it is first everywhere else in this project).
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from freshfield.geometry import GeometryError, Pose, quaternion_normalize
from freshfield.limits import MAX_STAMP_S

T = TypeVar("T")

_COLUMN_NAMES = ("t", "time", "timestamp")


class TrajectoryError(ValueError):
    """A trajectory file that cannot be used; the message names file and line."""


class PoseGapError(ValueError):
    """No pose sample is near enough to the asked instant."""


class PoseProvider(Protocol):
    def at(self, t_ns: int) -> tuple[Pose, int]:
        """The pose for an instant, and the time (ns) from that instant to the nearest sample used. Raises
        PoseGapError where no sample is near enough."""
        ...


@runtime_checkable
class Closable(Protocol):
    """What holds a connection or device until ``close``."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class FixedPose:
    """A camera that does not move: always the same pose, no gap."""

    pose: Pose

    def at(self, t_ns: int) -> tuple[Pose, int]:
        return self.pose, 0


class Trajectory:
    """Pose samples in the order of time (ns), paired with instants.

    interpolate: rotation by slerp and translation by a straight line between the two samples around the
    instant; otherwise the nearest sample (thesis 4.3.3). Either way an instant further than ``max_gap_ns``
    from every sample has no pose: before the first, after the last, or within a long hole.
    """

    def __init__(
        self, times_ns: list[int], poses: list[Pose], interpolate: bool = True, max_gap_ns: int = 50_000_000
    ) -> None:
        if not times_ns or len(times_ns) != len(poses):
            raise TrajectoryError("a trajectory needs at least one sample, and one pose for each time")
        if any(b <= a for a, b in itertools.pairwise(times_ns)):
            raise TrajectoryError("the times of a trajectory must increase")
        self._times = times_ns
        self._poses = poses
        self._interpolate = interpolate
        self._max_gap_ns = max_gap_ns

    def at(self, t_ns: int) -> tuple[Pose, int]:
        interpolate = Pose.interpolate if self._interpolate else None
        return sample_at(self._times, self._poses, t_ns, self._max_gap_ns, interpolate)


def sample_at(
    times_ns: Sequence[int],
    samples: Sequence[T],
    t_ns: int,
    max_gap_ns: int,
    interpolate: Callable[[T, T, float], T] | None,
) -> tuple[T, int]:
    """The sample for an instant, and the time (ns) from that instant to the nearest sample.

    times_ns: of the samples, increasing. interpolate: makes a sample between two, at a share of the way from
    the first to the second; None takes the nearest. Raises PoseGapError where none is within ``max_gap_ns``.
    """
    if not times_ns:
        raise PoseGapError("there is no pose yet")
    after = bisect.bisect_left(times_ns, t_ns)
    before = after - 1
    last = after == len(times_ns)
    if last or (before >= 0 and t_ns - times_ns[before] <= times_ns[after] - t_ns):
        nearest = before
    else:
        nearest = after
    gap = abs(times_ns[nearest] - t_ns)
    if gap > max_gap_ns:
        raise PoseGapError(f"the nearest pose is {gap / 1e6:.1f} ms away, more than {max_gap_ns / 1e6:g} ms")
    if interpolate is None or gap == 0 or before < 0 or last:
        return samples[nearest], gap
    fraction = (t_ns - times_ns[before]) / (times_ns[after] - times_ns[before])
    return interpolate(samples[before], samples[after], fraction), gap


def read_tum(
    path: Path, interpolate: bool = True, max_gap_ns: int = 50_000_000, start_ns: int = 0
) -> Trajectory:
    """Read a trajectory file. start_ns: the file's time that becomes 0. Raises TrajectoryError."""
    times, poses = read_samples(path)
    try:
        return Trajectory([t_ns - start_ns for t_ns in times], poses, interpolate, max_gap_ns)
    except TrajectoryError as error:
        raise TrajectoryError(f"{path}: {error}") from None


def read_samples(path: Path) -> tuple[list[int], list[Pose]]:
    """Times (ns) and poses of a file as they stand in it, in whatever order; fields are separated by spaces
    or commas. Lines that are empty, start with # or name the columns (``t,x,...``) are skipped. Raises
    TrajectoryError naming file and line."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path}: cannot be read: {error}") from None
    times: list[int] = []
    poses: list[Pose] = []
    for number, line in enumerate(lines, 1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#") or (not times and fields[0] in _COLUMN_NAMES):
            continue
        try:
            t, x, y, z, qx, qy, qz, qw = map(float, fields)
            if not np.all(np.isfinite([t, x, y, z])):
                raise ValueError
            q = quaternion_normalize((qw, qx, qy, qz))
        except GeometryError as error:
            raise TrajectoryError(f"{path}:{number}: {error}") from None
        except ValueError:
            raise TrajectoryError(f"{path}:{number}: expected t tx ty tz qx qy qz qw") from None
        if abs(t) > MAX_STAMP_S:
            raise TrajectoryError(
                f"{path}:{number}: the time {t:g} cannot be in seconds: is it in milliseconds or nanoseconds?"
            )
        times.append(_nanoseconds(fields[0]))
        poses.append(Pose(tuple(map(float, q)), (x, y, z)))  # type: ignore[arg-type]
    return times, poses


def _nanoseconds(seconds: str) -> int:
    # Stamps in UTC seconds have more digits than a float keeps: 1305031102.175304 is off by 100 ns.
    whole, _, part = seconds.partition(".")
    if part.isdigit() and whole.lstrip("-").isdigit():
        value = int(whole.lstrip("-")) * 10**9 + int(part[:9].ljust(9, "0"))
        return -value if whole.startswith("-") else value
    return round(float(seconds) * 1e9)
