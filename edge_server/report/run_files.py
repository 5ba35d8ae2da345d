"""Reads the files in a run's folder. A missing, torn or unexpected file adds a note and does not stop the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from edge_server.report.report_constants import LATE_S
from edge_server.run_records import AgesRow, ChannelStatus, EdgeStatus, Frontier, Number, ShownRow, UpdateRow

T = TypeVar("T")

ProcessRow = dict[str, Number | dict[str, Number | None] | None]


class _Started(msgspec.Struct):
    """The part of run.json, which the launcher writes, that a report uses."""

    command: str | None = None


@dataclass
class RunFiles:
    """Contents of a run's folder.

    command: the command that started all processes, if one did.
    restarts_s: when the edge server restarted.
    processes: rows {t_s, name: {rss_mb, cpu, pid}}.
    frontier: the one that the edge used.
    images: those that exist, by name.
    notes: lines of text on what was missing or torn.
    """

    out: Path
    command: str | None = None
    restarts_s: list[float] = field(default_factory=list)
    edge: EdgeStatus = field(default_factory=EdgeStatus)
    channel: ChannelStatus = field(default_factory=ChannelStatus)
    series: list[UpdateRow] = field(default_factory=list)
    shown: list[ShownRow] = field(default_factory=list)
    ages: list[AgesRow] = field(default_factory=list)
    processes: list[dict[str, Any]] = field(default_factory=list)
    frontier: Frontier | None = None
    images: dict[str, Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def read_run_files(out: Path) -> RunFiles:
    """Everything a report needs from ``out``. Raises FileNotFoundError only if the folder does not exist."""
    if not out.is_dir():
        raise FileNotFoundError(f"{out} is not a folder: give the folder of a run (its --out)")
    notes: list[str] = []
    files = RunFiles(
        out,
        edge=_read(out / "edge.json", EdgeStatus, notes) or EdgeStatus(),
        channel=_read(out / "channel.json", ChannelStatus, notes) or ChannelStatus(),
        series=_read_rows(out / "series.jsonl", UpdateRow, notes),
        ages=_read_rows(out / "ages.jsonl", AgesRow, notes),
        # Not of a fit.
        shown=_read_rows(out / "shown.jsonl", ShownRow, notes, optional=True),
        frontier=_read(out / "frontier.json", Frontier, notes, optional=True),
        # Only where one command started all of them.
        processes=_read_rows(out / "processes.jsonl", ProcessRow, notes, optional=True),
        command=(_read(out / "run.json", _Started, notes, optional=True) or _Started()).command,
        notes=notes,
    )
    files.restarts_s = restarts([row.t_s for row in files.ages])
    for name in ("truth", "rendered"):
        path = out / f"{name}.png"
        if path.is_file():
            files.images[name] = path
    starts_s = [0.0, *files.restarts_s] if files.restarts_s else []
    timed: tuple[tuple[list[Any], list[float]], ...] = (
        (files.ages, []),
        (files.series, starts_s),
        (files.shown, starts_s),
    )
    for rows, starts in timed:
        placed = zip(rows, continuous([row.t_s for row in rows], starts))
        kept = [(t_s, row) for row, t_s in placed if row.t_s > 0.0 or not starts]  # others only mark a start
        for t_s, row in kept:
            row.t_s = t_s
        rows[:] = sorted((row for _, row in kept), key=lambda row: row.t_s)
    for usage, t_s in zip(files.processes, continuous([row["t_s"] for row in files.processes])):
        usage["t_s"] = t_s
    return files


def continuous(times_s: Sequence[float], starts_s: Sequence[float] = ()) -> list[float]:
    """Seconds since a process first started, of rows in the order in which they were written: a step back by
    more than ``LATE_S``, or to 0, is a restart, which counts from zero again and goes on where the earlier rows end.

    starts_s: when each process started, where that is known and they are several: one may have written no row."""
    shift = last = 0.0
    number, found = 0, list[float]()
    for t_s in times_s:
        if t_s + shift < last - LATE_S or (t_s == 0.0 and (found or starts_s)):
            number += 1
            shift = last = starts_s[number] if number < len(starts_s) else last
        found.append(t_s + shift)
        last = max(last, t_s + shift)
    return found


def restarts(times_s: Sequence[float]) -> list[float]:
    """When the process that wrote these rows restarted, on the scale of ``continuous``."""
    placed = continuous(times_s)
    return [placed[k] for k in range(1, len(placed)) if times_s[k] < times_s[k - 1] - LATE_S or times_s[k] == 0.0]


def _read(path: Path, kind: type[T], notes: list[str], optional: bool = False) -> T | None:
    """The contents of a JSON file; None with a note if it is missing (unless optional) or invalid."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except FileNotFoundError:
        if not optional:
            notes.append(f"{path.name} is missing")
    except (OSError, ValueError, RecursionError) as error:
        notes.append(f"{path.name} left out: {error}")
    return None


def _read_rows(path: Path, kind: Any, notes: list[str], optional: bool = False) -> list[Any]:
    """Valid rows of a JSON-lines file; a note counts the others."""
    try:
        lines = path.read_bytes().splitlines()
    except OSError:
        if not optional:
            notes.append(f"{path.name} is missing")
        return []
    decoder, rows = msgspec.json.Decoder(kind), []
    for line in lines:
        try:
            row = decoder.decode(line)
        except (ValueError, RecursionError):
            continue
        if not isinstance(row, dict) or isinstance(row.get("t_s"), float):
            rows.append(row)
    if bad := len(lines) - len(rows):
        notes.append(f"{path.name}: {bad} of {len(lines)} lines unreadable (killed while writing?)")
    return rows
