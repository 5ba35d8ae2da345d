"""Measures each representation on several scenes: fidelity against seconds of fitting from scratch.

Every point is a new field, fitted from scratch for a planned time, because a fit schedules its learning rate
over its time. Scores are of held-out cameras. For every scene there are two baselines that need no field: the
mean color of the training images, and the training image nearest to each held-out camera.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.bench.run import BenchError, BenchRun
from edge_server.experiments.common.tables import grouped, markdown_table, number
from edge_server.experiments.frontier.from_scratch import Fit, Still, curves, fit_from_scratch, views_of
from edge_server.experiments.scenes.multiview_still import mean_baselines, smallest_angle_deg
from edge_server.fidelity.lpips_weights import open_lpips, weights_folder
from edge_server.fields.registry import settings_of

TARGETS_DB = (22, 25, 28, 30)
SYNTHETIC = ("tile", "room")
# Recordings: path below the data folder, held-out views, and the divisor of the image sizes.
RECORDINGS = {
    "kitchen": ("blender_kitchen/transforms.json", "cam00", 1.0),
    "lego": ("lego_synthetic", "8", 1.0),
    "fox": ("fox/transforms_2.json", "8", 2.0),
}
SCENES = (*SYNTHETIC, *RECORDINGS)


@dataclass(frozen=True)
class Workload:
    """The amount of work.

    seeds: number of seeds on the synthetic scenes.
    planned_s: fitting times on the synthetic scenes, each from scratch.
    recorded_s: fitting times on the recorded scenes.
    size: width and height of the images of synthetic scenes.
    """

    seeds: int
    planned_s: tuple[float, ...]
    recorded_s: tuple[float, ...]
    size: int = 128


FULL = Workload(5, (0.25, 0.3, 0.5, 0.8, 1.0, 1.5, 2.5, 3.0, 4.0, 8.0, 15.0), (2.0, 5.0, 15.0, 60.0))
QUICK = Workload(1, (0.5, 1.0, 2.5, 8.0), (2.0, 5.0))


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure {SCENE: {scene, angle_deg, baseline, FIELD: {seeds, series, seconds_to_db, best_db}}}; recorded scenes if
    FRESHFIELD_DATA names their folder. With options, FIELD contains them. Raises BenchError if a requested scene is not
    available."""
    workload = QUICK if run.quick else FULL
    stills = _stills(run.scenes, workload.size)
    lpips, missing = open_lpips(run.lpips)
    weights = weights_folder(run.lpips) if lpips is not None else None
    fits: list[Fit] = []
    for scene, still in stills.items():
        drawn = scene in SYNTHETIC
        seeds, planned_s = (workload.seeds, workload.planned_s) if drawn else (1, workload.recorded_s)
        fits += [Fit(still, n, s, seed, run.options) for n in run.names for s in planned_s for seed in range(seeds)]
    points = run.engine.run(
        partial(fit_from_scratch, weights=weights),
        fits,
        "fits",
        files=lambda fit: [*fit.still.files, weights],
        describe=lambda fit, row: (
            f"{label(fit.field, fit.options)} {fit.still.scene} {fit.seconds:6.2f} s  PSNR {row['psnr_db']:5.2f} dB"
        ),
    )
    figures: dict[str, Any] = {"lpips_missing": missing}
    for scene, still in stills.items():
        views = views_of(still)
        figures[scene] = {
            "scene": views.describe(),
            "angle_deg": smallest_angle_deg(views),
            "baseline": mean_baselines(views.training, views.held_out, views.background),
        }
        for name in run.names:
            mine = [(fit, point) for fit, point in zip(fits, points) if (fit.still, fit.field) == (still, name)]
            series = curves(*zip(*mine))
            figures[scene][label(name, run.options)] = {
                "seeds": series[0]["seeds"],
                "series": series,
                "seconds_to_db": seconds_to_db(series),
                "best_db": max(row["psnr_db"] for row in series),
            }
    return figures


