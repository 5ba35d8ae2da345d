"""Poses of cameras: fixed ones, and poses along a recorded trajectory.

A trajectory is a TUM file with lines ``t tx ty tz qx qy qz qw``: seconds, meters, camera-to-world, OpenCV
camera axes, w last in the quaternion (it is first everywhere else in this project).
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
from freshfield.untrusted import read_text

T = TypeVar("T")

_COLUMN_NAMES = ("t", "time", "timestamp")


class TrajectoryError(ValueError):
    """A trajectory file that cannot be used; the message names file and line."""


class PoseGapError(ValueError):
    """No pose sample is near enough to the requested instant."""


class PoseProvider(Protocol):
    def at(self, t_ns: int) -> tuple[Pose, int]:
        """The camera-to-world pose for an instant, and the time (ns) from that instant to the nearest sample.
        Raises PoseGapError if no sample is near enough."""
        ...


@runtime_checkable
class Closable(Protocol):
    """An object that holds a connection or device until ``close``."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class FixedPose:
    """The pose of a camera that does not move."""

    pose: Pose

    def at(self, t_ns: int) -> tuple[Pose, int]:
        return self.pose, 0


class Trajectory:
    """A recorded trajectory as a pose provider.

    times_ns: of the samples, strictly increasing. poses: one for each time.
    interpolate: slerp of the rotation and a straight line for the translation between the two samples around
        the instant; False takes the nearest sample (thesis 4.3.3).
    max_gap_ns: an instant farther than this from every sample has no pose.
    Raises TrajectoryError if there are no samples, or times and poses do not match.
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

    times_ns: of the samples, increasing.
    t_ns: the instant.
    interpolate: makes a sample at a fraction of the way from a first to a second; None takes the nearest.
    Raises PoseGapError if no sample is within ``max_gap_ns``.
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


def read_tum(path: Path, interpolate: bool = True, max_gap_ns: int = 50_000_000, start_ns: int = 0) -> Trajectory:
    """Read a trajectory file. interpolate, max_gap_ns: see ``Trajectory``.

    start_ns: time in the file that becomes 0.
    Raises TrajectoryError.
    """
    times, poses = read_samples(path)
    try:
        return Trajectory([t_ns - start_ns for t_ns in times], poses, interpolate, max_gap_ns)
    except TrajectoryError as error:
        raise TrajectoryError(f"{path}: {error}") from None


def read_samples(path: Path) -> tuple[list[int], list[Pose]]:
    """Times (ns) and poses of a trajectory file, in the file's order.

    Fields are separated by spaces or commas. Lines that are empty, start with # or name the columns
    (``t,x,...``) are skipped. Raises TrajectoryError naming file and line.
    """
    try:
        lines = read_text(path).splitlines()
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
    # Stamps in UTC seconds have more digits than a float holds: 1305031102.175304 is off by 100 ns.
    whole, _, part = seconds.partition(".")
    if part.isdigit() and whole.lstrip("-").isdigit():
        value = int(whole.lstrip("-")) * 10**9 + int(part[:9].ljust(9, "0"))
        return -value if whole.startswith("-") else value
    return round(float(seconds) * 1e9)
