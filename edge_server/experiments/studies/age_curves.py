"""Fidelity against the age of used views: figures 5.6 to 5.8, equation 5.8."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from edge_server.experiments.common.seed_table import Curve, Row, SeedTable
from edge_server.experiments.common.statistics import optimum
from edge_server.experiments.studies.drawing import curves, instants
from edge_server.experiments.studies.study import Study, StudyRequest
from edge_server.experiments.studies.trial import Point, recording, run_points, scenes_here, sweep
from edge_server.experiments.studies.verdicts import METRICS, Claim, interior, optimum_falls, optimum_grows
from edge_server.matplotlib_figures import CYCLE, figure, label_lines

GAMMAS = (15.0, 21.0, 30.0, 45.0, 51.0, 60.0, 75.0, 90.0, 105.0, 120.0, 150.0, 200.0, 300.0, 400.0)
QUICK_GAMMAS = (15.0, 30.0, 51.0, 80.0, 120.0, 200.0, 400.0)
SHOWN = (21.0, 51.0, 120.0)
CHANNELS = {name: {"preset": "ch5", "discipline": name} for name in ("drop-new", "parallel")}
MAT_METRICS = ("psnr_db", "psnr_moving_db", "shown_psnr_db", "shown_psnr_moving_db", "ssim", "lpips")

# --- figures 5.6 and 5.7 -----------------------------------------------------------------------------------


def _mat_cases(request: StudyRequest) -> list[Point]:
    gammas = {"threshold": QUICK_GAMMAS if request.quick else GAMMAS}
    found = []
    for scene in scenes_here(request, ("room", "kitchen")):
        ours = recording(scene) is None
        channels = list(request.channels(CHANNELS).items())
        some = channels if ours or not request.quick else channels[:1]
        conditions = [({"channel": name}, {"channel": channel}) for name, channel in some]
        found += sweep(request, scene, request.repeats(10 if ours else 4, 40), conditions, "gamma_ms", gammas)
    return found


MAT = Study(
    "mat",
    "Fidelity against the maximum age of used views (figures 5.6, 5.7)",
    _mat_cases,
    run_points,
    MAT_METRICS,
    (
        Claim(
            "fidelity first rises and then falls as the maximum age grows (5.6; best at 51 ms there).",
            interior("gamma_ms"),
            bound=None,
            where={"policy": "threshold"},
        ),
    ),
    ("scene", "channel"),
    (
        curves("mat", "gamma_ms", "maximum age (ms)", MAT_METRICS, "channel", of="5.6", policy="threshold"),
        instants("mat", ("room", "kitchen"), "threshold", SHOWN, {"preset": "ch5"}, of="5.7"),
    ),
)

# --- figure 5.8 ----------------------------------------------------------------------------------------------

DELAYS_MS = (15.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0)
QUICK_DELAYS_MS = (20.0, 60.0, 180.0)
# The same thresholds for every delay: if the grid grew with the delay, every optimum would grow with it.
DELAY_GAMMAS = (30.0, 45.0, 60.0, 75.0, 90.0, 120.0, 165.0, 240.0, 330.0, 480.0, 700.0, 1000.0)
QUICK_DELAY_GAMMAS = (45.0, 75.0, 120.0, 180.0, 300.0, 500.0, 900.0)


def with_mean_delay(channel: Row, mean_ms: float) -> Row:
    """The channel with exponential delays of that mean."""
    return {**channel, "service": {"law": "exponential", "mean_ms": mean_ms}}


def _delay_cases(request: StudyRequest) -> list[Point]:
    every = {"every_ms": 1500.0}
    gammas = {"threshold": QUICK_DELAY_GAMMAS if request.quick else DELAY_GAMMAS}
    (channel,) = request.channels({"ch5": {"preset": "ch5"}}).values()
    delays = [
        ({"delay_ms": ms}, {"channel": with_mean_delay(channel, ms), **every})
        for ms in (QUICK_DELAYS_MS if request.quick else DELAYS_MS)
    ]
    seeds = request.repeats(8, 40)
    return [
        p
        for scene in scenes_here(request, ("room",))
        for p in sweep(request, scene, seeds, delays, "gamma_ms", gammas, [({}, every)])
    ]


def _draw_delay(request: StudyRequest, table: SeedTable) -> None:
    for (scene,) in table.distinct("scene"):
        with figure(request.figure(f"mat-delay-{scene}.png"), 1, height_inch=3.6) as (_, axes):
            at = axes[0, 0]
            delays = [delay for (delay,) in table.distinct("delay_ms")]
            for k, metric in enumerate(MAT_DELAY.metrics):
                _, lower, _, least = METRICS[metric]
                curves = {d: table.curve("gamma_ms", metric, scene=scene, delay_ms=d) for d in delays}
                best = {d: optimum(curve, lower, least) for d, curve in curves.items() if curve}
                spread = [[o.x - o.low for o in best.values()], [o.high - o.x for o in best.values()]]
                style: dict[str, Any] = {"marker": "o", "markersize": 4, "capsize": 2, "color": CYCLE[k]}
                xs = [d * (1 + 0.02 * (k - 1.5)) for d in best]
                at.errorbar(xs, [o.x for o in best.values()], spread, label=METRICS[metric].label, **style)
            label_lines(at, "best threshold (ms)", "mean delay (ms)", f"{scene}: the best of the thresholds tried")


MAT_DELAY = Study(
    "mat-delay",
    "The best maximum age against the mean delay (figure 5.8)",
    _delay_cases,
    run_points,
    ("psnr_db", "psnr_moving_db", "ssim", "lpips"),
    (
        Claim(
            "the best threshold, inside the range, grows with the mean delay (5.8).",
            optimum_grows("delay_ms", "gamma_ms"),
            where={"policy": "threshold"},
        ),
    ),
    draw=(_draw_delay,),
)

# --- equation 5.8 --------------------------------------------------------------------------------------------

# Weights of one second of age relative to a mean squared error of 0.01 (20 dB).
LAMBDAS = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
WAITS = (15.0, 30.0, 45.0, 60.0, 90.0, 120.0, 200.0, 300.0)
QUICK_WAITS = (15.0, 45.0, 90.0, 150.0, 300.0)


def _lambda_cases(request: StudyRequest) -> list[Point]:
    # The trials of the thresholds are those of ``mat``, and known if that study was run.
    conditions = [
        ({"channel": name}, {"channel": channel})
        for name, channel in request.channels({"drop-new": CHANNELS["drop-new"]}).items()
    ]
    omegas = {"threshold": QUICK_GAMMAS if request.quick else GAMMAS, "wait": QUICK_WAITS if request.quick else WAITS}
    seeds = request.repeats(10, 40)
    scenes = scenes_here(request, ("room",))
    return [p for s in scenes for p in sweep(request, s, seeds, conditions, "omega_ms", omegas)]


def loss(row: Row, metric: str, weight: float) -> float:
    """(5.8) for one update: squared error in units of 0.01, plus the weighted sum of all cameras' ages in seconds."""
    return float(10.0 ** (-row[metric] / 10.0) / 0.01 + weight * row["age_sum_ms"] / 1e3)


