"""Measures the gap between a field that follows a moving scene and one fitted from scratch.

A field that has converged on the first frame gets a short update with all training views of the next frame,
and so on; each update is scored on the held-out camera at its frame. At some frames a new field of the same
representation is fitted to the same views for fifteen seconds; its score is the reference for the follower,
and is interpolated between those frames.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.experiments.bench.run import RECORDINGS, BenchRun, available, data_file, recorded_files
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.common.tables import number as _db
from edge_server.experiments.scenes.multiview_sequence import MultiviewSequence, recorded_sequence, synthetic_sequence
from edge_server.experiments.scenes.multiview_still import mean_baselines
from edge_server.fidelity.scorer import Score, Scorer
from edge_server.fields import Budget, Field
from edge_server.fields.registry import make_field
from freshfield.machine_load import LoadMeter

NEAR_DB = 0.5
FRESH_S = 15.0  # duration of a fresh fit
_METRICS = {"whole": "psnr_db", "moving": "psnr_moving_db"}
SCENES = ("room", "kitchen")


@dataclass(frozen=True)
class Workload:
    """The amount of work.

    updates: number of updates of a run.
    update_s: durations of an update, one run for each.
    samples: number of frames at which a fresh field is fitted, including the first, where the follower
        starts.
    cameras, size, speed_m_per_s, fps: of the synthetic scene.
    options: options of the field.
    """

    updates: int = 100
    update_s: tuple[float, ...] = (1.0, 0.25)
    samples: int = 8
    cameras: int = 19
    size: int = 128
    speed_m_per_s: float = 1.0
    fps: float = 15.0
    options: Mapping[str, Any] = field(default_factory=dict)

    def sampled(self) -> list[int]:
        """The frames of the fresh fits, evenly spread from the first to the last."""
        return sorted({round(f) for f in np.linspace(0, self.updates, max(2, self.samples))})


FULL = Workload()
QUICK = Workload(updates=16, samples=3)
# For ``drift``: whether the quality of a field that follows a moving scene decreases.
DRIFT, QUICK_DRIFT = Workload(updates=300), Workload(updates=32, update_s=(0.25,), samples=3)


@dataclass(frozen=True)
class Following:
    """What is measured: one representation on one scene."""

    scene: str
    field: str
    workload: Workload


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure {SCENE: {scene, baseline, FIELD: {fresh, RUN: {series, gaps, ...}}}} of the requested fields.

    Recorded scenes need FRESHFIELD_DATA. Raises BenchError if a requested scene is not available.
    """
    return _measured(run, QUICK if run.quick else FULL, SCENES)


def measure_drift(run: BenchRun) -> dict[str, Any]:
    """As ``measure``, with more updates, and only for ``room`` unless scenes are requested."""
    return _measured(run, QUICK_DRIFT if run.quick else DRIFT, SCENES[:1])


def _measured(run: BenchRun, workload: Workload, usual: Sequence[str]) -> dict[str, Any]:
    workload = replace(workload, options=run.options)
    scenes = available(run.scenes or tuple(usual), asked=bool(run.scenes))
    points = [Following(scene, name, workload) for scene in scenes for name in run.names]
    rows = run.engine.run(
        follow,
        points,
        "following",
        files=lambda p: recorded_files(p.scene),
        describe=lambda p, _: f"{p.field} {p.scene}",
    )
    figures: dict[str, Any] = {}
    for scene in scenes:
        sequence = _sequence(scene, *_shape(workload))
        base = mean_baselines(sequence.training(0), sequence.truth(0))
        figures[scene] = {"baseline": base, "scene": sequence.describe(), "frame_ms": sequence.period_ms}
    for point, row in zip(points, rows):
        figures[point.scene][point.field] = row
    return figures


def _shape(workload: Workload) -> tuple[int, int, float, float]:
    return workload.cameras, workload.size, workload.fps, workload.speed_m_per_s


@cache
def _sequence(scene: str, cameras: int, size: int, fps: float, speed_m_per_s: float) -> MultiviewSequence:
    if scene not in RECORDINGS:
        return synthetic_sequence(scene, cameras, size, fps, speed_m_per_s=speed_m_per_s)
    path, holdout = RECORDINGS[scene]
    return replace(recorded_sequence(data_file(path), holdout), name=scene)


