"""Figures 5.6 and 5.7: fidelity against the maximum age of information of used views."""

from __future__ import annotations

from typing import Any

from edge_server.experiments.common.statistics import interval, optimum
from edge_server.experiments.studies.drawing import draw_metrics, draw_trials
from edge_server.experiments.studies.study import METRICS, Point, SceneStudy, StudyRequest, Table, Verdict
from edge_server.experiments.studies.trial import recording

GAMMAS = (15.0, 21.0, 30.0, 45.0, 51.0, 60.0, 75.0, 90.0, 105.0, 120.0, 150.0, 200.0, 300.0, 400.0)
QUICK_GAMMAS = (15.0, 30.0, 51.0, 80.0, 120.0, 200.0, 400.0)
DISCIPLINES = ("drop-new", "parallel")
SHOWN = (21.0, 51.0, 120.0)
CLAIM = "fidelity first rises and then falls as the maximum age grows (5.6; best at 51 ms there)."
_METRICS = ("psnr_db", "psnr_moving_db", "shown_psnr_db", "shown_psnr_moving_db", "ssim", "lpips")


class Mat(SceneStudy):
    name = "mat"
    title = "Fidelity against the maximum age of used views (figures 5.6, 5.7)"

    scenes = ("room", "kitchen")

    def of_scene(self, request: StudyRequest, scene: str) -> list[Point]:
        ours = recording(scene) is None
        disciplines = DISCIPLINES if ours or not request.quick else DISCIPLINES[:1]
        channels = [({"discipline": d}, {"channel": {"preset": "ch5", "discipline": d}}) for d in disciplines]
        gammas = {"threshold": QUICK_GAMMAS if request.quick else GAMMAS}
        seeds = request.repeats(10 if ours else 4, 40)
        return request.sweep(scene, seeds, channels, "gamma_ms", gammas, [({"discipline": "-"}, {})])

    def judge(self, request: StudyRequest, table: Table, scene: str) -> list[Verdict]:
        disciplines = [d for d in DISCIPLINES if table.where(scene=scene, discipline=d)]
        draw_metrics(
            request.out / f"mat-{scene}.png",
            table,
            "gamma_ms",
            "maximum age (ms)",
            _METRICS,
            [(d, {"scene": scene, "discipline": d, "policy": "threshold"}) for d in disciplines],
            f"{scene}: threshold on age, from scratch",
            [("no delay", {"scene": scene, "policy": "no delay"})],
        )
        return [v for discipline in disciplines for v in self._judge(table, scene, discipline)]

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        self._draw_instants(request, table)
        return super().report(request, table)

    def _judge(self, table: Table, scene: str, discipline: str) -> list[Verdict]:
        found = []
        labels = {"scene": scene, "discipline": discipline}
        for metric in _METRICS:
            curve = table.curve("gamma_ms", metric, policy="threshold", **labels)
            if not curve:
                continue
            name, lower, digits, least = METRICS[metric]
            best = optimum(curve, lower)
            counts = table.curve("gamma_ms", "views", policy="threshold", **labels)
            views = interval(counts[best.x].values()).mean
            text = (
                f"best at {best.x:g} ms{best.spread} with {views:.1f} views; "
                f"{best.over_last.text(digits)} better than the largest threshold; "
                f"{table.no_delay_gain(metric, **labels)}."
            )
            about = f"{scene}, {discipline}, {name}"
            answer = best.interior(least)
            found.append(Verdict(about, CLAIM, text, answer, best.over_last))
        return found

    def _draw_instants(self, request: StudyRequest, table: Table) -> None:
        """Draw figure 5.7: one instant with three thresholds."""
        common: dict[str, Any] = {"seed": 3, "channel": {"preset": "ch5"}, "lpips": False}
        rows = [
            (scene, [request.trial(scene, policy="threshold", value=v, **common) for v in SHOWN])
            for scene in table.distinct("scene")
        ]
        draw_trials(request.out / "mat-pictures.png", request, rows)
