"""How fast each representation is: seconds to a quality from scratch, rates, renderings, compilation, memory.

Every point is a field of its own, fitted from scratch for a planned time, since a fit plans its learning
rate by its time; the score is of cameras that were held out. Beside every scene stands what no field is
needed for: the mean colour of the training images, and the training image nearest to each held-out camera.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.common.machine_load import Usage, peak_rss_mb
from edge_server.experiments.common.machine_speed import Speed, told
from edge_server.experiments.common.result_store import Kept, settled
from edge_server.experiments.fitting.evaluate import evaluate
from edge_server.experiments.scenes.multiview_still import Still, open_still, smallest_angle_deg, synthetic
from edge_server.fidelity.baselines import baseline
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, Field
from edge_server.fields.registry import field_names, make_field
from freshfield.geometry import Pinhole

GROWN = 500  # steps after which every representation has its full size
VIEWS, SIZE = 18, 128
TARGETS_DB = (22, 25, 28, 30)


@dataclass(frozen=True)
class Effort:
    """planned_s: fitting times, each from scratch, on the synthetic scenes and on the recorded ones."""

    seeds: int
    planned_s: tuple[float, ...]
    recorded_s: tuple[float, ...]
    rate_repeats: int


FULL = Effort(5, (0.25, 0.3, 0.5, 0.8, 1.0, 1.5, 2.5, 3.0, 4.0, 8.0, 15.0), (2.0, 5.0, 15.0, 60.0), 9)
QUICK = Effort(1, (0.5, 1.0, 2.5, 8.0), (2.0, 5.0), 3)

# Under the data folder: file or folder, what is held out, by what its images are divided.
_RECORDED = {
    "kitchen": ("blender_kitchen/transforms.json", "cam00", 1.0),
    "lego": ("lego_synthetic", "8", 1.0),
    "fox": ("fox/transforms_2.json", "8", 2.0),
}


def measure(
    quick: bool,
    folder: Path,
    lpips: Path | None = None,
    fields: Sequence[str] = (),
    kept: Kept | None = None,
) -> dict[str, Any]:
    """All figures of ``fields`` (default: all there are); ``folder`` takes a fresh kernel cache.

    {start: {field: jit, memory}, SCENE: {scene, angle_deg, baseline, FIELD: {series, seconds_to_db, rates}}};
    recorded scenes where FRESHFIELD_DATA names their folder.
    """
    effort, names, kept = QUICK if quick else FULL, tuple(fields) or field_names(), kept or Kept()
    scorer_lpips, missing = open_lpips(lpips)
    kept.put("lpips_missing", missing)
    for name in names:
        start = partial(_start_up, name, quick, folder / name)
        kept.get("start", name, measure=start, settings={"cold": not quick, "defaults": settled(name)})
    for scene in ("tile", "room"):
        still = synthetic(scene, cameras=VIEWS + 1, size=SIZE)
        _describe(kept, scene, still)
        for name in names:
            ours = partial(_of_ours, name, still, effort, scorer_lpips)
            kept.get(scene, name, measure=ours, settings=_as_json(effort, name, scorer_lpips))
    for scene, still in _recorded_scenes():
        _describe(kept, scene, still)
        for name in names:
            curve = partial(_curve, name, still, effort.recorded_s, 1, scorer_lpips)
            kept.get(scene, name, measure=curve, settings=_as_json(effort, name, scorer_lpips))
    return kept.figures


def _as_json(effort: Effort, name: str, lpips: Any) -> dict[str, Any]:
    """The settings that a row is kept with."""
    values = {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(effort).items()}
    return {**values, "lpips": lpips is not None, "defaults": settled(name)}


def _describe(kept: Kept, scene: str, still: Still) -> None:
    kept.get(scene, "baseline", measure=partial(_baseline, still))
    kept.figures[scene] |= {"scene": still.describe(), "angle_deg": smallest_angle_deg(still)}


def _of_ours(name: str, still: Still, effort: Effort, lpips: Any) -> dict[str, Any]:
    return {
        **_curve(name, still, effort.planned_s, effort.seeds, lpips),
        **_rates(name, still, effort.rate_repeats),
    }


def _recorded_scenes() -> Iterable[tuple[str, Still]]:
    data = os.environ.get("FRESHFIELD_DATA")
    if not data:
        print("  FRESHFIELD_DATA is not set: recorded scenes are left out", flush=True)
        return
    for scene, (path, holdout, scale) in _RECORDED.items():
        try:
            yield scene, open_still(str(Path(data) / path), holdout=holdout, scale=scale)
        except DatasetError as error:
            print(f"  {scene} left out: {error}", flush=True)


def _start_up(field: str, quick: bool, folder: Path) -> dict[str, Any]:
    """Compile times and memory, each in a process of its own, cold with an empty kernel cache."""
    speed = Speed()
    speed.look()
    usage = Usage("bench")
    figures: dict[str, Any] = {}
    if not quick:
        cold = _child(field, folder)
        figures["jit_cold_s"], figures["jit_cold_cpu_s"] = cold["jit_s"], cold["jit_cpu_s"]
        cached = _child(field, folder)
    else:
        _child(field, None)  # fills the cache if nobody has
        cached = _child(field, None)
    figures["jit_cached_s"], figures["jit_cached_cpu_s"] = cached["jit_s"], cached["jit_cpu_s"]
    figures["peak_rss_mb"] = cached["peak_rss_mb"]
    figures["machine_cores_busy"] = usage.row(0.0).get("machine", {}).get("cpu")
    speed.look()
    figures["machine"] = speed.row()
    speed.close()
    return figures


def _child(field: str, cache: Path | None) -> dict[str, float]:
    environment = dict(os.environ) if cache is None else {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-m", "edge_server.experiments.bench.field", field]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _curve(field: str, still: Still, planned_s: Sequence[float], seeds: int, lpips: Any) -> dict[str, Any]:
    """Fidelity against seconds from scratch: medians over seeds, and the first planned time whose median
    reaches each quality (None: none did)."""
    make_field(field).warm_up()
    usage, speed, series = Usage("bench"), Speed(), []
    for seconds in planned_s:
        speed.look()
        points = [_point(field, still, seconds, seed, lpips) for seed in range(seeds)]
        row: dict[str, Any] = {"seconds": seconds}
        for name in ("fitted_s", "steps", "psnr_db", "ssim", "lpips"):
            known = [p[name] for p in points if p[name] is not None]
            row[name] = statistics.median(known) if known else None
        row["psnr_db_range"] = max(p["psnr_db"] for p in points) - min(p["psnr_db"] for p in points)
        series.append(row)
        print(f"  {field:10} {still.name:8} {seconds:6.2f} s  PSNR {row['psnr_db']:5.2f} dB", flush=True)
    speed.close()
    return {
        "seeds": seeds,
        "series": {f"{row['seconds']:g}_s": row for row in series},
        "seconds_to_db": _seconds_to_db(series),
        "best_db": max(row["psnr_db"] for row in series),
        "outside_cores": usage.outside(usage.row(0.0)),
        "machine": speed.row(),
    }


def _seconds_to_db(series: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """The seconds fitted, which may be a little more than planned, of the first point of each quality."""
    return {
        f"{target}_db": next((r["fitted_s"] for r in series if r["psnr_db"] >= target), None)
        for target in TARGETS_DB
    }


def _point(field: str, still: Still, seconds: float, seed: int, lpips: Any) -> dict[str, Any]:
    model = make_field(field, seed=seed)
    report = model.fit(still.training, Budget(seconds=seconds))
    score, _ = evaluate(model, still.held_out, Scorer(lpips, background=still.background))
    return {
        "fitted_s": report.seconds, "steps": report.steps, "psnr_db": score.psnr_db, "ssim": score.ssim,
        "lpips": score.lpips,
    }  # fmt: skip


def _rates(field: str, still: Still, repeats: int) -> dict[str, Any]:
    """Rates of a field that has settled, and milliseconds of a rendering."""
    model = make_field(field)
    model.fit(still.training, Budget(seconds=3.0))
    usage, speed, reports = Usage("bench"), Speed(), []
    for _ in range(repeats):
        speed.look()
        reports.append(model.fit(still.training, Budget(seconds=1.0)))
    outside = usage.outside(usage.row(0.0))
    speed.close()
    pose, lens = still.held_out[0].camera_to_world, still.held_out[0].intrinsics
    return {
        "steps_per_s": statistics.median(r.steps / r.seconds for r in reports),
        "rays_per_s": statistics.median(r.rays / r.seconds for r in reports),
        "samples_per_s": statistics.median(r.samples / r.seconds for r in reports),
        "rates_outside_cores": outside,
        "rates_machine": speed.row(),
        **{f"render_{w}_ms": _render_ms(model, pose, lens.scaled(w / lens.width)) for w in (128, 256)},
    }


def _render_ms(field: Field, pose: Any, lens: Pinhole, repeats: int = 11) -> float:
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        field.render(pose, lens)
        spent.append((time.perf_counter() - began) * 1e3)
    return statistics.median(spent)


def _baseline(still: Still) -> dict[str, float | None]:
    """Means over the held-out cameras."""
    found = [baseline(still.training, v.image, v.camera_to_world, still.background) for v in still.held_out]
    return {
        name: statistics.fmean(getattr(b, name) for b in found)
        for name in ("mean_colour_db", "nearest_view_db")
    }


def draw(figures: dict[str, Any], path: Path) -> None:
    """PSNR against seconds from scratch, a panel a scene, a line a representation, to ``path`` (PNG)."""
    from edge_server.report.style import CYCLE, GREY, figure, label_lines

    scenes = [name for name, part in figures.items() if isinstance(part, dict) and "scene" in part]
    if not scenes:
        return
    with figure(path, len(scenes), height_inch=2.4) as (_, axes):
        for ax, scene in zip(axes[:, 0], scenes):
            part = figures[scene]
            names = [n for n, rows in part.items() if isinstance(rows, dict) and "series" in rows]
            for colour, name in zip(CYCLE, names):
                rows = list(part[name]["series"].values())
                x, y = ([r[key] for r in rows] for key in ("fitted_s", "psnr_db"))
                ax.plot(x, y, ".-", color=colour, label=name)
            known = [v for v in part["baseline"].values() if v is not None]
            ax.axhline(max(known), color=GREY, linestyle=":", linewidth=1.2, label="needs no field")
            ax.set_xscale("log")
            last = scene == scenes[-1]
            label_lines(ax, "PSNR (dB)", "seconds of fitting from scratch" if last else None, part["scene"])


def table(figures: dict[str, Any]) -> str:
    """Markdown tables: the scenes, the curves, rates on our own scenes, and what a start costs."""
    scenes = {name: part for name, part in figures.items() if isinstance(part, dict) and "scene" in part}
    found = [
        (scene, name, rows)
        for scene, part in scenes.items()
        for name, rows in part.items()
        if isinstance(rows, dict) and "series" in rows
    ]
    least = [
        (
            part["scene"], f"{part['angle_deg']:.1f}",
            *(_n(part["baseline"][key], 1) for key in ("mean_colour_db", "nearest_view_db")),
        )
        for part in scenes.values()
    ]  # fmt: skip
    curves = [
        (
            scene, name, str(rows["seeds"]),
            ", ".join(f"{r['seconds']:g}: {r['psnr_db']:.1f}" for r in rows["series"].values()),
            ", ".join(_n(rows["seconds_to_db"][f"{db}_db"]) for db in TARGETS_DB), _n(rows["outside_cores"]),
            told(rows.get("machine")),
        )
        for scene, name, rows in found
    ]  # fmt: skip
    of_rates = ("steps_per_s", "rays_per_s", "samples_per_s", "render_128_ms", "render_256_ms")
    rates = [
        (
            scene,
            name,
            *(_n(rows[key]) for key in of_rates),
            _n(rows["rates_outside_cores"]),
            told(rows.get("rates_machine")),
        )
        for scene, name, rows in found
        if "steps_per_s" in rows
    ]
    compiled = ("jit_cold_s", "jit_cold_cpu_s", "jit_cached_s", "jit_cached_cpu_s")
    keys = (*compiled, "peak_rss_mb", "machine_cores_busy")
    starts = [
        (name, *(_n(row.get(key)) for key in keys), told(row.get("machine")))
        for name, row in figures.get("start", {}).items()
    ]
    targets = ", ".join(str(db) for db in TARGETS_DB)
    busy = "outside cores|the machine"
    tables = {
        "scene|held-out camera from any other, degrees|mean colour dB|nearest view dB": least,
        f"scene|representation|seeds|seconds: PSNR dB|seconds to {targets} dB|{busy}": curves,
        f"scene|representation|steps/s|rays/s|samples/s|128 x 128 in ms|256 x 256 in ms|{busy}": rates,
        "representation|JIT cold s|of CPU s|JIT cached s|of CPU s|peak MB|cores busy|the machine": starts,
    }
    texts = [_markdown(head.split("|"), rows) for head, rows in tables.items() if rows]
    if any(name == "splat" for _, name, *_ in rates):
        texts.append(
            "Rays of `splat` are pixels, its samples pairs of a Gaussian and a tile of 8 x 8 pixels."
        )
    if found:
        texts.append(
            "The machine: how fast it was just before each time or rate was measured, all cores together: "
            "billions of multiply-adds in registers and millions of random reads from 4 MB a second "
            "(medians). On one that is shared both may halve, for an hour or for a second, which no load of "
            "its own tells."
        )
    return "\n\n".join(texts)


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _n(value: float | None, digits: int = 2) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.{digits}f}"


def _main(field: str) -> None:
    """In a process of its own: the time until kernels are ready, and what fitting takes of memory."""
    model = make_field(field)
    began, cpu = time.perf_counter(), time.process_time()
    model.warm_up()
    jit_s, jit_cpu_s = time.perf_counter() - began, time.process_time() - cpu
    still = synthetic("room", cameras=VIEWS + 1, size=SIZE)
    model.fit(still.training, Budget(steps=GROWN))
    model.render(still.held_out[0].camera_to_world, still.held_out[0].intrinsics)
    print(json.dumps({"jit_s": jit_s, "jit_cpu_s": jit_cpu_s, "peak_rss_mb": peak_rss_mb()}))


if __name__ == "__main__":
    _main(sys.argv[1])