def _losses(table: SeedTable, metric: str, labels: Row) -> dict[float, Curve]:
    """lambda -> omega -> seed -> loss."""
    rows = [r for r in table.where(**labels) if r[metric] is not None and np.isfinite(r[metric])]
    found: dict[float, Curve] = {}
    for weight, row in product(LAMBDAS, rows):
        curve = found.setdefault(weight, {})
        curve.setdefault(float(row["omega_ms"]), {})[row["seed"]] = loss(row, metric, weight)
    return found


def _draw_lambda(request: StudyRequest, table: SeedTable) -> None:
    for (scene,) in table.distinct("scene"):
        with figure(request.figure(f"lambda-{scene}.png"), 1, height_inch=3.6) as (_, axes):
            at = axes[0, 0]
            for k, (metric, policy) in enumerate(product(LAMBDA.metrics, ("threshold", "wait"))):
                curves = _losses(table, metric, {"scene": scene, "policy": policy})
                best = [optimum(curve, True).x for curve in curves.values()]
                label = f"{policy}, {METRICS[metric].label}"
                at.plot(range(len(best)), best, marker="o", markersize=4, color=CYCLE[k], label=label)
            at.set_xticks(range(len(LAMBDAS)), [f"{w:g}" for w in LAMBDAS])
            per = "lambda (per 0.01 of squared error and second of age)"
            label_lines(at, "best omega (ms)", per, scene)


LAMBDA = Study(
    "lambda",
    "The weight of timeliness in the objective (equation 5.8)",
    _lambda_cases,
    run_points,
    ("psnr_moving_db", "psnr_db"),
    tuple(
        Claim(
            "a larger lambda buys freshness: the best omega falls (5.8).",
            optimum_falls(_losses),
            where={"policy": policy},
        )
        for policy in ("threshold", "wait")
    ),
    ("scene", "channel"),
    (_draw_lambda,),
)
