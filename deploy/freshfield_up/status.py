"""Reads the status files that the processes of a run keep up to date in its folder.

The edge writes ``edge.json``, the emulator ``channel.json`` and the nodes ``node-*.json``. A file that is
missing or unexpected leaves a gap in the line and has no other effect.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from freshfield.scenario import NOTHING_HELD_OUT

Status = dict[str, Any]


def status_line(out: Path, cameras: int) -> str:
    """Cameras, field and channel of the run in ``out`` in one line. cameras: their number."""
    edge = read_json(out / "edge.json")
    listed = edge.get("cameras")
    each = [camera for camera in listed if isinstance(camera, dict)] if isinstance(listed, list) else []
    ages = sorted(age for camera in each if (age := number(camera, "age_ms")) is not None)
    median = f", age {ages[len(ages) // 2]:.0f} ms (median)" if ages else ""
    return (
        f"{len(ages)}/{cameras} cameras{median}; {_edge_line(edge)}; {_channel_line(read_json(out / 'channel.json'))}"
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


def read_json(path: Path) -> Status:
    """The contents of a status file; {} if it cannot be read."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _channel_line(channel: Status) -> str:
    if not channel:
        return "no channel yet"
    parts = [str(channel.get("preset") or "custom")]
    state = channel.get("state")
    share = number(channel, "state_share", str(state))
    if state:
        parts.append(f"state {state}" + (f" ({share:.0%} of the time)" if share is not None else ""))
    parts.append(f"forwarded {fmt(number(channel, 'counts', 'forwarded'), '.0f')}")
    for fate in ("dropped_busy", "superseded", "skipped", "lost", "broken"):
        if count := number(channel, "counts", fate):
            parts.append(f"{fate.replace('_', ' ')} {count:.0f}")
    parts.append(f"delay error p99 {fmt(number(channel, 'delay_error_ms', 'p99'), '.2f')} ms")
    return ", ".join(parts)


def _edge_line(edge: Status) -> str:
    updates = number(edge, "updates", "count")
    if not updates:
        return str(edge.get("doing") or "no update yet")
    views = f" on {NOTHING_HELD_OUT}" if (edge.get("scores") or {}).get("on") == "selected" else ""
    so_far = edge.get("so_far")
    if isinstance(so_far, dict):
        poses = ", at refined poses" if so_far.get("refined") else ""
        now, whole = (fmt(number(so_far, name), ".2f") for name in ("now_psnr_db", "all_psnr_db"))
        frames = fmt(number(so_far, "frames"), ".0f")
        scores = [f"held out now {now} dB, all {frames} frames so far {whole} dB{poses}"]
    else:
        scores = [f"PSNR {fmt(number(edge, 'scores', 'psnr_db'), '.2f')} dB{views}"]
        if not views:
            scores += [f"moving {fmt(number(edge, 'scores', 'psnr_moving_db'), '.2f')} dB"]
    age_ms = number(edge, "last", "aaoi_ms")
    parts = [
        f"{updates:.0f} updates",
        f"{fmt(number(edge, 'updates', 'ms_p50'), '.0f')} ms each",
        *scores,
        *([] if age_ms is None else [f"views used {age_ms:.0f} ms old"]),
        f"policy {edge.get('policy', '-')}",
    ]
    return ", ".join(parts) + (" (paused)" if edge.get("paused") else "")
