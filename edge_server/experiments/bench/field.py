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
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.bench.run import (
    SCENES,
    SYNTHETIC,
    BenchError,
    BenchRun,
    label,
    open_recording,
    result_settings,
)
from edge_server.experiments.common.machine_speed import MachineSpeed, median_s, speed_text
from edge_server.experiments.common.result_store import settings_digest
from edge_server.experiments.common.tables import grouped, markdown_table, median_or_none, number
from edge_server.experiments.scenes.multiview_still import (
    MultiviewStill,
    mean_baselines,
    score_views,
    smallest_angle_deg,
    synthetic_still,
)
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, Field
from edge_server.fields.registry import field_names, make_field
from freshfield.geometry import Pinhole
from freshfield.machine_load import LoadMeter, peak_rss_mb

FULL_SIZE_STEPS = 500  # steps after which every representation has its full size
VIEWS, SIZE = 18, 128
TARGETS_DB = (22, 25, 28, 30)


_SCALES = {"fox": 2.0}  # divisors of the image sizes of recordings


@dataclass(frozen=True)
class Workload:
    """The amount of work.

    seeds: number of seeds on the synthetic scenes.
    planned_s: fitting times on the synthetic scenes, each from scratch.
    recorded_s: fitting times on the recorded scenes.
    rate_repeats: number of fits for the rates.
    """

    seeds: int
    planned_s: tuple[float, ...]
    recorded_s: tuple[float, ...]
    rate_repeats: int


FULL = Workload(5, (0.25, 0.3, 0.5, 0.8, 1.0, 1.5, 2.5, 3.0, 4.0, 8.0, 15.0), (2.0, 5.0, 15.0, 60.0), 9)
QUICK = Workload(1, (0.5, 1.0, 2.5, 8.0), (2.0, 5.0), 3)


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure {start: {FIELD: jit, memory}, SCENE: {scene, angle_deg, baseline, FIELD: {series,
    seconds_to_db, ...}}}; recorded scenes if FRESHFIELD_DATA names their folder. With options, FIELD contains
    them, and the start is not measured. Raises BenchError if a requested scene is not available."""
    workload, names, store = QUICK if run.quick else FULL, run.fields or field_names(), run.store
    lpips, missing = open_lpips(run.lpips)
    stills = list(_stills(run.scenes))
    store.results["lpips_missing"] = missing
    for name in () if run.options else names:
        start = partial(_start_up, name, run.quick, run.folder / name)
        settings = {"cold": not run.quick, "defaults": settings_digest(name)}
        store.get("start", name, compute=start, settings=settings)
    for scene, still in stills:
        base = partial(mean_baselines, still.training, still.held_out, still.background)
        store.get(scene, "baseline", compute=base)
        store.results[scene] |= {"scene": still.describe(), "angle_deg": smallest_angle_deg(still)}
        for name in names:
            make = partial(make_field, name, run.options)
            text = label(name, run.options)
            title = name if text == "default" else f"{name}, {text}"
            if scene in SYNTHETIC:
                work = partial(_curve_and_rates, title, make, still, workload, lpips)
            else:
                work = partial(_curve, title, make, still, workload.recorded_s, 1, lpips)
            settings = result_settings(workload, name, run.options, lpips=lpips is not None)
            store.get(scene, title, compute=work, settings=settings)
    return store.results


def _curve_and_rates(
    title: str, make: Callable[..., Field], still: MultiviewStill, workload: Workload, lpips: Any
) -> dict[str, Any]:
    curve = _curve(title, make, still, workload.planned_s, workload.seeds, lpips)
    return {**curve, **_rates(make, still, workload.rate_repeats)}


def _stills(asked: Sequence[str]) -> Iterable[tuple[str, MultiviewStill]]:
    """The requested scenes, or all available ones. Raises BenchError."""
    for scene in asked or SCENES:
        if scene in SYNTHETIC:
            yield scene, synthetic_still(scene, cameras=VIEWS + 1, size=SIZE)
            continue
        try:
            yield scene, open_recording(scene, _SCALES.get(scene, 1.0))
        except DatasetError as error:
            if asked:
                raise BenchError(f"{scene}: {error}") from None
            print(f"  {scene} left out: {error}", flush=True)


def _start_up(field: str, quick: bool, folder: Path) -> dict[str, Any]:
    """Compile times and memory, each measured in its own process; cold: with an empty kernel cache."""
    speed = MachineSpeed()
    speed.sample()
    load = LoadMeter()
    figures: dict[str, Any] = {}
    if not quick:
        cold = _child(field, folder, "compile")
        figures["jit_cold_s"], figures["jit_cold_cpu_s"] = cold["jit_s"], cold["jit_cpu_s"]
        cached = _child(field, folder)
    else:
        _child(field, None, "compile")  # fills the cache if necessary
        cached = _child(field, None)
    figures["jit_cached_s"], figures["jit_cached_cpu_s"] = cached["jit_s"], cached["jit_cpu_s"]
    figures["peak_rss_mb"] = cached["peak_rss_mb"]
    figures["machine_cores_busy"] = load.row(0.0).get("machine", {}).get("cpu")
    speed.sample()
    figures["machine"] = speed.medians()
    speed.close()
    return figures


def _child(field: str, cache: Path | None, *words: str) -> dict[str, float]:
    environment = dict(os.environ) if cache is None else {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-m", "edge_server.experiments.bench.field", field, *words]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _curve(
    title: str, make: Callable[..., Field], still: MultiviewStill, planned_s: Sequence[float], seeds: int, lpips: Any
) -> dict[str, Any]:
    """Fidelity against seconds from scratch: medians over seeds, and the first planned time whose median
    reaches each quality (None: none did)."""
    make().warm_up()
    load, speed, series = LoadMeter(), MachineSpeed(), []
    for seconds in planned_s:
        speed.sample()
        points = [_point(make(seed=seed), still, seconds, lpips) for seed in range(seeds)]
        row: dict[str, Any] = {"seconds": seconds}
        for name in ("fitted_s", "steps", "psnr_db", "ssim", "lpips"):
            row[name] = median_or_none(p[name] for p in points)
        row["psnr_db_range"] = max(p["psnr_db"] for p in points) - min(p["psnr_db"] for p in points)
        series.append(row)
        print(f"  {title:10} {still.name:8} {seconds:6.2f} s  PSNR {row['psnr_db']:5.2f} dB", flush=True)
    speed.close()
    return {
        "seeds": seeds,
        "series": {f"{row['seconds']:g}_s": row for row in series},
        "seconds_to_db": _seconds_to_db(series),
        "best_db": max(row["psnr_db"] for row in series),
        "outside_cores": load.outside_cores(),
        "machine": speed.medians(),
    }


def _seconds_to_db(series: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Seconds of fitting until each quality; they may be slightly more than planned."""
    return {
        f"{target}_db": next((r["fitted_s"] for r in series if r["psnr_db"] >= target), None) for target in TARGETS_DB
    }


