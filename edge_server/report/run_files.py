"""Reads what a run left in its folder. A missing, torn or unexpected file adds a note; the report goes on."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NotRequired, Required, TypedDict

import msgspec
from msgspec import Meta

Row = dict[str, Any]

# No number that a run measures or counts is larger.
Number = Annotated[int, Meta(ge=-(10**15), le=10**15)] | Annotated[float, Meta(ge=-1e15, le=1e15)]
Numbers = dict[str, Number | None]


class _Updates(TypedDict, total=False):
    count: Number | None
    ms_p50: Number | None
    ms_p95: Number | None
    first_ms: Number | None
    undecodable: Number | None
    shed: Number | None
    without_step: Number | None
    refused: dict[str, Number]


class _Data(TypedDict):
    file: str
    instant: str | None
    training: int
    held_out: list[str]
    missing: int


class _Histogram(TypedDict):
    edges_ms: list[Number]
    counts: list[Number]


class _Delays(TypedDict, total=False):
    count: Number | None
    mean: Number | None
    p50: Number | None
    p95: Number | None
    p99: Number | None
    max: Number | None
    histogram: _Histogram


class _FrontierPoint(TypedDict):
    effort: str
    update_ms: Number
    psnr_db: Number
    psnr_moving_db: Number


class _Measured(TypedDict):
    chamfer_mm: Number
    complete: Number
    accuracy_median_mm: Number
    within_mm: Number
    target_chamfer_mm: Number
    target_complete: Number


class _Mesh(TypedDict):
    file: str
    triangles: int
    vertices: NotRequired[int]
    watertight: NotRequired[bool]
    cameras: NotRequired[int]
    seconds: Number
    stages_s: dict[str, Number]
    measured: _Measured | None


class _Publication(TypedDict, total=False):
    t_s: Required[Number]
    number: Number
    selected: list[str] | Number | None
    refused: list[str] | None
    steps: Number | None
    update_ms: Number | None
    aaoi_ms: Number | None
    psnr_db: Number | None
    psnr_moving_db: Number | None
    ssim: Number | None
    lpips: Number | None
    perceptual: Number | None
    truth_gap_ms: Number | None
    scored_on: str | None


class _Shown(TypedDict, total=False):
    t_s: Required[Number]
    age_ms: Numbers | None
    psnr_db: Number | None
    psnr_moving_db: Number | None
    psnr_still_db: Number | None
    ssim: Number | None
    lpips: Number | None


class _Ages(TypedDict, total=False):
    t_s: Required[Number]
    age_ms: Numbers | None


# What a report takes from the files, and its types: of JSON files key by key, of JSON lines row by row.
_EDGE: dict[str, Any] = {
    "kind": str,
    "scenario": str | None,
    "seed": int | None,
    "field": str | None,
    "policy": str | None,
    "value": Number | None,
    "seconds": Number,
    "uptime_s": Number,
    "lines_lost": Number,
    "updates": _Updates | None,
    "foreground": Numbers | None,
    "baseline": Numbers | None,
    "data": _Data | None,
    "lpips_missing": str | None,
    "lpips_network": str | None,
}
_CHANNEL: dict[str, Any] = {
    "state_share": dict[str, Number] | None,
    "drawn_delay_ms": _Delays | None,
    "delay_error_ms": _Delays | None,
}
_FRONTIER: dict[str, Any] = {"points": list[_FrontierPoint], "about": str}
_ROWS: dict[str, Any] = {
    "series": _Publication,
    "ages": _Ages,
    "shown": _Shown,
    "processes": dict[str, Number | Numbers | None],
}


@dataclass
class RunFiles:
    """Contents of a run's folder.

    edge, channel: status files of the edge and the emulator.
    series: rows as in state.Publication. shown: rows as ``Journal.shown`` writes them.
    ages: rows {t_s, age_ms: {camera: ms or None}}.
    processes: rows {t_s, name: {rss_mb, cpu, pid}}.
    frontier: the frontier that the edge used. mesh: as ``edge-server export --json`` writes it.
    images: those that exist, by name.
    notes: lines for people on whatever was missing or torn.
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
    files.edge = _read_json(out / "edge.json", _EDGE, files.notes)
    files.channel = _read_json(out / "channel.json", _CHANNEL, files.notes)
    files.series = _continuous(_read_lines(out / "series.jsonl", files.notes))
    files.ages = _continuous(_read_lines(out / "ages.jsonl", files.notes))
    # Not of a fit; processes only where one command started all of them.
    for name in [n for n in ("shown", "processes") if (out / f"{n}.jsonl").exists()]:
        setattr(files, name, _continuous(_read_lines(out / f"{name}.jsonl", files.notes)))
    if (out / "frontier.json").exists():  # not of a fit
        files.frontier = _read_json(out / "frontier.json", _FRONTIER, files.notes)
    if (out / "mesh.json").exists():  # only where the scenario asks for one
        files.mesh = _read_json(out / "mesh.json", _Mesh, files.notes)
    for name in ("truth", "rendered"):
        path = out / f"{name}.png"
        if path.is_file():
            files.images[name] = path
    return files


def _read_json(path: Path, model: Any, notes: list[str]) -> Row:
    """The part of an object in a JSON file that ``model`` names: key by key, or with a TypedDict all or
    nothing."""
    kept: Row = {}
    try:
        data = msgspec.convert(_parse(path.read_bytes()), dict[str, Any])
        if not isinstance(model, dict):
            return msgspec.convert(data, model)
    except FileNotFoundError:
        notes.append(f"{path.name} is missing")
        return kept
    except (OSError, ValueError, RecursionError) as error:
        notes.append(f"{path.name} left out: {error}")
        return kept
    for key in [key for key in model if key in data]:
        try:
            kept[key] = msgspec.convert(data[key], model[key])
        except ValueError as error:
            notes.append(f"{path.name}: {key} left out: {error}")
    return kept


def _read_lines(path: Path, notes: list[str]) -> list[Row]:
    """Rows of a JSON-lines file that are what they should be; a note counts the others."""
    try:
        lines = path.read_bytes().splitlines()
    except OSError:
        notes.append(f"{path.name} is missing")
        return []
    rows: list[Row] = []
    for line in lines:
        try:
            row = msgspec.convert(_parse(line), _ROWS[path.stem])
            if isinstance(row.get("t_s"), int | float):
                rows.append(row)
        except (ValueError, RecursionError):
            pass
    if bad := len(lines) - len(rows):
        notes.append(f"{path.name}: {bad} of {len(lines)} lines unreadable (killed while writing?)")
    return rows


def _parse(text: bytes) -> Any:
    """JSON, with None in place of NaN and infinity."""
    return json.loads(text, parse_constant=lambda name: None)


def _continuous(rows: list[Row]) -> list[Row]:
    """Put rows of a restarted process, which counts its seconds from zero again, after the earlier ones."""
    shift = previous = 0.0
    for row in rows:
        if row["t_s"] + shift < previous:
            shift = previous
        row["t_s"] = previous = row["t_s"] + shift
    return rows
