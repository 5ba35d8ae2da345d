"""What the processes say about themselves, read from the files they keep fresh in the run's folder.

``edge.json`` and ``channel.json`` are the edge's and the emulator's, ``node-*.json`` the nodes'. A file that
is missing or has other contents than expected leaves a gap in the display and nothing else.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Words = dict[str, Any]


@dataclass(frozen=True)
class RunStatus:
    """cameras: one mapping a camera, the nodes' view and the edge's merged, in the scenario's order."""

    cameras: tuple[Words, ...]
    channel: Words
    edge: Words


def read_status(out: Path, cameras: tuple[str, ...]) -> RunStatus:
    """The newest status of everybody."""
    edge = read_json(out / "edge.json")
    merged: dict[str, Words] = {camera: {"camera": camera} for camera in cameras}
    for file in sorted(out.glob("node-*.json")):
        for camera, words in _by_camera(read_json(file)).items():
            merged.setdefault(camera, {}).update(words)
    for camera, words in _by_camera(edge).items():
        merged.setdefault(camera, {}).update(words)
    return RunStatus(tuple(merged.values()), read_json(out / "channel.json"), edge)


def number(words: Words, *path: str) -> float | None:
    """The number at a path of keys, or None."""
    found: Any = words
    for key in path:
        found = found.get(key) if isinstance(found, dict) else None
    return float(found) if isinstance(found, int | float) and not isinstance(found, bool) else None


def _by_camera(words: Words) -> dict[str, Words]:
    """The ``cameras`` of a status file, which is a list of mappings that name their camera, or a mapping."""
    cameras = words.get("cameras", {})
    if isinstance(cameras, dict):
        return {name: {"camera": name, **w} for name, w in cameras.items() if isinstance(w, dict)}
    return {w["camera"]: w for w in cameras if isinstance(w, dict) and isinstance(w.get("camera"), str)}


def read_json(path: Path) -> Words:
    """A status file's contents; empty if there is none to be read."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
