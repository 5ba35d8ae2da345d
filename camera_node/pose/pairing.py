"""Pairs frames with the pose samples of an arm or a trajectory (thesis 4.3.3), which have another rate.

The thesis takes the sample nearest to the frame. The two samples around it can also be interpolated: linearly
with slerp, or linearly in joint space. The frame carries the time to the nearest sample, and a frame without a
sample within a bound gets no pose.
"""

from __future__ import annotations

import bisect
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from camera_node import node_constants as tuned
from freshfield.geometry import Array

T = TypeVar("T")
Interpolate = Callable[[T, T, float], T]


class PoseGapError(ValueError):
    """No pose sample is near enough to the requested instant."""


def interpolate_joints(a: Array, b: Array, fraction: float) -> Array:
    """Interpolate joint angles (J,), radians, linearly: a controller reports them unwrapped."""
    return (1.0 - fraction) * a + fraction * b


class SampleBuffer(Generic[T]):
    """The last ``keep_ns`` of a stream of samples, sorted by stamp. Thread-safe.

    interpolate: makes a sample at a fraction between two; None takes the nearest sample.
    max_gap_ns: an instant farther than this from every sample is refused.
    keep_ns: samples older than the newest by more than this are dropped.
    restart_after: number of consecutive samples, ascending but too old, after which they replace the buffer:
        the sender's clock was set back, or a wrong stamp had emptied the buffer.
    received: number of samples that came.
    """

    def __init__(
        self,
        interpolate: Interpolate[T] | None,
        max_gap_ns: int = 50_000_000,
        keep_ns: int = tuned.KEPT_POSES_NS,
        restart_after: int = tuned.RESTART_POSES,
    ) -> None:
        self.received = 0
        self._interpolate = interpolate
        self._max_gap_ns, self._keep_ns, self._restart_after = max_gap_ns, keep_ns, restart_after
        self._times: list[int] = []
        self._samples: list[T] = []
        self._old: list[tuple[int, T]] = []
        self._lock = threading.Lock()

    def add(self, t_ns: int, sample: T) -> bool:
        """Add a sample taken at ``t_ns``. False if it was a duplicate or too old."""
        with self._lock:
            self.received += 1
            if self._times and t_ns < self._times[-1] - self._keep_ns:
                return self._add_stale(t_ns, sample)
            at = bisect.bisect_left(self._times, t_ns)
            if at < len(self._times) and self._times[at] == t_ns:
                return False
            self._old.clear()
            self._times.insert(at, t_ns)
            self._samples.insert(at, sample)
            self._prune()
            return True

    def at(self, t_ns: int) -> tuple[T, int]:
        """The sample for an instant, and the time (ns) to the nearest sample. Raises PoseGapError if none is within
        ``max_gap_ns``."""
        with self._lock:
            times, samples = self._times, self._samples
            if not times:
                raise PoseGapError("there is no pose yet")
            after = min(bisect.bisect_left(times, t_ns), len(times) - 1)
            before = max(0, after - 1)
            nearest = min(before, after, key=lambda k: abs(times[k] - t_ns))
            gap = abs(times[nearest] - t_ns)
            if gap > self._max_gap_ns:
                limit_ms = self._max_gap_ns / 1e6
                raise PoseGapError(f"the nearest pose is {gap / 1e6:.1f} ms away, more than {limit_ms:g} ms")
            if self._interpolate is None or gap == 0 or not times[before] < t_ns < times[after]:
                return samples[nearest], gap
            fraction = (t_ns - times[before]) / (times[after] - times[before])
            return self._interpolate(samples[before], samples[after], fraction), gap

    def ready(self, t_ns: int) -> bool:
        """Whether a sample at or after the instant has come; before that, ``at`` cannot interpolate."""
        with self._lock:
            return bool(self._times) and self._times[-1] >= t_ns

    def _add_stale(self, t_ns: int, sample: T) -> bool:
        if self._old and t_ns <= self._old[-1][0]:
            self._old.clear()
        self._old.append((t_ns, sample))
        if len(self._old) < self._restart_after:
            return False
        self._times, self._samples = [t for t, _ in self._old], [s for _, s in self._old]
        self._old.clear()
        self._prune()
        return True

    def _prune(self) -> None:
        # Let the list grow by an eighth first, so that it is not moved at every sample.
        if self._times[0] < self._times[-1] - self._keep_ns * 9 // 8:
            first = bisect.bisect_left(self._times, self._times[-1] - self._keep_ns)
            del self._times[:first], self._samples[:first]
