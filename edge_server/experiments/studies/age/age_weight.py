"""Equation 5.8: best threshold and best wait as a function of the weight of timeliness."""

from __future__ import annotations

from itertools import product

import numpy as np

from edge_server.experiments.common.statistics import Interval, move_of_optimum, optimum
from edge_server.experiments.studies.age.max_age import GAMMAS, QUICK_GAMMAS
from edge_server.experiments.studies.study import Curve, Point, Row, SceneStudy, StudyRequest, Table, Verdict
from edge_server.report.style import CYCLE, figure, label_lines

# Weights of one second of age relative to a mean squared error of 0.01 (20 dB).
LAMBDAS = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
WAITS = (15.0, 30.0, 45.0, 60.0, 90.0, 120.0, 200.0, 300.0)
QUICK_WAITS = (15.0, 45.0, 90.0, 150.0, 300.0)
# Sums of ages: of all cameras at the edge, as in (5.8), or of the used views, as in (6.35).
SUMS = {"all cameras (5.8)": "age_sum_ms", "used views (6.35)": "used_age_sum_ms"}
PIXELS = (("psnr_moving_db", "where it moves"), ("psnr_db", "whole image"))
POLICIES = ("threshold", "wait")
CLAIM = "a larger lambda buys freshness: the best omega falls (5.8)."


class Weighing(SceneStudy):
    name = "lambda"
    title = "The weight of timeliness in the objective (equation 5.8)"

    def of_scene(self, request: StudyRequest, scene: str) -> list[Point]:
        # The trials of the thresholds are those of ``mat``, and known if that study was run.
        settings = {"channel": {"preset": "ch5", "discipline": "drop-new"}}
        omegas = {
            "threshold": QUICK_GAMMAS if request.quick else GAMMAS,
            "wait": QUICK_WAITS if request.quick else WAITS,
        }
        return request.sweep(scene, request.repeats(10, 40), [({}, settings)], "omega_ms", omegas)

    def judge(self, request: StudyRequest, table: Table, scene: str) -> list[Verdict]:
        for row in table.where(scene=scene):
            row["used_age_sum_ms"] = row["aaoi_ms"] * row["views"]
        verdicts = []
        best: dict[tuple[str, str], list[float]] = {}
        for (metric, where), policy, (label, column) in product(PIXELS, POLICIES, SUMS.items()):
            curves = {w: _curve(table, scene, policy, metric, column, w) for w in LAMBDAS}
            if not all(curves.values()):
                continue
            found = [optimum(curve, True).x for curve in curves.values()]
            best[f"{policy}, {where}", label] = found
            _, move = move_of_optimum(curves, lower_is_better=True)
            by_lambda = ", ".join(f"{w:g}: {x:g}" for w, x in zip(LAMBDAS, found))
            text = (
                f"best omega in ms by lambda {by_lambda}; it moves by {move} ms; "
                f"{table.no_delay_gain(metric, scene=scene)}."
            )
            about = f"{scene}, {policy}, {where}, ages of {label}"
            verdicts.append(Verdict(about, CLAIM, text, _falls(move), move))
        with figure(request.out / f"lambda-{scene}.png", 1, height_inch=3.6) as (_, axes):
            at = axes[0, 0]
            for k, ((policy, label), xs) in enumerate(best.items()):
                at.plot(
                    range(len(LAMBDAS)),
                    xs,
                    marker="o",
                    markersize=4,
                    color=CYCLE[k % len(CYCLE)],
                    linestyle="-" if k < len(CYCLE) else "--",
                    label=f"{policy}, {label}",
                )
            at.set_xticks(range(len(LAMBDAS)), [f"{w:g}" for w in LAMBDAS])
            per = "lambda (per 0.01 of squared error and second of age)"
            label_lines(at, "best omega (ms)", per, scene)
        return verdicts


def _falls(move: Interval) -> bool | None:
    """Whether the best omega falls: True, False (it stays or rises), or None (undecided)."""
    if move.high < 0.0:
        return True
    return False if move.low >= 0.0 else None


def loss(row: Row, metric: str, column: str, weight: float) -> float:
    """(5.8) for one update: squared error in units of 0.01, plus the weighted sum of ages in seconds."""
    return float(10.0 ** (-row[metric] / 10.0) / 0.01 + weight * row[column] / 1e3)


def _curve(table: Table, scene: str, policy: str, metric: str, column: str, weight: float) -> Curve:
    found: Curve = {}
    for row in table.where(scene=scene, policy=policy):
        if row[metric] is not None and np.isfinite(row[metric]):
            found.setdefault(float(row["omega_ms"]), {})[row["seed"]] = loss(row, metric, column, weight)
    return found