def follow(point: Following) -> dict[str, Any]:
    """Measure one representation on one scene."""
    name, workload = point.field, point.workload
    sequence = _sequence(point.scene, *_shape(workload))
    load, scorer = LoadMeter(), Scorer()
    figures: dict[str, Any] = {"fresh": {}}
    make_field(name, workload.options).warm_up()
    start: Field | None = None
    known: dict[int, dict[str, Any]] = {}  # a repeated frame is not fitted twice
    for frame in workload.sampled():
        key = sequence.key(frame)
        if key not in known:
            field = make_field(name, workload.options)
            report = field.fit(sequence.training(frame), Budget(seconds=FRESH_S))
            start = start or field  # the first frame comes first
            score = _row(sequence.score(field, frame, scorer))
            known[key] = {"fitted_s": report.seconds, "steps": report.steps, **score}
        # For comparison: the field of the first frame, never updated.
        assert start is not None
        stayed = _row(sequence.score(start, frame, scorer))
        stale = {f"not_updated_{metric}": stayed[metric] for metric in _METRICS.values()}
        figures["fresh"][str(frame)] = {**known[key], **stale}
        print(f"  {name} {point.scene}, fresh at frame {frame}: {_score_text(known[key])}", flush=True)
    assert start is not None
    warm = start.state()
    for seconds in workload.update_s:
        start.load_state(warm)
        figures[f"{seconds:g}_s"] = _run(start, sequence, workload, seconds, figures["fresh"], scorer)
    return {**figures, "outside_cores": load.outside_cores()}


