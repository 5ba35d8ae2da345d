"""The end of a run in a few lines, from its report.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def summarise(out: Path) -> str:
    """What a person wants to know first, and where the rest is. Missing figures are shown as ``-``."""
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    frames, age = report.get("frames", {}), report.get("age_ms", {})
    updates, fidelity = report.get("updates", {}), report.get("fidelity", {})
    final, baseline = fidelity.get("final") or {}, fidelity.get("baseline") or {}
    rejected = sum(frames.get("rejected", {}).values())
    lines = [
        "",
        f"fidelity   PSNR {_f(final.get('psnr_db'), '.2f')} dB over the last fifth of the run "
        f"(moving parts {_f(final.get('psnr_moving_db'), '.2f')} dB, SSIM {_f(final.get('ssim'), '.3f')}, "
        f"LPIPS {_f(final.get('lpips'), '.3f')})",
        f"baselines  mean colour {_f(baseline.get('mean_colour_db'), '.1f')} dB, "
        f"nearest view {_f(baseline.get('nearest_view_db'), '.1f')} dB",
        f"age        mean {_f(age.get('mean'), '.0f')} ms, p95 {_f(age.get('p95'), '.0f')} ms",
        f"updates    {_f(updates.get('count'), 'd')} of {_f(updates.get('ms_p50'), '.0f')} ms "
        f"(p95 {_f(updates.get('ms_p95'), '.0f')} ms), the first after {_seconds(updates.get('first_ms'))}",
        f"frames     {_f(frames.get('captured'), 'd')} captured, {_f(frames.get('sent'), 'd')} sent, "
        f"{_f(frames.get('delivered'), 'd')} delivered, {rejected} rejected; "
        f"the books {'close' if frames.get('closes') else 'DO NOT CLOSE'}",
        *_mesh(report.get("mesh")),
        f"report     {out / 'report.html'}   {out / 'report.json'}",
    ]
    return "\n".join(lines)


def _mesh(mesh: dict[str, Any] | None) -> list[str]:
    """A line where the scenario asked for a mesh."""
    if not mesh:
        return []
    found = mesh.get("measured")
    line = f"mesh       {mesh['file']}: {mesh['triangles']:,} triangles, made in {mesh['seconds']:.0f} s"
    if found:
        line += (
            f"; chamfer {found['chamfer_mm']:.2f} mm (target {found['target_chamfer_mm']:g}), "
            f"{100 * found['complete']:.0f} % of the surface within {found['within_mm']:g} mm "
            f"(target {100 * found['target_complete']:g})"
        )
    return [line]


def _f(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)


def _seconds(value_ms: float | None) -> str:
    return "-" if value_ms is None else f"{value_ms / 1e3:.1f} s"
