"""Reads the status files that the processes of a run keep up to date in its folder.

The edge writes ``edge.json``, the emulator ``channel.json`` and the nodes ``node-*.json``. A file that is
missing or unexpected leaves a gap in the display and has no other effect.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Status = dict[str, Any]


@dataclass(frozen=True)
class RunStatus:
    """The newest status of all processes. cameras: one mapping a camera, merged from its node and the
    edge."""

    cameras: tuple[Status, ...]
    channel: Status
    edge: Status


def read_status(out: Path, cameras: tuple[str, ...]) -> RunStatus:
    """The newest status of every process."""
    edge = read_json(out / "edge.json")
    merged: dict[str, Status] = {camera: {"camera": camera} for camera in cameras}
    for file in sorted(out.glob("node-*.json")):
        for camera, status in _by_camera(read_json(file)).items():
            merged.setdefault(camera, {}).update(status)
    for camera, status in _by_camera(edge).items():
        merged.setdefault(camera, {}).update(status)
    return RunStatus(tuple(merged.values()), read_json(out / "channel.json"), edge)


def number(status: Status, *path: str) -> float | None:
    """The number at a path of keys, or None."""
    found: Any = status
    for key in path:
        found = found.get(key) if isinstance(found, dict) else None
    return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None


def fmt(value: float | None, spec: str) -> str:
    """``value`` in a format such as ``.1f``; a dash for None."""
    return "-" if value is None else format(value, spec)


def _by_camera(status: Status) -> dict[str, Status]:
    """The ``cameras`` of a status file: a mapping by name, or a list of mappings with a key ``camera``."""
    cameras = status.get("cameras", {})
    if isinstance(cameras, dict):
        return {name: {"camera": name, **w} for name, w in cameras.items() if isinstance(w, dict)}
    return {w["camera"]: w for w in cameras if isinstance(w, dict) and isinstance(w.get("camera"), str)}


def read_json(path: Path) -> Status:
    """The contents of a status file; {} if it cannot be read."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
