"""Replays a recorded session message by message: the bytes, poses and lenses that an edge once received.

Frames keep their intervals to the nanosecond. To put nodes with different clocks on one time scale, each
session of a node is shifted as a whole, by its least uncertain clock offset.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from camera_node.capture_schedule import CaptureSchedule, OnceSchedule
from camera_node.settings import McapConfig, errors_of, find_data
from camera_node.sources.base import Shot, Source, assign_cameras
from camera_node.sources.datasets.records import DatasetError
from freshfield.depth import EncodedDepth
from freshfield.frame import CODEC_NAMES, pose_and_lens
from freshfield.geometry import Pinhole
from freshfield.scenario import Scenario

if TYPE_CHECKING:
    from freshfield.session.reader import Session, SessionFrame

log = logging.getLogger("camera-node")


class ReplaySource(Source):
    """One camera of a session.

    times_ns: capture times of its frames since the first frame of the scenario's cameras, strictly increasing.
    """

    def __init__(self, camera: str, session: Session, frames: Sequence[SessionFrame], times_ns: Sequence[int]) -> None:
        self.camera = camera
        self.contents = len(frames)
        self.recorded_codec = CODEC_NAMES[frames[0].header.codec]
        self.intrinsics: Pinhole = pose_and_lens(frames[0].header)[1]
        usual_ns = float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 1e9
        self.fps = Fraction(1e9 / usual_ns).limit_denominator(1001)
        self._session, self._frames, self._times = session, frames, times_ns

    def schedule(self, start_ns: int) -> CaptureSchedule:
        return OnceSchedule(self._times, start_ns)

    def content(self, tick: int) -> int:
        return tick % len(self._frames)

    def read(self, content: int) -> Shot:
        frame = self._frames[content]
        pose, lens = pose_and_lens(frame.header)
        return Shot(self._session.payload(frame), pose, lens, frame.header.pose_gap_ns)

    def encoded_depth(self, content: int) -> EncodedDepth | None:
        return self._session.depth(self._frames[content])


def open_replay(scenario: Scenario, config: McapConfig, cameras: Sequence[str], data: Path | None) -> dict[str, Source]:
    """See ``camera_node.sources.registry.open_sources``."""
    path = Path(config.file).expanduser()
    if not path.is_file():
        path = find_data(config.file, scenario, data, key="file")
    with errors_of(f"{scenario.path}: source.file"):
        from freshfield.session.reader import Session

        session = Session(path)
    if session.cut is not None:
        log.warning("%s", session.cut)
    if len(cameras) < len(scenario.cameras):
        log.warning(
            "this node replays %d of %d cameras: a node with others begins at an instant of its own, and their frames "
            "will not fit these in time; --all replays them together",
            len(cameras),
            len(scenario.cameras),
        )
    if not session.frames:
        raise DatasetError(f"{path}: holds no frames of any camera")
    times = {name: _times(frames) for name, frames in session.frames.items()}
    names = assign_cameras(scenario, config.assignment, cameras, list(session.frames))
    used = [config.assignment.get(camera, camera) for camera in scenario.cameras]  # by any node of the scenario
    first = min(t[0] for name, t in times.items() if name in used)
    sources: dict[str, Source] = {}
    for camera, name in names.items():
        frames, kept = _in_order(name, session.frames[name], times[name])
        if len({frame.header.codec for frame in frames}) != 1 or frames[0].header.codec not in CODEC_NAMES:
            raise DatasetError(f"{path}: {name}: its frames are not all of one known codec")
        sources[camera] = ReplaySource(camera, session, frames, [t - first for t in kept])
    return sources


def _times(frames: Sequence[SessionFrame]) -> list[int]:
    """Capture times in ns on the edge's clock, with the intervals of the node's clock."""
    best: dict[str, tuple[int, int]] = {}
    for frame in frames:
        h = frame.header
        known = (h.clock_uncertainty_ns, h.clock_offset_ns)
        best[h.session_id] = min(best.get(h.session_id, known), known, key=lambda pair: pair[0])
    return [f.header.generated_ns + best[f.header.session_id][1] for f in frames]


def _in_order(
    name: str, frames: Sequence[SessionFrame], times_ns: Sequence[int]
) -> tuple[list[SessionFrame], list[int]]:
    """Keep the frames that are newer than all before them; an edge would refuse the others."""
    newest_before = [-math.inf, *accumulate(times_ns, max)]
    kept = [k for k, t_ns in enumerate(times_ns) if t_ns > newest_before[k]]
    if left_out := len(frames) - len(kept):
        log.warning("%s: %d frames do not follow the one before in time: left out", name, left_out)
    return [frames[k] for k in kept], [times_ns[k] for k in kept]