def _stills(asked: Sequence[str], size: int) -> dict[str, Still]:
    """The scenes that were asked for, or all that are there; prints why one is left out. Raises BenchError for a
    missing one that was asked for."""
    found = {}
    for scene in asked or SCENES:
        try:
            found[scene] = Still(scene, size) if scene in SYNTHETIC else _recording(scene)
        except DatasetError as error:
            if asked:
                raise BenchError(f"{scene}: {error}") from None
            print(f"  {scene} left out: {error}", flush=True)
    return found


def _recording(scene: str) -> Still:
    """Raises DatasetError if the data folder does not have it."""
    name, holdout, scale = RECORDINGS[scene]
    data = os.environ.get("FRESHFIELD_DATA")
    if not data:
        raise DatasetError(f"set FRESHFIELD_DATA to the folder that holds {name.split('/')[0]}")
    if not (Path(data) / name).exists():
        raise DatasetError(f"there is no {Path(data) / name}")
    return Still(str(Path(data) / name), holdout=holdout, scale=scale)


def label(name: str, options: Mapping[str, Any]) -> str:
    """A representation and its options as text, without those at their defaults. Raises ValueError for unknown
    options or invalid values."""
    usual, chosen = settings_of(name), settings_of(name, options)
    different = {k: v for k, v in options.items() if getattr(usual, k, None) != getattr(chosen, k, v)}
    return ", ".join([name, *(f"{k}={v}" for k, v in different.items())])


def seconds_to_db(series: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Seconds of the first planned time whose median reaches each quality (None: none did)."""
    return {
        f"{target}_db": next((r["seconds"] for r in series if r["psnr_db"] >= target), None) for target in TARGETS_DB
    }


def _curves_of(part: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The curves of a scene by representation."""
    return {name: rows for name, rows in part.items() if isinstance(rows, dict) and "series" in rows}


def _scenes_of(figures: Mapping[str, Any]) -> dict[str, Any]:
    return {name: part for name, part in figures.items() if isinstance(part, dict)}


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw PSNR against seconds from scratch to ``path`` (PNG), a panel per scene, a line per
    representation."""
    from edge_server.report.style import CYCLE, GRAY, figure, label_lines

    scenes = _scenes_of(figures)
    if not scenes:
        return
    with figure(path, len(scenes), height_inch=2.4) as (_, axes):
        for ax, (scene, part) in zip(axes[:, 0], scenes.items()):
            for k, (name, rows) in enumerate(_curves_of(part).items()):
                x, y = ([row[key] for row in rows["series"]] for key in ("seconds", "psnr_db"))
                line = ".-" if k < len(CYCLE) else ".--"
                ax.plot(x, y, line, color=CYCLE[k % len(CYCLE)], label=name)
            known = [v for v in part["baseline"].values() if v is not None]
            ax.axhline(max(known), color=GRAY, linestyle=":", linewidth=1.2, label="needs no field")
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_formatter("{x:g}")
            last = scene == list(scenes)[-1]
            label_lines(ax, "PSNR (dB)", "seconds of fitting from scratch" if last else None, part["scene"])


def table(figures: dict[str, Any]) -> str:
    """Markdown tables: the scenes, and the curves."""
    bases, rows = [], []
    for scene, part in _scenes_of(figures).items():
        floor = (number(part["baseline"][key], 1) for key in ("mean_colour_db", "nearest_view_db"))
        bases.append((part["scene"], f"{part['angle_deg']:.1f}", *floor))
        for name, of in _curves_of(part).items():
            curve = ", ".join(f"{r['planned_s']:g}: {r['psnr_db']:.1f}" for r in of["series"])
            reached = ", ".join(grouped(of["seconds_to_db"][f"{db}_db"]) for db in TARGETS_DB)
            last = of["series"][-1]
            steps = grouped(last["steps"] / last["seconds"])
            rows.append((scene, name, of["seeds"], curve, reached, steps, grouped(last["outside_cores"])))
    targets = ", ".join(str(db) for db in TARGETS_DB)
    of_scenes = "scene|held-out camera from any other, degrees|mean color dB|nearest view dB"
    of_curves = f"scene|representation|seeds|seconds: PSNR dB|seconds to {targets} dB|steps/s|outside cores"
    return "\n\n".join(markdown_table(head.split("|"), of) for head, of in ((of_scenes, bases), (of_curves, rows)))
