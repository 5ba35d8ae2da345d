"""Measures each representation: seconds to a quality from scratch, rates, rendering, compilation, memory.

Every point is a new field, fitted from scratch for a planned time, because a fit schedules its learning rate
over its time. Scores are of held-out cameras. For every scene there are two baselines that need no field: the
mean color of the training images, and the training image nearest to each held-out camera.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from edge_server.experiments.bench.run import (
    SCENES,
    SYNTHETIC,
    BenchRun,
    available,
    label,
    open_recording,
    recorded_files,
)
from edge_server.experiments.common.tables import grouped, markdown_table, median_or_none, number
from edge_server.experiments.scenes.multiview_still import (
    MultiviewStill,
    mean_baselines,
    score_views,
    smallest_angle_deg,
    synthetic_still,
)
from edge_server.fidelity.lpips_weights import open_lpips, weights_folder
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, Field
from edge_server.fields.registry import make_field
from freshfield.geometry import Pinhole
from freshfield.machine_load import LoadMeter, peak_rss_mb

FULL_SIZE_STEPS = 500  # steps after which every representation has its full size
VIEWS = 18
TARGETS_DB = (22, 25, 28, 30)
_SCALES = {"fox": 2.0}  # divisors of the image sizes of recordings


@dataclass(frozen=True)
class Workload:
    """The amount of work.

    seeds: number of seeds on the synthetic scenes.
    planned_s: fitting times on the synthetic scenes, each from scratch.
    recorded_s: fitting times on the recorded scenes.
    rate_repeats: number of fits for the rates, each of ``rate_s`` seconds, after one three times as long.
    size: width and height of the images of synthetic scenes.
    """

    seeds: int
    planned_s: tuple[float, ...]
    recorded_s: tuple[float, ...]
    rate_repeats: int
    size: int = 128
    rate_s: float = 1.0


FULL = Workload(5, (0.25, 0.3, 0.5, 0.8, 1.0, 1.5, 2.5, 3.0, 4.0, 8.0, 15.0), (2.0, 5.0, 15.0, 60.0), 9)
QUICK = Workload(1, (0.5, 1.0, 2.5, 8.0), (2.0, 5.0), 3)


@dataclass(frozen=True)
class Fit:
    """A fit from scratch. options: of the field."""

    scene: str
    size: int
    field: str
    options: Mapping[str, Any]
    seconds: float
    seed: int


@dataclass(frozen=True)
class Rates:
    """A measurement of rates. repeats: number of fits of ``seconds``; others as in ``Fit``."""

    scene: str
    size: int
    field: str
    options: Mapping[str, Any]
    repeats: int
    seconds: float


@dataclass(frozen=True)
class Start:
    """A measurement of compile times and memory. cold: with an empty kernel cache, too."""

    field: str
    cold: bool


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure {start: {FIELD: jit, memory}, SCENE: {scene, angle_deg, baseline, FIELD: {series,
    seconds_to_db, ...}}}; recorded scenes if FRESHFIELD_DATA names their folder. With options, FIELD contains
    them, and the start is not measured. Raises BenchError if a requested scene is not available."""
    workload, engine = QUICK if run.quick else FULL, run.engine
    scenes = available(run.scenes or SCENES, asked=bool(run.scenes))
    weights = weights_folder(run.lpips)
    weights = weights if weights is not None and weights.is_dir() else None
    figures: dict[str, Any] = {"lpips_missing": open_lpips(run.lpips)[1]}
    if not run.options:
        starts = [Start(name, not run.quick) for name in run.names]
        figures["start"] = dict(zip(run.names, engine.run(start_up, starts, "start")))
    fits: list[Fit] = []
    rates: list[Rates] = []
    for scene in scenes:
        drawn = scene in SYNTHETIC
        planned_s, seeds = (workload.planned_s, workload.seeds) if drawn else (workload.recorded_s, 1)
        for name in run.names:
            of = scene, workload.size, name, run.options
            fits += [Fit(*of, seconds, seed) for seconds in planned_s for seed in range(seeds)]
            rates += [Rates(*of, workload.rate_repeats, workload.rate_s)] if drawn else []
    points = engine.run(
        partial(fit_from_scratch, weights=weights),
        fits,
        "fits",
        files=lambda fit: [*recorded_files(fit.scene), weights],
        describe=lambda fit, row: (
            f"{label(fit.field, fit.options)} {fit.scene} {fit.seconds:6.2f} s  PSNR {row['psnr_db']:5.2f} dB"
        ),
    )
    measured = engine.run(measure_rates, rates, "rates")
    for scene in scenes:
        still = _still(scene, workload.size)
        base = mean_baselines(still.training, still.held_out, still.background)
        of_scene = figures[scene] = {"scene": still.describe(), "angle_deg": smallest_angle_deg(still)}
        of_scene["baseline"] = base
        for name in run.names:
            curve = _curve([(f, p) for f, p in zip(fits, points) if (f.scene, f.field) == (scene, name)])
            found = [row for r, row in zip(rates, measured) if (r.scene, r.field) == (scene, name)]
            of_scene[label(name, run.options)] = {**curve, **(found[0] if found else {})}
    return figures


