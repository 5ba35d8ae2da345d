"""Reads what a run left in its folder. Missing, torn and strange files cost a note, never the report."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Row = dict[str, Any]

MEASURED = (
    "chamfer_mm", "complete", "accuracy_median_mm", "within_mm", "target_chamfer_mm", "target_complete",
)  # fmt: skip


@dataclass
class Records:
    """Contents of a run's folder. ages: rows {t_s, age_ms: {camera: ms or None}}; processes: rows
    {t_s, name: {rss_mb, cpu, pid}}; mesh: as ``edge-server export --json`` writes it; series: rows as in
    state.Publication; pictures: by name, those that exist. notes: one line for people for whatever was
    missing or torn."""

    out: Path
    edge: Row = field(default_factory=dict)
    channel: Row = field(default_factory=dict)
    series: list[Row] = field(default_factory=list)
    ages: list[Row] = field(default_factory=list)
    processes: list[Row] = field(default_factory=list)
    mesh: Row = field(default_factory=dict)
    pictures: dict[str, Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def read_records(out: Path) -> Records:
    """Everything a report needs from ``out``. Raises FileNotFoundError only if there is no such folder."""
    if not out.is_dir():
        raise FileNotFoundError(f"{out} is not a folder: give the folder of a run (its --out)")
    records = Records(out)
    records.edge = _read_json(out / "edge.json", records.notes)
    records.channel = _read_json(out / "channel.json", records.notes)
    records.series = _continuous(_read_lines(out / "series.jsonl", records.notes))
    records.ages = _continuous(_read_lines(out / "ages.jsonl", records.notes))
    if (out / "processes.jsonl").exists():  # written only where one command started all processes
        records.processes = _continuous(_read_lines(out / "processes.jsonl", records.notes))
    if (out / "mesh.json").exists():  # only where the scenario asks for one
        records.mesh = _mesh(_read_json(out / "mesh.json", records.notes), records.notes)
    for name in ("truth", "rendered"):
        path = out / f"{name}.png"
        if path.is_file():
            records.pictures[name] = path
    return records


def _mesh(data: Row, notes: list[str]) -> Row:
    """``data`` if it is what the export writes, else nothing and a note."""
    try:
        found = data["measured"]
        numbers = [data["triangles"], data["seconds"], *data["stages_s"].values()]
        numbers += [] if found is None else [found[name] for name in MEASURED]
        if isinstance(data["file"], str) and all(isinstance(n, int | float) for n in numbers):
            return data
    except (KeyError, TypeError, AttributeError):
        pass
    if data:
        notes.append("mesh.json left out: not what edge-server export --json writes")
    return {}


def _read_json(path: Path, notes: list[str]) -> Row:
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError:
        notes.append(f"{path.name} is missing")
    except (OSError, ValueError) as error:
        notes.append(f"{path.name} left out: {error}")
    else:
        if isinstance(data, dict):
            return data
        notes.append(f"{path.name} left out: expected an object")
    return {}


def _read_lines(path: Path, notes: list[str]) -> list[Row]:
    """Rows of a JSON-lines file that are objects with a time ``t_s``; the others are counted in a note."""
    try:
        lines = path.read_bytes().splitlines()
    except OSError:
        notes.append(f"{path.name} is missing")
        return []
    rows, bad = [], 0
    for line in lines:
        try:
            row = json.loads(line)
            timed = isinstance(row, dict) and math.isfinite(row["t_s"])
        except (ValueError, KeyError, TypeError, OverflowError):
            timed = False
        if timed:
            rows.append(row)
        else:
            bad += 1
    if bad:
        notes.append(f"{path.name}: {bad} of {len(lines)} lines unreadable (killed while writing?)")
    return rows


def _continuous(rows: list[Row]) -> list[Row]:
    """A process that was restarted counts its seconds from zero again: put its rows after the others."""
    shift = previous = 0.0
    for row in rows:
        if row["t_s"] + shift < previous:
            shift = previous
        row["t_s"] = previous = row["t_s"] + shift
    return rows
