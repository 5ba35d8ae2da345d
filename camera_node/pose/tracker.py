"""Poses that a tracker (SLAM, motion capture) gives while the camera runs: lines of a TUM trajectory, appended to a
file, or written to a named pipe.

Times are seconds since 1970 (UTC), as ROS stamps and ``time.time()`` are, so that they fit the frames' stamps. The
frames' clock never steps: where the machine's does, or goes on while it is suspended, later poses are shifted as much.
"""

from __future__ import annotations

import contextlib
import logging
import os
import stat
import threading
import time
from pathlib import Path

from camera_node import node_constants as tuned
from camera_node.pose.pairing import PoseGapError, SampleBuffer
from camera_node.pose.trajectory_file import read_sample
from camera_node.sources.datasets.records import DatasetError
from freshfield.clock import Clock, SystemClock, WallClock
from freshfield.geometry import Pose

log = logging.getLogger("camera-node")


class TrackerPoses:
    """The poses in ``path``, followed by a thread until ``close``. The file may come later, be replaced, or be written
    over in place: then its end is read anew, the newest line first, until one that is known.

    interpolate, max_gap_ns: as of ``SampleBuffer``. refused: number of lines that are no pose.
    """

    def __init__(self, path: Path, interpolate: bool = True, max_gap_ns: int = 50_000_000) -> None:
        self.path, self.refused = path, 0
        self._clock: Clock = WallClock()
        self._system: Clock = SystemClock()
        self._ahead_ns = 0
        self._samples = SampleBuffer[Pose](Pose.interpolate if interpolate else None, max_gap_ns)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._main, name=f"tracker {path.name}", daemon=True)
        self._thread.start()

    def at(self, t_ns: int) -> tuple[Pose, int]:
        """The pose at an instant, and the time (ns) to the nearest sample. Waits for a later sample, because a tracker
        computes: up to ``TRACKER_LATE_S``. Raises PoseGapError."""
        until = time.monotonic() + tuned.TRACKER_LATE_S
        while not self._samples.ready(t_ns) and time.monotonic() < until and not self._stop.wait(tuned.TRACKER_LOOKS_S):
            pass
        try:
            return self._samples.at(t_ns)
        except PoseGapError as error:
            raise PoseGapError(f"{self.path}: {error}; its times are seconds since 1970") from None

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join(tuned.TRACKER_JOIN_S)

    def _main(self) -> None:
        while not self._stop.wait(tuned.TRACKER_LOOKS_S):
            with contextlib.suppress(OSError):  # it is not there yet, or its disk failed: looked for again
                self._follow()

    def _follow(self) -> None:
        """Read lines until the file is another one, or what was read last is no longer in it. Raises OSError."""
        # A named pipe without a writer is empty, not waited for.
        file = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)
        try:
            opened, taken, rest, last = os.fstat(file), 0, b"", b""
            is_file = first = stat.S_ISREG(opened.st_mode)
            if is_file and opened.st_size > tuned.TRACKER_TAIL_BYTES:
                taken = os.lseek(file, -tuned.TRACKER_TAIL_BYTES, os.SEEK_END)
            cut = int(taken > 0)  # whether it begins within a line
            while not self._stop.is_set():
                data = b""
                with contextlib.suppress(BlockingIOError):  # a pipe whose writer has nothing to say
                    data = os.read(file, tuned.TRACKER_TAIL_BYTES)
                if is_file and os.pread(file, len(last), taken - len(last)) != last:
                    return
                taken, last = taken + len(data), (last + data)[-tuned.TRACKER_LINE_BYTES :]
                *lines, rest = (rest + data).split(b"\n")
                rest = rest[-tuned.TRACKER_LINE_BYTES :]
                for line in reversed(lines[cut:]) if first else lines:
                    if not self._add(line) and first:
                        break
                first = first and not lines
                if os.stat(self.path).st_ino != opened.st_ino or (not data and self._stop.wait(tuned.TRACKER_LOOKS_S)):
                    return
        finally:
            os.close(file)

    def _add(self, line: bytes) -> bool:
        """Whether the line holds no pose that was known, or too old."""
        try:
            sample = read_sample(line.decode("utf-8-sig", errors="replace"), str(self.path))
        except DatasetError as error:
            self.refused += 1
            if self.refused == 1:
                log.warning("%s; lines that are no pose are left out", error)
            return True
        return sample is None or self._samples.add(sample[0] + self._shift_ns(), sample[1])

    def _shift_ns(self) -> int:
        """The frames' clock minus the machine's, the same until one of them steps."""
        least_ns = self._clock.now_ns()
        system_ns, most_ns = self._system.now_ns(), self._clock.now_ns()
        if not least_ns - tuned.TRACKER_STEP_NS <= system_ns + self._ahead_ns <= most_ns + tuned.TRACKER_STEP_NS:
            self._ahead_ns = most_ns - system_ns
        return self._ahead_ns