@cache
def _still(scene: str, size: int) -> MultiviewStill:
    if scene in SYNTHETIC:
        return synthetic_still(scene, cameras=VIEWS + 1, size=size)
    return open_recording(scene, _SCALES.get(scene, 1.0))


def start_up(start: Start) -> dict[str, Any]:
    """Compile times and memory, each measured in its own process."""
    load = LoadMeter()
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="freshfield-bench-") as folder:
        if start.cold:
            cold = _child(start.field, Path(folder), "compile")
            figures["jit_cold_s"], figures["jit_cold_cpu_s"] = cold["jit_s"], cold["jit_cpu_s"]
            cached = _child(start.field, Path(folder))
        else:
            _child(start.field, None, "compile")  # fills the cache if necessary
            cached = _child(start.field, None)
    figures["jit_cached_s"], figures["jit_cached_cpu_s"] = cached["jit_s"], cached["jit_cpu_s"]
    figures["peak_rss_mb"] = cached["peak_rss_mb"]
    figures["machine_cores_busy"] = load.row(0.0).get("machine", {}).get("cpu")
    return figures


def _child(field: str, cache: Path | None, *words: str) -> dict[str, float]:
    environment = dict(os.environ) if cache is None else {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-m", "edge_server.experiments.bench.field", field, *words]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def fit_from_scratch(fit: Fit, weights: Path | None = None) -> dict[str, Any]:
    """One point of a curve. weights: folder of LPIPS weights."""
    still = _still(fit.scene, fit.size)
    make_field(fit.field, fit.options).warm_up()
    model, load = make_field(fit.field, fit.options, seed=fit.seed), LoadMeter()
    report = model.fit(still.training, Budget(seconds=fit.seconds))
    outside = load.outside_cores()
    score, _ = score_views(model, still.held_out, Scorer(_lpips(weights), background=still.background))
    return {
        "fitted_s": report.seconds,
        "steps": report.steps,
        "psnr_db": score.psnr_db,
        "ssim": score.ssim,
        "lpips": score.lpips,
        "outside_cores": outside,
    }


@cache
def _lpips(weights: Path | None) -> Any:
    return open_lpips(weights)[0]


def _curve(points: Sequence[tuple[Fit, Mapping[str, Any]]]) -> dict[str, Any]:
    """Fidelity against seconds from scratch: medians over seeds, and the first planned time whose median
    reaches each quality (None: none did)."""
    series = []
    for seconds in dict.fromkeys(fit.seconds for fit, _ in points):
        of = [point for fit, point in points if fit.seconds == seconds]
        names = ("fitted_s", "steps", "psnr_db", "ssim", "lpips")
        row: dict[str, Any] = {"seconds": seconds, **{name: median_or_none(p[name] for p in of) for name in names}}
        row["psnr_db_range"] = max(p["psnr_db"] for p in of) - min(p["psnr_db"] for p in of)
        series.append(row)
    return {
        "seeds": len({fit.seed for fit, _ in points}),
        "series": {f"{row['seconds']:g}_s": row for row in series},
        "seconds_to_db": _seconds_to_db(series),
        "best_db": max(row["psnr_db"] for row in series),
        "outside_cores": median_or_none(point["outside_cores"] for _, point in points),
    }


def _seconds_to_db(series: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Seconds of fitting until each quality; they may be slightly more than planned."""
    return {
        f"{target}_db": next((r["fitted_s"] for r in series if r["psnr_db"] >= target), None) for target in TARGETS_DB
    }


def measure_rates(rates: Rates) -> dict[str, Any]:
    """Rates of a converged field, and milliseconds of a rendering."""
    still, model = _still(rates.scene, rates.size), make_field(rates.field, rates.options)
    model.fit(still.training, Budget(seconds=3.0 * rates.seconds))
    load = LoadMeter()
    reports = [model.fit(still.training, Budget(seconds=rates.seconds)) for _ in range(rates.repeats)]
    outside = load.outside_cores()
    pose, lens = still.held_out[0].camera_to_world, still.held_out[0].intrinsics
    return {
        "steps_per_s": statistics.median(r.steps / r.seconds for r in reports),
        "rays_per_s": statistics.median(r.rays / r.seconds for r in reports),
        "samples_per_s": statistics.median(r.samples / r.seconds for r in reports),
        "rates_outside_cores": outside,
        **{f"render_{w}_ms": _render_ms(model, pose, lens.scaled(w / lens.width)) for w in (128, 256)},
    }


def _render_ms(field: Field, pose: Any, lens: Pinhole) -> float:
    return 1e3 * median_s(11, lambda: field.render(pose, lens))


def median_s(repeats: int, work: Callable[[], Any]) -> float:
    """Median seconds of ``repeats`` calls of ``work``, after one call that is not counted."""
    work()  # compiles, and warms the caches
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return statistics.median(spent)


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw PSNR against seconds from scratch to ``path`` (PNG), a panel per scene, a line per
    representation."""
    from edge_server.report.style import CYCLE, GRAY, figure, label_lines

    scenes = [name for name, part in figures.items() if isinstance(part, dict) and "scene" in part]
    if not scenes:
        return
    with figure(path, len(scenes), height_inch=2.4) as (_, axes):
        for ax, scene in zip(axes[:, 0], scenes):
            part = figures[scene]
            names = [n for n, rows in part.items() if isinstance(rows, dict) and "series" in rows]
            for k, name in enumerate(names):
                rows = list(part[name]["series"].values())
                x, y = ([r[key] for r in rows] for key in ("fitted_s", "psnr_db"))
                line = ".-" if k < len(CYCLE) else ".--"
                ax.plot(x, y, line, color=CYCLE[k % len(CYCLE)], label=name)
            known = [v for v in part["baseline"].values() if v is not None]
            ax.axhline(max(known), color=GRAY, linestyle=":", linewidth=1.2, label="needs no field")
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter("{x:g}")
            ax.xaxis.set_minor_formatter("{x:g}")
            last = scene == scenes[-1]
            label_lines(ax, "PSNR (dB)", "seconds of fitting from scratch" if last else None, part["scene"])


def table(figures: dict[str, Any]) -> str:
    """Markdown tables: the scenes, the curves, rates on synthetic scenes, and start-up costs."""
    scenes = {name: part for name, part in figures.items() if isinstance(part, dict) and "scene" in part}
    found = [
        (scene, name, rows)
        for scene, part in scenes.items()
        for name, rows in part.items()
        if isinstance(rows, dict) and "series" in rows
    ]
    bases = [
        (
            part["scene"],
            f"{part['angle_deg']:.1f}",
            *(number(part["baseline"][key], 1) for key in ("mean_colour_db", "nearest_view_db")),
        )
        for part in scenes.values()
    ]
    curves = [
        (
            scene,
            name,
            rows["seeds"],
            ", ".join(f"{r['seconds']:g}: {r['psnr_db']:.1f}" for r in rows["series"].values()),
            ", ".join(grouped(rows["seconds_to_db"][f"{db}_db"]) for db in TARGETS_DB),
            grouped(rows["outside_cores"]),
        )
        for scene, name, rows in found
    ]
    of_rates = ("steps_per_s", "rays_per_s", "samples_per_s", "render_128_ms", "render_256_ms", "rates_outside_cores")
    rates = [
        (scene, name, *(grouped(rows[key]) for key in of_rates)) for scene, name, rows in found if "steps_per_s" in rows
    ]
    of_start = ("jit_cold_s", "jit_cold_cpu_s", "jit_cached_s", "jit_cached_cpu_s", "peak_rss_mb", "machine_cores_busy")
    starts = [(name, *(grouped(row.get(key)) for key in of_start)) for name, row in figures.get("start", {}).items()]
    targets = ", ".join(str(db) for db in TARGETS_DB)
    tables: dict[str, list[tuple[Any, ...]]] = {
        "scene|held-out camera from any other, degrees|mean color dB|nearest view dB": bases,
        f"scene|representation|seeds|seconds: PSNR dB|seconds to {targets} dB|outside cores": curves,
        "scene|representation|steps/s|rays/s|samples/s|128 x 128 in ms|256 x 256 in ms|outside cores": rates,
        "representation|JIT cold s|of CPU s|JIT cached s|of CPU s|peak MB|cores busy": starts,
    }
    texts = [markdown_table(head.split("|"), rows) for head, rows in tables.items() if rows]
    if any(name.startswith("splat") for _, name, *_ in rates):
        texts.append("Rays of `splat` are pixels, its samples pairs of a Gaussian and a tile of 8 x 8 pixels.")
    return "\n\n".join(texts)


def _main(field: str, only: str = "") -> None:
    """Print the time until kernels are ready, and the memory used by fitting; runs in its own process.

    only: "compile" leaves the fitting out.
    """
    model = make_field(field)
    began, cpu = time.perf_counter(), time.process_time()
    model.warm_up()
    jit_s, jit_cpu_s = time.perf_counter() - began, time.process_time() - cpu
    if only != "compile":
        still = synthetic_still("room", cameras=VIEWS + 1)
        model.fit(still.training, Budget(steps=FULL_SIZE_STEPS))
        model.render(still.held_out[0].camera_to_world, still.held_out[0].intrinsics)
    print(json.dumps({"jit_s": jit_s, "jit_cpu_s": jit_cpu_s, "peak_rss_mb": peak_rss_mb()}))


if __name__ == "__main__":
    _main(*sys.argv[1:])