def _run(
    field: Field,
    sequence: MultiviewSequence,
    workload: Workload,
    seconds: float,
    fresh: Mapping[str, Mapping[str, Any]],
    scorer: Scorer,
) -> dict[str, Any]:
    """Run updates of one duration, frame by frame."""
    rows: list[dict[str, Any]] = []
    for frame in range(1, workload.updates + 1):
        report = field.fit(sequence.training(frame), Budget(seconds=seconds))
        score = _row(sequence.score(field, frame, scorer))
        rows.append({"frame": frame, "fitted_s": report.seconds, "steps": report.steps, **score})
        if frame % max(1, workload.updates // 10) == 0:
            print(f"  update {frame} of {workload.updates} of {seconds:g} s: {_score_text(score)}", flush=True)
    return summary(rows, fresh)


def summary(rows: Sequence[Mapping[str, Any]], fresh: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Results of one run: the series, and the gap to the fresh fits in each metric.

    rows: one per update.
    fresh: frame (as text) -> scores of the fresh fit.
    """
    series = {key: [row[key] for row in rows] for key in (rows[0] if rows else ())}
    frames = [row["frame"] for row in rows]
    found: dict[str, Any] = {"updates": len(rows)}
    for key in ("fitted_s", "steps"):
        found[key] = statistics.median(series[key]) if rows else None
    for kind, metric in _METRICS.items():
        known = {int(f): row[metric] for f, row in fresh.items() if row[metric] is not None}
        tracked = [row[metric] for row in rows]
        scored = [v for v in tracked if v is not None]
        found[kind] = {"mean_db": statistics.fmean(scored) if scored else None}
        found[kind] |= gaps(frames, tracked, known)
    return {**found, "series": series}


def gaps(frames: Sequence[int], tracked: Sequence[float | None], fresh: Mapping[int, float]) -> dict[str, Any]:
    """The gap of a follower, fresh minus tracked in dB; all values are None if nothing is known.

    frames, tracked: frame and score of each update.
    fresh: scores at some frames; linearly interpolated, and constant before the first and after the last.

    Returns, with the mean of the fresh scores and the median gap, share_near: share of the updates within
    NEAR_DB; first_tenth_db, last_tenth_db: mean gaps; drift_db: the latter minus the former.
    """
    names = ("fresh_mean_db", "share_near", "median_db", "first_tenth_db", "last_tenth_db", "drift_db")
    known = [(f, v) for f, v in zip(frames, tracked) if v is not None]
    if not known or not fresh:
        return dict.fromkeys(names)
    at = sorted(fresh)
    reference = np.interp([f for f, _ in known], at, [fresh[f] for f in at])
    gap = reference - np.array([v for _, v in known])
    tenth = -(-len(gap) // 10)
    first, last = float(gap[:tenth].mean()), float(gap[-tenth:].mean())
    values = (reference.mean(), (gap <= NEAR_DB).mean(), np.median(gap), first, last, last - first)
    return dict(zip(names, map(float, values)))


def _score_text(score: Mapping[str, Any]) -> str:
    return f"PSNR {_db(score['psnr_db'])} dB, moving {_db(score['psnr_moving_db'])} dB"


def _row(score: Score) -> dict[str, Any]:
    return {"psnr_db": score.psnr_db, "psnr_moving_db": score.psnr_moving_db}


def _runs(figures: Mapping[str, Any]) -> Iterable[tuple[str, str, str, dict[str, Any], dict[str, Any]]]:
    """Yield (scene, representation, name of the run, run, all results of the representation)."""
    for scene, part in figures.items():
        if not isinstance(part, dict):
            continue
        for name, rows in part.items():
            if isinstance(rows, dict) and "fresh" in rows:
                for run, found in rows.items():
                    if isinstance(found, dict) and "series" in found:
                        yield scene, name, run, found, rows


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw PSNR over the updates, with the fresh fits as markers, to ``path`` (PNG): a row per scene, with
    whole image and moving pixels. Without results no file is written."""
    from edge_server.report.style import figure, label_lines

    found = list(_runs(figures))
    scenes = list(dict.fromkeys(scene for scene, *_ in found))
    if not scenes:
        return
    with figure(path, len(scenes), 2, height_inch=2.6) as (_, axes):
        for row, scene in zip(axes, scenes):
            below = "update" if scene == scenes[-1] else None
            of_scene = [rest for other, *rest in found if other == scene]
            for ax, metric in zip(row, _METRICS.values()):
                _panel(ax, metric, of_scene)
            label_lines(row[1], "PSNR (dB)", below, "pixels that move")
            row[0].set(title=figures[scene]["scene"], ylabel="PSNR (dB)", xlabel=below or "")


def _panel(ax: Any, metric: str, of_scene: Sequence[Sequence[Any]]) -> None:
    """Draw the lines of all runs and the markers of the fresh fits. of_scene: as ``_runs``, without the
    scene."""
    from edge_server.report.style import CYCLE, GRAY

    names = list(dict.fromkeys(name for name, *_ in of_scene))
    runs = list(dict.fromkeys(run for _, run, *_ in of_scene))
    for name, run, one, rows in of_scene:
        color, line = CYCLE[names.index(name) % len(CYCLE)], ("-", ":", "--", "-.")[runs.index(run) % 4]
        shown = [float("nan") if v is None else v for v in one["series"].get(metric, [])]
        label = f"{name}, {run.replace('_', ' ')}"
        ax.plot(one["series"].get("frame", []), shown, line, color=color, label=label)
        if run == runs[0]:
            ax.plot(*_fresh(rows, metric), "o", color=color, markersize=4.5, label=f"{name}, fresh")
    name, _, _, rows = of_scene[0]
    still = _fresh(rows, f"not_updated_{metric}")
    ax.plot(*still, "x", color=GRAY, markersize=4.5, label=f"{name}, never updated")


def _fresh(rows: Mapping[str, Any], key: str) -> tuple[list[int], list[float]]:
    """Frames of the fresh fits with a value of ``key``, and these values."""
    known = [(int(frame), row[key]) for frame, row in rows["fresh"].items() if row[key] is not None]
    return [frame for frame, _ in known], [value for _, value in known]


def table(figures: dict[str, Any]) -> str:
    """A Markdown table with a row per run: whole image, and moving pixels in parentheses."""
    head = (
        "scene|representation|update|updates|PSNR dB (moving)|fresh fit dB|never updated dB|"
        f"within {NEAR_DB} dB of fresh|median gap dB|gap of the first, last tenth dB|"
        "mean color, nearest view dB|outside cores"
    )
    rows = []
    for scene, name, run, found, of_field in _runs(figures):
        whole, moving = found["whole"], found["moving"]
        # Without the first frame, at which a field that is never updated is as good as the others.
        later = {"fresh": {f: row for f, row in of_field["fresh"].items() if f != "0"}}
        values = [_fresh(later, f"not_updated_{metric}")[1] for metric in _METRICS.values()]
        stayed = [statistics.fmean(v) if v else None for v in values]
        bases = figures[scene]["baseline"]
        rows.append(
            (
                scene,
                name,
                _length(run, found),
                found["updates"],
                _both(whole, moving, "mean_db"),
                _both(whole, moving, "fresh_mean_db"),
                f"{_db(stayed[0])} ({_db(stayed[1])})",
                f"{_percent(whole['share_near'])} ({_percent(moving['share_near'])})",
                _both(whole, moving, "median_db"),
                f"{_both(whole, moving, 'first_tenth_db')}, {_both(whole, moving, 'last_tenth_db')}",
                ", ".join(_db(bases[key]) for key in ("mean_colour_db", "nearest_view_db")),
                _db(of_field.get("outside_cores")),
            )
        )
    return markdown_table(head.split("|"), rows)


draw_drift, table_drift = draw, table


def _length(run: str, found: Mapping[str, Any]) -> str:
    steps = "" if found["steps"] is None else f" ({found['steps']:.0f} steps)"
    return run.replace("_", " ") + steps


def _both(whole: Mapping[str, Any], moving: Mapping[str, Any], key: str) -> str:
    return f"{_db(whole[key])} ({_db(moving[key])})"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"