def _point(model: Field, still: MultiviewStill, seconds: float, lpips: Any) -> dict[str, Any]:
    report = model.fit(still.training, Budget(seconds=seconds))
    score, _ = score_views(model, still.held_out, Scorer(lpips, background=still.background))
    return {
        "fitted_s": report.seconds,
        "steps": report.steps,
        "psnr_db": score.psnr_db,
        "ssim": score.ssim,
        "lpips": score.lpips,
    }


def _rates(make: Callable[..., Field], still: MultiviewStill, repeats: int) -> dict[str, Any]:
    """Rates of a converged field, and milliseconds of a rendering."""
    model = make()
    model.fit(still.training, Budget(seconds=3.0))
    load, speed, reports = LoadMeter(), MachineSpeed(), []
    for _ in range(repeats):
        speed.sample()
        reports.append(model.fit(still.training, Budget(seconds=1.0)))
    outside = load.outside_cores()
    speed.close()
    pose, lens = still.held_out[0].camera_to_world, still.held_out[0].intrinsics
    return {
        "steps_per_s": statistics.median(r.steps / r.seconds for r in reports),
        "rays_per_s": statistics.median(r.rays / r.seconds for r in reports),
        "samples_per_s": statistics.median(r.samples / r.seconds for r in reports),
        "rates_outside_cores": outside,
        "rates_machine": speed.medians(),
        **{f"render_{w}_ms": _render_ms(model, pose, lens.scaled(w / lens.width)) for w in (128, 256)},
    }


def _render_ms(field: Field, pose: Any, lens: Pinhole) -> float:
    return 1e3 * median_s(11, lambda: field.render(pose, lens))


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
            speed_text(rows.get("machine")),
        )
        for scene, name, rows in found
    ]
    of_rates = ("steps_per_s", "rays_per_s", "samples_per_s", "render_128_ms", "render_256_ms", "rates_outside_cores")
    rates = [
        (scene, name, *(grouped(rows[key]) for key in of_rates), speed_text(rows.get("rates_machine")))
        for scene, name, rows in found
        if "steps_per_s" in rows
    ]
    of_start = ("jit_cold_s", "jit_cold_cpu_s", "jit_cached_s", "jit_cached_cpu_s", "peak_rss_mb", "machine_cores_busy")
    starts = [
        (name, *(grouped(row.get(key)) for key in of_start), speed_text(row.get("machine")))
        for name, row in figures.get("start", {}).items()
    ]
    targets = ", ".join(str(db) for db in TARGETS_DB)
    load = "outside cores|the machine"
    tables: dict[str, list[tuple[Any, ...]]] = {
        "scene|held-out camera from any other, degrees|mean color dB|nearest view dB": bases,
        f"scene|representation|seeds|seconds: PSNR dB|seconds to {targets} dB|{load}": curves,
        f"scene|representation|steps/s|rays/s|samples/s|128 x 128 in ms|256 x 256 in ms|{load}": rates,
        "representation|JIT cold s|of CPU s|JIT cached s|of CPU s|peak MB|cores busy|the machine": starts,
    }
    texts = [markdown_table(head.split("|"), rows) for head, rows in tables.items() if rows]
    if any(name.startswith("splat") for _, name, *_ in rates):
        texts.append("Rays of `splat` are pixels, its samples pairs of a Gaussian and a tile of 8 x 8 pixels.")
    if found:
        texts.append(
            "The machine: how fast it was just before each time or rate was measured, all cores together: "
            "billions of multiply-adds in registers and millions of random reads from 4 MB a second "
            "(medians). On a shared machine both may halve, for an hour or for a second, which no load of "
            "its own shows."
        )
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
        still = synthetic_still("room", cameras=VIEWS + 1, size=SIZE)
        model.fit(still.training, Budget(steps=FULL_SIZE_STEPS))
        model.render(still.held_out[0].camera_to_world, still.held_out[0].intrinsics)
    print(json.dumps({"jit_s": jit_s, "jit_cpu_s": jit_cpu_s, "peak_rss_mb": peak_rss_mb()}))


if __name__ == "__main__":
    _main(*sys.argv[1:])
