"""Figures 5.6 and 5.7: fidelity against the maximum age of information that a used view may have."""

from __future__ import annotations

import dataclasses
from typing import Any

from edge_server.experiments.common.statistics import interval, optimum
from edge_server.experiments.studies.drawing import Image, draw_metrics, draw_pictures
from edge_server.experiments.studies.study import (
    LEAST,
    METRICS,
    Point,
    StudyRequest,
    Table,
    Verdict,
    by_bool,
    no_delay_gain,
    number,
    with_data,
)
from edge_server.experiments.studies.trial import Trial, picture

GAMMAS = (15.0, 21.0, 30.0, 45.0, 51.0, 60.0, 75.0, 90.0, 105.0, 120.0, 150.0, 200.0, 300.0, 400.0)
QUICK_GAMMAS = (15.0, 30.0, 51.0, 80.0, 120.0, 200.0, 400.0)
DISCIPLINES = ("drop-new", "parallel")
PICTURED = (21.0, 51.0, 120.0)
CLAIM = "fidelity first rises and then falls as the maximum age grows (5.6; best at 51 ms there)."
_METRICS = ("psnr_db", "psnr_moving_db", "ssim", "lpips")
# Where a recorded scene lies below the data folder, and how much smaller its pictures are in a quick pass.
RECORDED = {
    "kitchen": "blender_kitchen/transforms.json",
    "people": "pose2sim_single_person/calibration_opencv.json",
}


def trial_of(request: StudyRequest, scene: str, **more: Any) -> Trial:
    """The study's usual trial of a scene: pictures and steps as ``request`` has it."""
    sized = request.pictured()
    if scene in RECORDED:
        sized = {"scale": 2.0 if request.quick else 1.0, "steps": sized["steps"], "speed_m_per_s": None}
    return Trial(scene=scene, **{**sized, **more})


class Mat:
    name = "mat"
    title = "Fidelity against the maximum age of used views (figures 5.6, 5.7)"

    def points(self, request: StudyRequest) -> list[Point]:
        gammas = QUICK_GAMMAS if request.quick else GAMMAS
        found = []
        for scene in with_data(request, ("room", "kitchen", "people"), RECORDED.get):
            ours = scene not in RECORDED
            seeds = request.repeats(10 if ours else 4, 40)
            for seed in seeds:
                for discipline in DISCIPLINES if ours or not request.quick else DISCIPLINES[:1]:
                    channel = {"preset": "ch5", "discipline": discipline}
                    base = trial_of(request, scene, seed=seed, channel=channel)
                    labels = {"scene": scene, "discipline": discipline}
                    found.append(Point({**labels, "policy": "all", "gamma_ms": None}, base))
                    for gamma in gammas:
                        trial = dataclasses.replace(base, policy="threshold", value=gamma)
                        found.append(Point({**labels, "policy": "threshold", "gamma_ms": gamma}, trial))
                ideal = trial_of(request, scene, seed=seed, channel={"preset": "ideal"})
                found.append(Point({"scene": scene, "discipline": "-", "policy": "no delay"}, ideal))
        return found

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        verdicts = []
        for scene in table.distinct("scene"):
            disciplines = [d for d in DISCIPLINES if table.where(scene=scene, discipline=d)]
            draw_metrics(
                request.out / f"mat-{scene}.png", table, "gamma_ms", "maximum age (ms)", _METRICS,
                [(d, {"scene": scene, "discipline": d, "policy": "threshold"}) for d in disciplines],
                f"{scene}: threshold on age, from scratch",
                [("no delay", {"scene": scene, "policy": "no delay"})],
            )  # fmt: skip
            for discipline in disciplines:
                verdicts += self._judge(table, scene, discipline)
        self._pictures(request, table)
        return verdicts

    def _judge(self, table: Table, scene: str, discipline: str) -> list[Verdict]:
        found = []
        labels = {"scene": scene, "discipline": discipline}
        for metric in _METRICS:
            curve = table.curve("gamma_ms", metric, policy="threshold", **labels)
            if not curve:
                continue
            name, lower, digits = METRICS[metric]
            best = optimum(curve, lower)
            views = interval(
                list(table.curve("gamma_ms", "views", policy="threshold", **labels)[best.x].values())
            )
            found.append(
                Verdict(
                    f"{scene}, {discipline}, {name}",
                    CLAIM,
                    f"best at {best.x:g} ms{best.spread} with {views.mean:.1f} views; "
                    f"{number(best.over_last.mean, digits)} [{number(best.over_last.low, digits)}, "
                    f"{number(best.over_last.high, digits)}] better than the largest threshold; "
                    f"{no_delay_gain(table, metric, **labels)}.",
                    by_bool(best.interior(LEAST[metric])),
                )
            )
        return found

    def _pictures(self, request: StudyRequest, table: Table) -> None:
        """Figure 5.7: one instant under three thresholds."""
        rows = []
        for scene in table.distinct("scene"):
            shown: list[tuple[str, Image]] = []
            for gamma in PICTURED:
                trial = trial_of(
                    request,
                    scene,
                    seed=3,
                    channel={"preset": "ch5"},
                    policy="threshold",
                    value=gamma,
                    lpips=False,
                )
                truth, rendering, row = picture(trial, request.folders)
                if not shown:
                    shown.append(("truth at the present", truth))
                shown.append((f"{gamma:g} ms: {row['views']:.0f} views, {row['psnr_db']:.1f} dB", rendering))
            rows.append((scene, shown))
        if rows:
            draw_pictures(request.out / "mat-pictures.png", rows)
