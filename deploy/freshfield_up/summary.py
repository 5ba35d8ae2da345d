"""A run in a few lines, from its report.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from freshfield.scenario import NOTHING_HELD_OUT
from freshfield_up.status import fmt, held_out

SHARE = 0.05  # of updates that learned nothing, from which on advice is worth a line; as in the report's conclusion
TOO_SHORT = "smaller pictures (source.scale, or width and height) or longer updates (edge.update_ms) give them time"


def summarize(out: Path) -> str:
    """The main results and where the report is. Missing numbers are shown as ``-``; what needs a held-out camera is
    left out without one."""
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    frames, age = report.get("frames", {}), report.get("age_ms", {})
    updates, fidelity = report.get("updates", {}), report.get("fidelity", {})
    rejected = sum(frames.get("rejected", {}).values())
    shed = f", {n} of them left out for lack of time" if (n := updates.get("shed")) else ""
    idle = updates.get("without_step") or 0
    lines = [
        "",
        *_fidelity(fidelity),
        *_baselines(fidelity.get("baseline") or {}),
        f"age        mean {fmt(age.get('mean'), '.0f')} ms, p95 {fmt(age.get('p95'), '.0f')} ms",
        f"updates    {fmt(updates.get('count'), 'd')} of {fmt(updates.get('ms_p50'), '.0f')} ms "
        f"(p95 {fmt(updates.get('ms_p95'), '.0f')} ms), the first after {_seconds(updates.get('first_ms'))}"
        + (f"; {idle} of them had no time for a step of training" if idle else ""),
        *([f"           {TOO_SHORT}"] if idle > SHARE * (updates.get("count") or 0) else []),
        f"frames     {fmt(frames.get('captured'), 'd')} captured, {fmt(frames.get('sent'), 'd')} sent, "
        f"{fmt(frames.get('delivered'), 'd')} delivered{shed}, {rejected} rejected; "
        f"{_accounted(frames)}",
        f"report     {out / 'report.html'}   {out / 'report.json'}",
    ]
    return "\n".join(lines)


def _fidelity(fidelity: dict[str, Any]) -> list[str]:
    """What was shown and published. Of held-out cameras that move, their frames at refined poses: means over a time
    mix other views, and at given poses the rendering is off by as much as the poses are."""
    final, shown, so_far = fidelity.get("final") or {}, fidelity.get("shown") or {}, fidelity.get("so_far")
    age = _parts(shown.get("age_ms") or {})
    if so_far:
        given = f"; {fmt(shown.get('psnr_db'), '.2f')} dB at given ones" if so_far.get("refined") else ""
        return [f"held out   {held_out(so_far)}{given}", f"shown      {age}"]
    trained = "selected" in fidelity.get("scored_on", ())
    views = f" on {NOTHING_HELD_OUT}" if trained else ""
    seen = [
        f"shown      PSNR {fmt(shown.get('psnr_db'), '.2f')} dB over the last fifth of the run "
        f"(moving pixels {fmt(shown.get('psnr_moving_db'), '.2f')} dB, still "
        f"{fmt(shown.get('psnr_still_db'), '.2f')}), {age}"
    ]
    return [
        *(([f"shown      {age}"] if any(shown["age_ms"].values()) else []) if trained else seen),
        f"published  PSNR {fmt(final.get('psnr_db'), '.2f')} dB over the last fifth of the run{views} "
        f"(moving pixels {fmt(final.get('psnr_moving_db'), '.2f')} dB, SSIM {fmt(final.get('ssim'), '.3f')}, "
        f"LPIPS {fmt(final.get('lpips'), '.3f')})",
    ]


def _baselines(baseline: dict[str, Any]) -> list[str]:
    names = {"mean_color_db": "mean color", "nearest_view_db": "nearest view"}
    known = [f"{what} {db:.1f} dB" for name, what in names.items() if (db := baseline.get(name)) is not None]
    return [f"baselines  {', '.join(known)}"] if known else []


def _accounted(frames: dict[str, Any]) -> str:
    """Whether every frame is accounted for, and why not."""
    if not frames.get("closes"):
        return "NOT ALL ACCOUNTED FOR: " + "; ".join(frames.get("doubts") or ["no account"])
    cut_off = frames.get("cut_off")
    return "all accounted for" + (f", {cut_off} of them cut off by the end of a process" if cut_off else "")


def _parts(age_ms: dict[str, Any]) -> str:
    """What the age of the views that were shown consists of."""
    return "age of " + " + ".join(f"{fmt(ms, '.0f')} ms {part}" for part, ms in age_ms.items())


def _seconds(value_ms: float | None) -> str:
    return "-" if value_ms is None else f"{value_ms / 1e3:.1f} s"
