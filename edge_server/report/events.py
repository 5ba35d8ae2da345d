"""The events of a run besides its updates: marked on every curve over time, and listed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from edge_server.report.report_constants import MOST_EVENTS, NAMED_CAMERAS, SILENT_MS, TOGETHER_S
from edge_server.report.run_files import RunFiles
from edge_server.run_records import AgesRow, ChannelChange, Event


def events(files: RunFiles) -> list[dict[str, Any]]:
    """[{t_s: seconds since the edge started, what: in words}], in order; the ``MOST_EVENTS`` first."""
    restarted_s = files.restarts_s[-1] if files.restarts_s else 0.0  # the edge's times count from its last start
    found = [Event(event.t_s + restarted_s, event.what) for event in files.edge.events]
    if (began_ns := files.edge.started_ns) is not None:
        starts = list(zip([0.0, *files.restarts_s][::-1], _starts_ns(files.out, began_ns)))  # the last one's first
        found += [Event(_placed_s(each.at_ns, starts), _words(each)) for each in files.channel.changes]
    found += [Event(t_s, "the edge server restarted") for t_s in files.restarts_s]
    found += silences(files.ages)
    found = sorted((event for event in found if event.t_s >= 0.0), key=lambda event: event.t_s)
    return [{"t_s": round(event.t_s, 2), "what": event.what} for event in found[:MOST_EVENTS]]


def _starts_ns(out: Path, last_ns: int) -> list[int]:
    """Start times of the edge processes that served, from the names of their ledgers; the last one first."""
    found = {int(ns) for path in out.glob("ledger-edge-edge-*.tsv") if (ns := path.stem.rpartition("-")[2]).isdecimal()}
    return [last_ns, *sorted((ns for ns in found if ns < last_ns), reverse=True)]


def _placed_s(at_ns: int, starts: Sequence[tuple[float, int]]) -> float:
    """Seconds since the edge first started, not counting the time between processes. starts: of its processes, in such
    seconds and on the clock of ``at_ns``, the last one first."""
    placed_s = next_s = math.inf
    for start_s, start_ns in starts:
        placed_s = min(start_s + (at_ns - start_ns) / 1e9, next_s)
        if start_ns <= at_ns:
            break
        next_s = start_s
    return placed_s


def silences(rows: Sequence[AgesRow]) -> list[Event]:
    """When cameras delivered no frames for more than ``SILENT_MS``, and for how long."""
    cameras = sorted({camera for row in rows for camera in row.age_ms})
    gaps = sorted((gap for camera in cameras for gap in _gaps(rows, camera)), key=lambda gap: gap[0])
    found = []
    while gaps:
        first_s = gaps[0][0]
        together = [gap for gap in gaps if gap[0] - first_s <= TOGETHER_S]
        gaps = gaps[len(together) :]
        names = sorted({gap[2] for gap in together})
        who = ", ".join(names[:NAMED_CAMERAS]) + (
            f" and {len(names) - NAMED_CAMERAS} more" if len(names) > NAMED_CAMERAS else ""
        )
        ends_s = [end_s for _, end_s, _ in together if end_s is not None]
        if len(ends_s) < len(together):
            found.append(Event(first_s, f"{who}: no further frame"))
        else:
            found.append(Event(first_s, f"{who}: no frame for {max(ends_s) - first_s:.1f} s"))
    return found


def _gaps(rows: Sequence[AgesRow], camera: str) -> list[tuple[float, float | None, str]]:
    """(capture time of the last frame before the gap, seconds; that of the first one after it, None: there is none;
    camera)."""
    ages = [(row.t_s, age_ms) for row in rows if (age_ms := row.age_ms.get(camera)) is not None]
    found: list[tuple[float, float | None, str]] = []
    for silent, run in groupby(ages, key=lambda at: at[1] >= SILENT_MS):
        times = list(run)
        captured_s = times[0][0] - times[0][1] / 1e3
        if silent:
            found.append((captured_s, None, camera))
        elif found:
            found[-1] = (found[-1][0], captured_s, camera)
    return found


def _words(change: ChannelChange) -> str:
    if change.delay_ms is None and change.loss is None:
        return "the scenario's network again"
    return f"network set: {change.delay_ms or 0.0:.0f} ms, {100.0 * (change.loss or 0.0):.0f} % lost"
