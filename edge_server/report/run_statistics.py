"""Figures of a run in numbers: its ages, updates, depth, fidelity, and what was shown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
import numpy as np

from edge_server.fidelity.scorer import METRICS, SHOWN
from edge_server.report.report_constants import FINAL_SHARE
from edge_server.run_records import (
    AgesRow,
    Baseline,
    DepthStatus,
    EdgeStatus,
    ShownRow,
    UpdateCounts,
    UpdateRow,
    age_parts_ms,
)

SERIES = ("t_s", *METRICS, "aaoi_ms", "selected", "update_ms", "truth_gap_ms")


def ages(rows: Sequence[AgesRow]) -> dict[str, Any]:
    """Age of the newest buffered frame, averaged over time: {mean, p50, p95, by_camera: {camera: the same, or
    None if it never reported}}. Samples are evenly spaced, so their mean is the time average."""
    samples: dict[str, list[float]] = {}
    for row in rows:
        for camera, age_ms in row.age_ms.items():
            values = samples.setdefault(camera, [])
            if age_ms is not None:
                values.append(age_ms)
    everything = [age_ms for values in samples.values() for age_ms in values]
    total = _spread(everything) or {"mean": None, "p50": None, "p95": None}
    return {**total, "by_camera": {camera: _spread(values) for camera, values in sorted(samples.items())}}


def depth(status: DepthStatus, rows: Sequence[AgesRow]) -> dict[str, Any]:
    """Received depth: {frames, bytes, undecodable: number of damaged ones, age_ms: of the newest depth, averaged
    over time like ``ages``, cameras: {camera: {frames, bytes}}}."""
    counts = status.cameras.values()
    return {
        "frames": sum(camera.frames for camera in counts),
        "bytes": sum(camera.bytes for camera in counts),
        "undecodable": status.undecodable,
        "age_ms": _spread([age_ms for row in rows for age_ms in row.depth_age_ms.values()]),
        "cameras": msgspec.to_builtins(status.cameras),
    }


def updates(series: Sequence[UpdateRow], edge: UpdateCounts, restarted: bool = False) -> dict[str, Any]:
    """Number and duration of updates.

    series: rows of updates, used if the edge has no count; not every update has a row.
    edge: the edge's own counts. restarted: its times cover only its last process, so those of the rows are used.
    Returns {count, ms_p50, ms_p95, first_ms: from the start of the edge to the first publication,
    undecodable, shed: frames left out for lack of time, without_step: updates without time for an optimizer
    step, refused: {camera: how often the field left its image out}}.
    """
    spent = [row.update_ms for row in series if row.update_ms is not None]
    p50, p95 = np.percentile(spent, [50, 95]).tolist() if spent else (None, None)
    if restarted and series:
        edge = msgspec.structs.replace(edge, ms_p50=p50, ms_p95=p95, first_ms=None)
    refused = Counter(camera for row in series for camera in row.refused)
    return {
        "count": max(len(series), edge.count),
        "ms_p50": edge.ms_p50 or p50,
        "ms_p95": edge.ms_p95 or p95,
        "first_ms": edge.first_ms if edge.first_ms is not None or not series else 1e3 * series[0].t_s,
        "undecodable": edge.undecodable,
        "shed": edge.shed,
        "without_step": edge.without_step or 0,
        "refused": dict(sorted((refused | Counter(edge.refused)).items())),
    }


def last_share_s(first_ms: float | None, ended_s: float) -> float:
    """When the last fifth of a run begins, counted from its first publication to the last sample of ages: compiling
    kernels before it may take longer than a short run, and afterwards files are written and nothing is shown."""
    return ended_s - FINAL_SHARE * (ended_s - (first_ms or 0.0) / 1e3)


def fidelity(series: Sequence[UpdateRow], late_s: float, edge: EdgeStatus) -> dict[str, Any]:
    """Scores against the held-out views at publication: {final, mean, baseline, lpips_missing, lpips_network,
    so_far: see ``SoFarScores``, scored_on, scored, late_s, series}. ``final``: mean from ``late_s`` on."""
    return {
        "final": _means(_since(late_s, series), METRICS),
        "mean": _means(series, METRICS),
        "baseline": msgspec.to_builtins(edge.baseline or Baseline()),
        "lpips_missing": edge.lpips_missing,
        "lpips_network": edge.lpips_network,
        "so_far": msgspec.to_builtins(edge.so_far),
        "scored_on": sorted({row.scored_on for row in series if row.scored_on}),
        "scored": sum(row.psnr_db is not None for row in series),
        "late_s": late_s,
        "series": [{name: getattr(row, name) for name in SERIES} for row in series],
    }


def shown(rows: Sequence[ShownRow], series: Sequence[UpdateRow], late_s: float, ended_s: float) -> dict[str, Any]:
    """What was shown at random instants from ``late_s`` to the run's end at ``ended_s``: mean of each score, count
    of the instants, and age_ms {network, waiting, computing, display}: the parts of the mean age of the views
    behind what was shown. Where nothing is held out, no instant is scored: the age follows from the updates."""
    late = _since(late_s, rows)
    parts = ("network", "waiting", "computing", "display")
    ages = _means([row.age_ms for row in late], parts)
    if not late:
        ages |= age_parts_ms([row for row in _since(late_s, series) if row.number is not None], ended_s)
    return {**_means(late, SHOWN), "count": len(late), "age_ms": ages}


def _since(late_s: float, rows: Sequence[Any]) -> list[Any]:
    return [row for row in rows if row.t_s >= late_s]


def _means(rows: Iterable[Any], names: Sequence[str]) -> dict[str, float | None]:
    """The mean of each attribute over the rows that have it; None if none has."""
    known = {name: [value for row in rows if (value := getattr(row, name)) is not None] for name in names}
    return {name: float(np.mean(values)) if values else None for name, values in known.items()}


def _spread(values: Sequence[float]) -> dict[str, float | None] | None:
    if not values:
        return None
    p50, p95 = np.percentile(values, [50, 95])
    return {"mean": float(np.mean(values)), "p50": float(p50), "p95": float(p95)}
