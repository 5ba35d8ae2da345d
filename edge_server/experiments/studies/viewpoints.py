"""Tables 4.1 and 4.3: quality and path against the number of views, by selector."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import Row, SeedTable
from edge_server.experiments.common.statistics import interval
from edge_server.experiments.common.tables import markdown_table, number
from edge_server.experiments.studies.drawing import draw_curve
from edge_server.experiments.studies.study import Study, StudyRequest, open_engine
from edge_server.experiments.studies.trial import scenario_of, scene_label, scenes_here
from edge_server.experiments.studies.verdicts import METRICS, Claim, better, trend
from edge_server.experiments.viewpoints.stage import Stage, open_stage
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Field
from edge_server.matplotlib_figures import figure, label_lines
from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.capture_planner import Budget, Plan, Stop, plan_capture
from edge_server.viewpoints.registry import make_selector

# label -> (selector, weight of the way)
ARMS = {
    "random": ("random", 0.0),
    "coverage": ("coverage", 0.0),
    "FisherRF": ("fisher", 0.0),
    "coverage, short way": ("coverage", 0.3),
}
JUDGED = 8  # views of table 4.3
SCENES = {True: ("tile",), False: ("tile", "lego", "kitchen", "cell")}  # by whether it is a quick pass


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


@dataclass(frozen=True)
class Capture:
    """One capture: an arm on a scene."""

    arm: str
    scene: str
    seed: int
    work: Workload


@lru_cache(1)
def stage_of(scene: str, work: Workload, folders: Folders) -> Stage:
    """The stage of a scene; the last one is kept."""
    return open_stage(str(scenario_of(scene).path), work.candidates, work.size, folders.data)


def workload(request: StudyRequest) -> Workload:
    return QUICK if request.quick else FULL


def _cases(request: StudyRequest) -> list[Capture]:
    return [
        Capture(arm, scene, seed, workload(request))
        for scene in scenes_here(request, SCENES[request.quick])
        for arm in ARMS
        for seed in request.repeats(4, 8)
    ]


def files_of(case: Any, folders: Folders) -> list[Any]:
    """Files that the result of a capture depends on."""
    scenario = scenario_of(case.scene)
    return [scenario.path, *folders.files_of(scenario)]


def _measure(cases: Sequence[Capture], request: StudyRequest) -> list[Row]:
    with open_engine(request, "viewpoints") as engine:
        found = engine.run(
            partial(capture, folders=request.folders),
            cases,
            "captures",
            files=lambda case: files_of(case, request.folders),
            group=lambda case: case.scene,
        )
    return [
        {"scene": scene_label(case.scene), "arm": case.arm, "seed": case.seed, **row}
        for case, rows in zip(cases, found)
        for row in rows
    ]


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


def capture(case: Capture, *, folders: Folders) -> list[Row]:
    """A row for each number of views: quality on the views held out, path, and milliseconds of a choice. It is
    planned once, and its beginnings are scored."""
    stage, work = stage_of(case.scene, case.work, folders), case.work
    scorer = Scorer(open_lpips(folders.lpips)[0], background=stage.background)
    usable = int(stage.candidates.reachable.sum())
    counts = [count for count in work.counts if count <= usable]
    if not counts:
        raise ViewpointError(
            f"--scene {case.scene}: {usable} viewpoints to choose from, fewer than the {work.counts[0]} views of the "
            "smallest capture: give a scene with more"
        )
    made = plan(stage, case.arm, case.seed, counts[-1], work)
    rows = []
    for count in counts:
        field, stops = stage.fit(made.views[:count], work.steps, case.seed), made.stops[:count]
        rows.append({"views": len(stops), **measured(stage, field, stops, scorer)})
    return rows


def measured(stage: Stage, field: Field, stops: Sequence[Stop], scorer: Scorer) -> Row:
    """Quality on the views held out, path, and milliseconds of a choice."""
    score = stage.score(field, scorer)
    return {
        "psnr_db": score.psnr_db,
        "ssim": score.ssim,
        "lpips": score.lpips,
        "path_m": sum(stop.travel_m for stop in stops),
        "choice_ms": 1e3 * float(np.mean([stop.seconds for stop in stops[1:]])),
    }


def _draw(request: StudyRequest, table: SeedTable) -> None:
    """Quality and path against the number of views."""
    for (name,) in table.distinct("scene"):
        metrics = [m for m in ("psnr_db", "ssim", "lpips") if any(r[m] is not None for r in table.where(scene=name))]
        with figure(request.figure(f"viewpoints-{name}.png"), len(metrics) + 1, height_inch=2.4, sharex=True) as (
            _,
            axes,
        ):
            for at, metric in zip(axes[:, 0], [*metrics, "path_m"]):
                for k, arm in enumerate(ARMS):
                    draw_curve(at, table.curve("views", metric, scene=name, arm=arm), arm, k)
                last = metric == "path_m"
                label_lines(
                    at, METRICS[metric].label, "views" if last else None, name if metric == metrics[0] else None
                )


def _tables(table: SeedTable) -> str:
    """PSNR against the number of views, and all metrics at ``JUDGED`` views."""
    parts = []
    for (scene,) in table.distinct("scene"):
        counts = sorted({row["views"] for row in table.where(scene=scene)})
        by_count = [
            [arm, *(_mean(table, "psnr_db", 1, scene=scene, arm=arm, views=count) for count in counts)] for arm in ARMS
        ]
        kinds = (("psnr_db", 2), ("ssim", 3), ("lpips", 3), ("path_m", 2), ("choice_ms", 1))
        judged = [
            [arm, *(_mean(table, m, digits, scene=scene, arm=arm, views=JUDGED) for m, digits in kinds)] for arm in ARMS
        ]
        parts += [
            f"## {scene}: PSNR (dB) against the number of views",
            markdown_table(["selector", *map(str, counts)], by_count),
            f"With {JUDGED} views (a choice of FisherRF includes the fit of its field):",
            markdown_table(["selector", "PSNR (dB)", "SSIM", "LPIPS", "path (m)", "a choice (ms)"], judged),
        ]
    return "\n\n".join(parts)


def _mean(table: SeedTable, metric: str, digits: int, **labels: Any) -> str:
    found = interval(table.values(metric, **labels).values())
    return number(found.mean, digits) if metric == "choice_ms" else found.text(digits)


AT_JUDGED = {"views": JUDGED}
RANDOM = {"arm": "random", **AT_JUDGED}
VIEWPOINTS = Study(
    "viewpoints",
    "Where to look next: quality and path against the number of views (tables 4.1, 4.3)",
    _cases,
    _measure,
    ("psnr_db",),
    (
        *(
            Claim(
                "more views are better (table 4.1: 20.2 dB with 5 to 22.7 dB with 20).",
                trend("views"),
                where={"arm": arm},
            )
            for arm in ("random", "FisherRF")
        ),
        *(
            Claim(
                "better than random views (table 4.3: FisherRF 4.8 dB).",
                better({"arm": arm, **AT_JUDGED}, RANDOM),
                where={"arm": arm},
            )
            for arm in list(ARMS)[1:]
        ),
        Claim(
            "a shorter path than a random one (table 4.3: 2.61 m, 3.28 m).",
            better({"arm": "FisherRF", **AT_JUDGED}, RANDOM),
            where={"arm": "FisherRF"},
            metrics=("path_m",),
        ),
    ),
    draw=(_draw,),
    tables=_tables,
)
