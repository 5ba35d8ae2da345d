"""Figures 4.7 and 4.8, tables 4.1 and 4.3: quality and path against the number of views, by selector."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from edge_server.experiments.common.progress import Progress
from edge_server.experiments.common.result_store import ResultStore, content_key
from edge_server.experiments.common.source_digest import source_digest
from edge_server.experiments.common.statistics import Interval, interval, negated, paired
from edge_server.experiments.common.tables import markdown_table, number
from edge_server.experiments.studies.drawing import Image, draw_curve, draw_images
from edge_server.experiments.studies.study import METRICS, Curve, Study, StudyRequest, Table, Verdict
from edge_server.experiments.studies.trial import Row, scenario_of
from edge_server.experiments.viewpoints.drawing import draw_plan
from edge_server.experiments.viewpoints.stage import Stage, open_stage
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import Scorer
from edge_server.live.scoring_thread import to_bytes
from edge_server.report.style import figure, label_lines
from edge_server.viewpoints.capture_planner import Budget, Plan, plan_capture
from edge_server.viewpoints.registry import make_selector
from freshfield.files import write_csv, write_text

# label -> (selector, weight of the way)
ARMS = {
    "random": ("random", 0.0),
    "uniform": ("uniform", 0.0),
    "farthest": ("farthest", 0.0),
    "coverage": ("coverage", 0.0),
    "FisherRF": ("fisher", 0.0),
    "uniform, short way": ("uniform", 0.3),
    "coverage, short way": ("coverage", 0.3),
}
JUDGED = 8  # views of table 4.3 and of the figures
SCENES = {True: ("tile",), False: ("tile", "lego", "kitchen", "cell")}  # by whether it is a quick pass
_SHOWN = ("random", "uniform", "coverage", "FisherRF")
_METRICS = ("psnr_db", "ssim", "lpips")


@dataclass(frozen=True)
class Workload:
    """counts: numbers of views. size: pixels a side. steps: of each fit. candidates: of a synthetic world."""

    counts: tuple[int, ...]
    size: int
    steps: int
    candidates: int


# The thesis's table 4.1 has 5 to 20 views.
FULL = Workload((3, 5, 8, 10, 13, 15, 20), 128, 400, 100)
QUICK = Workload((3, 5, 8, 13), 64, 200, 60)


class Viewpoints(Study):
    name = "viewpoints"
    title = "Where to look next: quality and path against the number of views (tables 4.1, 4.3)"

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        work = QUICK if request.quick else FULL
        lpips, missing = open_lpips(request.folders.lpips)
        if missing:
            print(f"  LPIPS is left out: {missing}")
        store = ResultStore.in_lines(request.out / "trials" / "viewpoints.jsonl")
        rows: list[Row] = []
        verdicts: list[Verdict] = []
        parts = ["# " + self.title, ""]
        for scene in request.scenes_here(SCENES[request.quick]):
            stage = open_stage(str(scenario_of(scene).path), work.candidates, work.size, request.folders.data)
            scorer = Scorer(lpips, background=stage.background)
            counts = tuple(c for c in work.counts if c <= int(stage.candidates.reachable.sum()))
            seeds = request.repeats(4, 8)
            progress = Progress(len(ARMS) * len(seeds))
            for arm in ARMS:
                for seed in seeds:
                    about = {"arm": ARMS[arm], "scene": scene, "seed": seed, "counts": counts, **vars(work)}
                    key = content_key([about, missing, source_digest()], 40)
                    run = partial(capture, stage, arm, seed, counts, work, scorer)
                    trial = store.get(key, compute=run)
                    rows += [{"scene": scene, "arm": arm, "seed": seed, **row} for row in trial["rows"]]
                    progress.advance(1.0)
                print(f"  {scene}, {arm}: done, {progress.time_left()} left", flush=True)
            here = [row for row in rows if row["scene"] == scene]
            draw(request.out / f"viewpoints-{scene}.png", here, scene)
            plans = {a: plan(stage, a, 0, JUDGED, work) for a in (*_SHOWN, "coverage, short way")}
            draw_plan(request.out / f"viewpoints-{scene}-paths.png", stage, list(plans.items()))
            draw_local(request.out / f"viewpoints-{scene}-images.png", stage, plans, work)
            verdicts += judge(scene, here, counts)
            parts += [f"## {scene}", "", describe(stage, work, len(seeds)), "", tables(here, counts), ""]
        store.close()
        write_csv(request.out / "viewpoints.csv", rows)
        write_text(request.out / "viewpoints-tables.md", "\n".join(parts))
        return verdicts


def plan(stage: Stage, arm: str, seed: int, views: int, work: Workload) -> Plan:
    """A capture of one arm; the seed draws the first view, the same for all arms."""
    selector, weight = ARMS[arm]
    return plan_capture(
        stage.candidates,
        make_selector(selector),
        Budget(views=views),
        stage.take,
        seed=seed,
        travel_weight=weight,
        fit=lambda given: stage.fit(given, work.steps, seed),
    )


def capture(stage: Stage, arm: str, seed: int, counts: tuple[int, ...], work: Workload, scorer: Scorer) -> Row:
    """{rows: ...}, a row for each number of views: quality on the views held out, path, and milliseconds of
    a choice. What does not depend on the budget is planned once, and its beginnings are scored."""
    whole = None if ARMS[arm][0] == "uniform" else plan(stage, arm, seed, counts[-1], work)
    rows = []
    for count in counts:
        made = whole or plan(stage, arm, seed, count, work)
        score = stage.score(stage.fit(made.views[:count], work.steps, seed), scorer)
        stops = made.stops[:count]
        rows.append(
            {
                "views": len(stops),
                "psnr_db": score.psnr_db,
                "ssim": score.ssim,
                "lpips": score.lpips,
                "path_m": sum(s.travel_m for s in stops),
                "choice_ms": 1e3 * float(np.mean([s.seconds for s in stops[1:]])),
            }
        )
    return {"rows": rows}


def curve(rows: list[Row], arm: str, metric: str) -> Curve:
    """views -> seed -> value."""
    found: Curve = {}
    for row in rows:
        if row["arm"] == arm and row[metric] is not None:
            found.setdefault(row["views"], {})[row["seed"]] = row[metric]
    return found


def judge(scene: str, rows: list[Row], counts: tuple[int, ...]) -> list[Verdict]:
    """Verdicts on tables 4.1 and 4.3."""
    verdicts = []
    for arm in ("random", "FisherRF"):
        of = curve(rows, arm, "psnr_db")
        gain = paired(of[counts[-1]], of[counts[0]])
        verdicts.append(
            Verdict(
                f"{scene}, {arm}",
                "more views are better (table 4.1: 20.2 dB with 5 to 22.7 dB with 20).",
                f"{counts[0]} to {counts[-1]} views: {gain.text(2)} dB.",
                gain.above(0.0),
                gain,
            )
        )
    chance, way = curve(rows, "random", "psnr_db")[JUDGED], curve(rows, "random", "path_m")[JUDGED]
    for arm in list(ARMS)[1:]:
        gain = paired(curve(rows, arm, "psnr_db")[JUDGED], chance)
        verdicts.append(
            Verdict(
                f"{scene}, {arm}, {JUDGED} views",
                "better than random views (table 4.3: FisherRF 4.8 dB).",
                f"{gain.text(2)} dB.",
                gain.above(0.0),
                gain,
            )
        )
    shorter = paired(curve(rows, "FisherRF", "path_m")[JUDGED], way)
    verdicts.append(
        Verdict(
            f"{scene}, FisherRF, {JUDGED} views, path",
            "shorter than a random one (table 4.3: 2.61 m, 3.28 m).",
            f"{shorter.text(2)} m longer.",
            negated(shorter.above(0.0)),
            shorter,
        )
    )
    return verdicts


def describe(stage: Stage, work: Workload, seeds: int) -> str:
    lens = stage.candidates.lens
    return (
        f"{int(stage.candidates.reachable.sum())} candidates, {len(stage.held_out)} views held out, "
        f"{lens.width} x {lens.height} pixels, `splat` fitted from scratch with {work.steps} steps to the "
        f"views of a plan, {seeds} seeds (first view, draws, fit). Means with 95 % intervals over seeds. "
        "A choice of FisherRF includes the fit of its field; others may have used the machine meanwhile."
    )


def tables(rows: list[Row], counts: tuple[int, ...]) -> str:
    """PSNR against the number of views, and all metrics at ``JUDGED`` views, in Markdown."""

    def at(arm: str, metric: str, count: int) -> Interval:
        return interval(curve(rows, arm, metric).get(count, {}).values())

    by_count = [[arm, *(at(arm, "psnr_db", c).text(1) for c in counts)] for arm in ARMS]
    kinds = (("psnr_db", 2), ("ssim", 3), ("lpips", 3), ("path_m", 2))
    judged = [
        [arm, *(at(arm, m, JUDGED).text(d) for m, d in kinds), number(at(arm, "choice_ms", JUDGED).mean, 1)]
        for arm in ARMS
    ]
    return "\n".join(
        [
            "PSNR (dB) against the number of views:",
            "",
            markdown_table(["selector", *map(str, counts)], by_count),
            "",
            f"With {JUDGED} views:",
            "",
            markdown_table(["selector", "PSNR (dB)", "SSIM", "LPIPS", "path (m)", "a choice (ms)"], judged),
        ]
    )


def draw(path: Path, rows: list[Row], scene: str) -> None:
    """Quality and path against the number of views."""
    metrics = [m for m in _METRICS if any(row[m] is not None for row in rows)]
    with figure(path, len(metrics) + 1, height_inch=2.4, sharex=True) as (_, axes):
        for at, metric in zip(axes[:, 0], [*metrics, "path_m"]):
            for k, arm in enumerate(ARMS):
                draw_curve(at, curve(rows, arm, metric), arm, k)
            last = metric == "path_m"
            label = "path (m)" if last else METRICS[metric].label
            label_lines(at, label, "views" if last else None, scene if metric == metrics[0] else None)


def draw_local(path: Path, stage: Stage, plans: dict[str, Plan], work: Workload) -> None:
    """Two held-out views, true and as each selector's views show them (figure 4.8)."""
    fields = {arm: stage.fit(made.views, work.steps, 0) for arm, made in plans.items()}
    rows: list[tuple[str, list[tuple[str, Image]]]] = []
    for view in stage.held_out[:: max(len(stage.held_out) // 2, 1)][:2]:
        shown = [("truth", view.image[..., :3])]
        shown += [(arm, to_bytes(f.render(view.camera_to_world, view.intrinsics).color)) for arm, f in fields.items()]
        rows.append((view.camera, shown))
    draw_images(path, rows)
