"""Reads a recording of a channel: frames, delays, arrivals and losses.

A recording is either a trace of this emulator (``trace.py``; its recorded states are ignored), or rows of any
other link, one frame a line::

    offered_ms,delivered_ms,camera
    0.0,41.5,cam00
    33.3,,cam00

A frame that never came has no delivered_ms; the camera may be left out, and delay_ms may stand for delivered_ms.
A column outcome (``link.EventKind``, as ``channel-emu simulate --csv`` writes) says why one never came. Without
it, one that finds no delivered frame in service counts as lost, also where a lost one was in service; on a link that
drops none (fcfs, parallel), every one.
Columns may be in any order, with their units (``channel_emu.model.table``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from channel_emu.estimate import estimate_constants as tuned
from channel_emu.model import trace
from channel_emu.model.link import EventKind
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.table import TableError, read_table
from freshfield.untrusted import read_text

# Longer than any stream lives. Longer delays are left out; a row with one counts as not delivered.
MAX_DELAY_MS = 1e9
LOST = (str(EventKind.LOST), str(EventKind.BROKEN))
_NEVER_SENT = (str(EventKind.DROPPED_BUSY), str(EventKind.SUPERSEDED))
_OUTCOMES = (str(EventKind.DELIVERED), *LOST, *_NEVER_SENT)
_MAX_ROWS_MS = 1e12


class RecordingError(ValueError):
    """A recording that cannot be read or fitted; the message says why."""


@dataclass(frozen=True)
class Camera:
    """One camera's frames in the order of their offers; all arrays are (N,), one entry a frame.

    arrived_ms: when the link's arrival process sampled the frame; NaN if it did not.
    started_ms: start of transmission; NaN if it did not start, or is not known to have started.
    delay_ms: from the start until the frame was due, also if it was then lost; NaN likewise.
    outcome: a ``link.EventKind``, or "" for a frame that was still inside.
    """

    name: str
    offered_ms: NDArray[np.float64]
    arrived_ms: NDArray[np.float64]
    started_ms: NDArray[np.float64]
    delay_ms: NDArray[np.float64]
    outcome: NDArray[np.str_]

    def delivered(self) -> NDArray[np.bool_]:
        """Whether each frame was delivered, (N,)."""
        return self.outcome == EventKind.DELIVERED


@dataclass(frozen=True)
class Recording:
    """A recording of one or several cameras.

    discipline: the link's queue discipline.
    sampled: whether an arrival process sampled the offered frames, and skipped some.
    """

    path: Path
    cameras: list[Camera]
    discipline: str
    sampled: bool
    inferred: bool = False
    """Whether lost and dropped frames were told apart by what was in service, for lack of a column outcome."""
    apart: bool = False
    """Whether each camera has a chain of its own."""

    @property
    def frames(self) -> int:
        """Number of frames of all cameras."""
        return sum(len(camera.offered_ms) for camera in self.cameras)

    def delays_ms(self) -> NDArray[np.float64]:
        """All known delays, one camera after the other."""
        values = np.concatenate([camera.delay_ms for camera in self.cameras])
        return values[~np.isnan(values)]


def read_recording(path: Path, discipline: str | None = None) -> Recording:
    """Read a trace or rows.

    discipline: queue discipline of the link of the rows; None assumes drop-new and refuses rows that
        contradict it. A trace contains its own.
    Raises RecordingError or TraceError.
    """
    try:
        begin = read_text(path)[:1]
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from None
    if begin == "{":
        return from_trace(path, trace.read(path))
    found = _from_rows(path, discipline or "drop-new")
    if discipline is None:
        _check_drop_new(found)
    return found


def from_trace(path: Path, found: trace.Trace) -> Recording:
    """The recording in a trace of the emulator. path: for error messages. Raises RecordingError if it is
    empty."""
    if not found.records:
        raise RecordingError(f"{path}: there is no frame in it")
    sampled = any(r.outcome == EventKind.SKIPPED for r in found.records)
    first_ns = min(r.offered_ns for r in found.records)
    cameras = []
    for name, records in found.by_camera().items():
        started = _ms([r.started_ns for r in records], first_ns)
        drawn = [None if r.drawn_ns is None or (r.due_ns or 0) >= NEVER_NS else r.drawn_ns for r in records]
        delay = _ms(drawn, 0)
        delay[~(delay <= MAX_DELAY_MS)] = math.nan
        offered = _ms([r.offered_ns for r in records], first_ns)
        outcome = np.array([r.outcome or "" for r in records])
        arrived = _ms([r.arrived_ns for r in records], first_ns) if sampled else offered
        cameras.append(Camera(name, offered, arrived, started, delay, outcome))
    apart = found.config.chain is not None and found.config.chain.scope == "per-camera" and len(cameras) > 1
    return Recording(path, cameras, found.config.discipline, sampled, apart=apart)


def _ms(instants: Sequence[int | None], first_ns: int) -> NDArray[np.float64]:
    return np.array([math.nan if v is None else (v - first_ns) / 1e6 for v in instants], float)


def _from_rows(path: Path, discipline: str) -> Recording:
    rows: dict[str, list[tuple[float, float, str]]] = {}
    try:
        read = read_table(read_text(path))
        offered = read.column("offered", "sent", "send_time")
        delivered = read.column("delivered", "received", "receive_time", "arrived")
        delay = read.column("delay", "latency", "one_way_delay")
        if not read.titles and not read.rows:
            raise TableError("there is no frame in it")
        if offered is None or (delivered is None and delay is None):
            raise TableError(
                "expected a header with the columns offered_ms, delivered_ms (or delay_ms) and perhaps camera, in any "
                f"order, with their units; it has {', '.join(read.titles) or 'no header'}"
            )
        came = [*read.times_ms(delivered or delay or offered)]
        camera, outcome = read.text("camera"), read.text("outcome")
        begin = next((at for at in read.times_ms(offered) if math.isfinite(at)), 0.0)  # stamps may be since 1970
        for (line, row), at, then, lost in zip(read.rows, read.times_ms(offered), came, read.lost()):
            at -= begin
            then = math.nan if lost else then - begin if delivered else at + then
            if abs(at) > _MAX_ROWS_MS:
                raise TableError(f"line {line}: {offered.title} is decades away from the first: {', '.join(row):.100}")
            if math.isnan(at) or then < at:
                raise TableError(
                    f"line {line}: delivered_ms is not earlier than offered_ms, or blank: {', '.join(row):.100}"
                )
            then = math.nan if then - at > MAX_DELAY_MS else then
            why = row[outcome] if outcome is not None else ""
            if why == EventKind.SKIPPED:
                raise TableError(
                    "an arrival process sampled the frames (outcome skipped), and rows do not say when: simulate "
                    "without --frame-period-ms, or fit a --trace"
                )
            if why not in ("", *_OUTCOMES):
                raise TableError(f"line {line}: outcome is {why!r:.40}, expected {', '.join(_OUTCOMES)}, or blank")
            rows.setdefault((row[camera] if camera is not None else "") or "cam00", []).append((at, then, why))
    except TableError as error:
        raise RecordingError(f"{path}: {error}") from None
    if not rows:
        raise RecordingError(f"{path}: there is no frame in it")
    each = [row for given in rows.values() for row in given]
    first = min(at for at, _, _ in each)
    last = max(at if math.isnan(then) else then for at, then, _ in each)
    # On a parallel link, frames offered from this instant on may still be in service.
    sure_ms = last - first - max((then - at for at, then, _ in each if not math.isnan(then)), default=0.0)
    cameras = [_camera_of_rows(name, given, first, discipline, sure_ms) for name, given in rows.items()]
    return Recording(path, cameras, discipline, False, inferred=outcome is None)


def _check_drop_new(recording: Recording) -> None:
    """Refuse rows of a link with another discipline, whose waiting times would count as delays. A few frames
    may overlap because clocks are coarse."""
    came = meanwhile = 0
    for camera in recording.cameras:
        went = ~np.isnan(camera.delay_ms)
        offered = camera.offered_ms[went]
        free = np.maximum.accumulate(offered + camera.delay_ms[went])
        came += len(offered)
        meanwhile += int((offered[1:] < free[:-1]).sum())
    share = meanwhile / max(came, 1)
    if share > tuned.MOST_OVERLAPPING:
        raise RecordingError(
            f"{recording.path}: {100 * share:.0f} % of the frames that came were offered while another was "
            "on its way, and a drop-new link drops those: say what this one does, --discipline newest-waits, "
            "fcfs or parallel, or drop-new to fit it all the same"
        )


def _camera_of_rows(
    name: str, rows: list[tuple[float, float, str]], first: float, discipline: str, sure_ms: float
) -> Camera:
    """Infer starts and outcomes of rows (offered, delivered, why not). Transmission starts at the offer, or when the
    link becomes free: behind a lost frame that is not known, and neither is the delay.

    An undelivered frame was dropped if its row says so, or if an earlier one was in service on a link that drops, and
    lost otherwise. If its row does not say so, after the last delivery, and on a parallel link from ``sure_ms`` on, it
    may still be in service: outcome unknown.
    """
    rows = sorted(rows, key=lambda row: row[0])
    offered, delivered = np.array([row[:2] for row in rows]).T - first
    n = len(offered)
    started, delay = np.full(n, math.nan), np.full(n, math.nan)
    outcome = np.full(n, str(EventKind.LOST), dtype="U16")
    waits, drops = discipline in ("newest-waits", "fcfs"), discipline in ("newest-waits", "drop-new")
    free, behind_lost = -math.inf, False
    for i in range(n):
        if math.isnan(delivered[i]):
            if rows[i][2] in _NEVER_SENT:
                outcome[i] = rows[i][2]
            elif rows[i][2] not in LOST and drops and offered[i] < free:
                newest = discipline == "newest-waits"
                outcome[i] = str(EventKind.SUPERSEDED if newest else EventKind.DROPPED_BUSY)
            behind_lost |= bool(outcome[i] == EventKind.LOST)
            continue
        outcome[i] = str(EventKind.DELIVERED)
        started[i] = max(offered[i], free) if waits and free <= delivered[i] else offered[i]
        if not (waits and behind_lost):
            delay[i] = delivered[i] - started[i]
        free, behind_lost = max(free, float(delivered[i])), False
    came = np.flatnonzero(outcome == EventKind.DELIVERED)
    if len(came):
        unknown = np.arange(n) > came[-1]
        if discipline == "parallel":
            unknown |= offered >= sure_ms
        said = np.array([row[2] in LOST for row in rows])
        outcome[unknown & ~said & (outcome == EventKind.LOST)] = ""
    return Camera(name, offered, offered, started, delay, outcome)


Transmissions = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""Start in ms, delay in ms (NaN: unknown) and loss (1 or 0; NaN: unknown) of frames, each (N,)."""


def transmissions(recording: Recording) -> Transmissions:
    """The frames that all cameras, which share a chain, transmitted, in the order of their starts; lost ones whose
    start is unknown count from their offer."""
    start, delay, lost = (np.concatenate(column) for column in zip(*map(_transmitted, recording.cameras)))
    order = np.argsort(start, kind="stable")
    return start[order], delay[order], lost[order]


def _transmitted(camera: Camera) -> Transmissions:
    lost = np.isin(camera.outcome, LOST)
    came = camera.delivered()
    start = np.where(np.isnan(camera.started_ms) & lost, camera.offered_ms, camera.started_ms)
    kept = (lost | came | ~np.isnan(camera.delay_ms)) & ~np.isnan(start)
    fate = np.where(lost, 1.0, np.where(came, 0.0, np.nan))
    return start[kept], camera.delay_ms[kept], fate[kept]
