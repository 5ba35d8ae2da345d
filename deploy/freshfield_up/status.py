"""A run in a line while it goes on, from the status files in its folder, and in a few at its end, from report.json.

The edge writes ``edge.json``, the emulator ``channel.json`` and the nodes ``node-*.json``. A file that is
missing or unexpected leaves a gap in the line and has no other effect.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from freshfield.files import read_status
from freshfield.scenario import NOTHING_HELD_OUT

Status = dict[str, Any]


def status_line(out: Path, cameras: int) -> str:
    """Cameras, field and channel of the run in ``out`` in one line. cameras: their number."""
    edge = read_status(out / "edge.json")
    listed = edge.get("cameras")
    each = [camera for camera in listed if isinstance(camera, dict)] if isinstance(listed, list) else []
    ages = sorted(age for camera in each if (age := number(camera, "age_ms")) is not None)
    median = f", age {ages[len(ages) // 2]:.0f} ms (median)" if ages else ""
    return (
        f"{len(ages)}/{cameras} cameras{median}; {_edge_line(edge)}; {_channel_line(read_status(out / 'channel.json'))}"
    )


def number(status: Status, *path: str) -> float | None:
    """The number at a path of keys, or None."""
    found: Any = status
    for key in path:
        found = found.get(key) if isinstance(found, dict) else None
    return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None


def fmt(value: float | None, spec: str) -> str:
    """``value`` in a format such as ``.1f``; a dash for None."""
    return "-" if value is None else format(value, spec)


def _channel_line(channel: Status) -> str:
    if not channel:
        return "no channel yet"
    forwarded = fmt(number(channel, "counts", "forwarded"), ".0f")
    error_ms = fmt(number(channel, "delay_error_ms", "p99"), ".2f")
    return f"{channel.get('preset') or 'custom'}, forwarded {forwarded}, delay error p99 {error_ms} ms"


def _edge_line(edge: Status) -> str:
    updates = number(edge, "updates", "count")
    if not updates:
        return str(edge.get("doing") or "no update yet")
    if isinstance(edge.get("so_far"), dict):
        now, whole = (fmt(number(edge, "so_far", name), ".2f") for name in ("now_psnr_db", "all_psnr_db"))
        poses = ", at refined poses" if edge["so_far"].get("refined") else ""
        score = f"held out now {now} dB, all frames so far {whole} dB{poses}"
    else:
        views = f" on {NOTHING_HELD_OUT}" if (edge.get("scores") or {}).get("on") == "selected" else ""
        score = f"PSNR {fmt(number(edge, 'scores', 'psnr_db'), '.2f')} dB{views}"
    paused = " (paused)" if edge.get("paused") else ""
    return f"{updates:.0f} updates, {fmt(number(edge, 'updates', 'ms_p50'), '.0f')} ms each, {score}{paused}"


def summarize(out: Path) -> str:
    """The report's conclusion, what became of the frames, and where the report is. Missing numbers are shown as
    ``-``."""
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    frames = report.get("frames") or {}
    counts = [f"{fmt(frames.get(name), 'd')} {name}" for name in ("captured", "sent", "delivered")]
    rejected = sum((frames.get("rejected") or {}).values())
    lines = [
        "",
        *report.get("conclusion", ()),
        f"frames     {', '.join(counts)}, {rejected} rejected; {_accounted(frames)}",
        f"report     {out / 'report.html'}   {out / 'report.json'}",
    ]
    return "\n".join(lines)


def _accounted(frames: dict[str, Any]) -> str:
    """Whether every frame is accounted for, and why not."""
    if not frames.get("closes"):
        return "NOT ALL ACCOUNTED FOR: " + "; ".join(frames.get("doubts") or ["no account"])
    cut_off = frames.get("cut_off")
    return "all accounted for" + (f", {cut_off} of them cut off by the end of a process" if cut_off else "")
