"""Builds report.json, report.html and the figures of a run from the files in its folder."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.fidelity.scorer import SHOWN
from edge_server.report.frame_accounting import account_frames
from edge_server.report.machine import machine, versions
from edge_server.report.run_files import Row, RunFiles, read_run_files
from freshfield.files import write_json, write_text
from freshfield.machine_load import outside_load

METRICS = ("psnr_db", "psnr_moving_db", "ssim", "lpips", "perceptual")
SERIES = ("t_s", *METRICS, "aaoi_ms", "selected", "update_ms", "truth_gap_ms")
# ``final`` is the mean of this last share of the run.
FINAL_SHARE = 0.2


def build_report(out_dir: str | Path) -> dict[str, Any]:
    """Write report.json, report.html and PNGs into the run's folder; returns what report.json holds.

    Works on what is there: after a kill, without the files of other machines, without a channel. ``notes``
    says what was missing. Raises FileNotFoundError if the folder does not exist.
    """
    # Lazy: only the figures need matplotlib.
    from edge_server.report.figures import draw_all
    from edge_server.report.html import render_html

    out = Path(out_dir)
    files = read_run_files(out)
    report = assemble(files)
    write_json(out / "report.json", report, indent=1)
    figures = draw_all(report, files)
    write_text(out / "report.html", render_html(report, figures))
    return report


def assemble(files: RunFiles) -> dict[str, Any]:
    """The contents of report.json. ``kind``: live, or fit for a recorded data set without a network, whose
    frames, ages and channel are None."""
    edge, series = files.edge, files.series
    notes = list(files.notes)
    if lost := _number(edge.get("lines_lost")):
        notes.append(f"the edge could not write {lost:.0f} lines of its results (a full disk?)")
    kind = "fit" if edge.get("kind") == "fit" else "live"
    accounting = account_frames(files.out)
    last_s = series[-1]["t_s"] if series else 0.0
    seconds = max(_number(edge.get("seconds", edge.get("uptime_s"))) or 0.0, last_s)
    report = {
        "kind": kind,
        "scenario": edge.get("scenario"),
        "seed": edge.get("seed"),
        "seconds": seconds,
        "field": edge.get("field"),
        "policy": {"name": edge.get("policy"), "value": edge.get("value")},
        "versions": versions(),
        "machine": machine(),
        "outside_load": outside_load(files.processes),
        "frames": {**accounting.as_dict(), "ledgers": accounting.ledgers},
        "age_ms": ages(files.ages),
        "updates": updates(series, edge.get("updates") or {}),
        "foreground": edge.get("foreground"),
        "fidelity": {**fidelity(series, seconds, edge), "shown": shown(files.shown, seconds)},
        "channel": {name: files.channel.get(name) for name in ("state_share", "drawn_delay_ms", "delay_error_ms")},
        "notes": notes + accounting.notes,
    }
    if files.mesh:
        report["mesh"] = files.mesh
    if kind == "fit":
        report |= {"data": edge.get("data"), "frames": None, "age_ms": None, "channel": None, "notes": []}
    cleaned: dict[str, Any] = _finite(report)
    return cleaned


def ages(rows: Sequence[Row]) -> dict[str, Any]:
    """Age of the newest buffered frame, averaged over time: {mean, p50, p95, by_camera: {camera: the same, or
    None if it never reported}}. Samples are evenly spaced, so their mean is the time average."""
    samples: dict[str, list[float]] = {}
    for row in rows:
        for camera, age in (row.get("age_ms") or {}).items():
            values = samples.setdefault(camera, [])
            if (known := _number(age)) is not None:
                values.append(known)
    everything = [age for values in samples.values() for age in values]
    total = _spread(everything) or {"mean": None, "p50": None, "p95": None}
    return {**total, "by_camera": {camera: _spread(values) for camera, values in sorted(samples.items())}}


def updates(series: Sequence[Row], edge: Row) -> dict[str, Any]:
    """Number and duration of updates.

    series: rows of updates, used where the edge has no count; not every update has a row.
    edge: the edge's own counts.
    Returns {count, ms_p50, ms_p95, first_ms: from the start of the edge to the first publication,
    undecodable, shed: frames left out for lack of time, without_step: updates without time for an optimizer
    step, refused: {camera: how often the field left its image out}}.
    """
    spent = _known(row.get("update_ms") for row in series)
    first = series[0]["t_s"] * 1e3 if series else None
    without_step = sum(row.get("steps") == 0 for row in series)
    refused = Counter(c for row in series for c in row.get("refused") or ())
    return {
        "count": max(len(series), int(_number(edge.get("count")) or 0)),
        **{
            name: edge.get(name) or (float(np.percentile(spent, share)) if spent else None)
            for name, share in (("ms_p50", 50), ("ms_p95", 95))
        },
        "first_ms": edge.get("first_ms", first),
        "undecodable": edge.get("undecodable"),
        "shed": edge.get("shed"),
        "without_step": max(without_step, int(_number(edge.get("without_step")) or 0)),
        "refused": dict(sorted((refused | Counter(edge.get("refused") or {})).items())),
    }


def fidelity(series: Sequence[Row], seconds: float, edge: Row) -> dict[str, Any]:
    """Scores against the held-out views at publication: {final, mean, baseline, lpips_missing, lpips_network,
    scored_on, scored, series}. ``final``: mean over the last fifth of the run's ``seconds``."""
    late = [row for row in series if row["t_s"] >= (1.0 - FINAL_SHARE) * seconds]
    baseline = edge.get("baseline") or {}
    return {
        "final": _means(late, METRICS),
        "mean": _means(series, METRICS),
        "baseline": {name: baseline.get(name) for name in ("mean_colour_db", "nearest_view_db")},
        "lpips_missing": edge.get("lpips_missing"),
        "lpips_network": edge.get("lpips_network"),
        "scored_on": sorted({str(row["scored_on"]) for row in series if row.get("scored_on")}),
        "scored": sum(row.get("psnr_db") is not None for row in series),
        "series": [{name: row.get(name) for name in SERIES} for row in series],
    }


def shown(rows: Sequence[Row], seconds: float) -> dict[str, Any]:
    """What was shown at random instants of the last fifth of the run's ``seconds``: mean of each score, count
    of the instants, and age_ms {network, waiting, computing, display}: the parts of the mean age of the views
    behind what was shown."""
    late = [row for row in rows if row["t_s"] >= (1.0 - FINAL_SHARE) * seconds]
    return {
        **_means(late, SHOWN),
        "count": len(late),
        "age_ms": {
            part: _mean((row.get("age_ms") or {}).get(part) for row in late)
            for part in ("network", "waiting", "computing", "display")
        },
    }


def _means(rows: Sequence[Row], names: Sequence[str]) -> dict[str, float | None]:
    return {name: _mean(row.get(name) for row in rows) for name in names}


def _mean(values: Iterable[Any]) -> float | None:
    known = _known(values)
    return float(np.mean(known)) if known else None


def _spread(values: Sequence[float]) -> dict[str, float | None] | None:
    if not values:
        return None
    p50, p95 = np.percentile(values, [50, 95])
    return {"mean": float(np.mean(values)), "p50": float(p50), "p95": float(p95)}


def _known(values: Iterable[Any]) -> list[float]:
    return [v for value in values if (v := _number(value)) is not None]


def _number(value: Any) -> float | None:
    """A finite number, or None for anything else a damaged file may hold."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def _finite(value: Any) -> Any:
    """The same structure with None in place of NaN and infinity, which JSON does not know."""
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
