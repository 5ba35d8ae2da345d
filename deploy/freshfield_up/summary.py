"""A run in a few lines, from its report.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from freshfield_up.status import fmt


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
