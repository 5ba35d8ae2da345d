"""Reads what a run left in its folder. A missing, torn or unexpected file adds a note; the report goes on."""

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
class RunFiles:
    """Contents of a run's folder.

    edge, channel: status files of the edge and the emulator. series: rows as in state.Publication.
    shown: rows as ``Journal.shown`` writes them.
    ages: rows {t_s, age_ms: {camera: ms or None}}. processes: rows {t_s, name: {rss_mb, cpu, pid}}.
    frontier: what accuracy costs, as the edge had it. mesh: as ``edge-server export --json`` writes it.
    images: those that exist, by name.
    notes: one line for people on whatever was missing or torn.
    """

    out: Path
    edge: Row = field(default_factory=dict)
    channel: Row = field(default_factory=dict)
    series: list[Row] = field(default_factory=list)
    shown: list[Row] = field(default_factory=list)
    ages: list[Row] = field(default_factory=list)
    processes: list[Row] = field(default_factory=list)
    frontier: Row = field(default_factory=dict)
    mesh: Row = field(default_factory=dict)
    images: dict[str, Path] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def read_run_files(out: Path) -> RunFiles:
    """Everything a report needs from ``out``. Raises FileNotFoundError only if the folder does not exist."""
    if not out.is_dir():
        raise FileNotFoundError(f"{out} is not a folder: give the folder of a run (its --out)")
    files = RunFiles(out)
    files.edge = _read_json(out / "edge.json", files.notes)
    files.channel = _read_json(out / "channel.json", files.notes)
    files.series = _continuous(_read_lines(out / "series.jsonl", files.notes))
    files.ages = _continuous(_read_lines(out / "ages.jsonl", files.notes))
    # Not of a fit; processes only where one command started all of them.
    for name in [n for n in ("shown", "processes") if (out / f"{n}.jsonl").exists()]:
        setattr(files, name, _continuous(_read_lines(out / f"{name}.jsonl", files.notes)))
    if (out / "frontier.json").exists():  # not of a fit
        files.frontier = _read_json(out / "frontier.json", files.notes)
    if (out / "mesh.json").exists():  # only where the scenario asks for one
        files.mesh = _mesh(_read_json(out / "mesh.json", files.notes), files.notes)
    for name in ("truth", "rendered"):
        path = out / f"{name}.png"
        if path.is_file():
            files.images[name] = path
    return files


def _mesh(data: Row, notes: list[str]) -> Row:
    """``data`` if it has the keys that the export writes; else {} and a note."""
    try:
        measured = data["measured"]
        numbers = [data["triangles"], data["seconds"], *data["stages_s"].values()]
        numbers += [] if measured is None else [measured[name] for name in MEASURED]
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
    """Rows of a JSON-lines file that are objects with a finite ``t_s``; a note counts the others."""
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
    """Put rows of a restarted process, which counts its seconds from zero again, after the earlier ones."""
    shift = previous = 0.0
    for row in rows:
        if row["t_s"] + shift < previous:
            shift = previous
        row["t_s"] = previous = row["t_s"] + shift
    return rows
