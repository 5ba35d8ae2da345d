"""Figure 5.8: the best threshold against the mean delay of the channel."""

from __future__ import annotations

from edge_server.experiments.common.statistics import Optimum, move_of_optimum, optimum
from edge_server.experiments.studies.drawing import draw_curve
from edge_server.experiments.studies.study import METRICS, Curve, Point, SceneStudy, StudyRequest, Table, Verdict
from edge_server.report.style import CYCLE, figure, label_lines

DELAYS_MS = (15.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0)
QUICK_DELAYS_MS = (20.0, 60.0, 180.0)
# The same thresholds for every delay: if the grid grew with the delay, every optimum would grow with it.
GAMMAS = (30.0, 45.0, 60.0, 75.0, 90.0, 120.0, 165.0, 240.0, 330.0, 480.0, 700.0, 1000.0)
QUICK_GAMMAS = (45.0, 75.0, 120.0, 180.0, 300.0, 500.0, 900.0)
CLAIM = "the best threshold grows with the mean delay (5.8)."
_METRICS = ("psnr_db", "psnr_moving_db", "ssim", "lpips")


def _curve(table: Table, scene: str, metric: str, delay: float) -> Curve:
    return table.curve("gamma_ms", metric, scene=scene, delay_ms=delay, policy="threshold")


class MatDelay(SceneStudy):
    name = "mat-delay"
    title = "The best maximum age against the mean delay (figure 5.8)"

    def of_scene(self, request: StudyRequest, scene: str) -> list[Point]:
        every = {"every_ms": 1500.0}
        delays = [
            (
                {"delay_ms": ms},
                {"channel": {"preset": "ch5", "service": {"law": "exponential", "mean_ms": ms}}, **every},
            )
            for ms in (QUICK_DELAYS_MS if request.quick else DELAYS_MS)
        ]
        gammas = {"threshold": QUICK_GAMMAS if request.quick else GAMMAS}
        return request.sweep(scene, request.repeats(8, 40), delays, "gamma_ms", gammas, [({}, every)])

    def judge(self, request: StudyRequest, table: Table, scene: str) -> list[Verdict]:
        verdicts = []
        best: dict[str, dict[float, Optimum]] = {}
        for metric in _METRICS:
            curves = {delay: _curve(table, scene, metric, delay) for delay in table.distinct("delay_ms")}
            curves = {delay: curve for delay, curve in curves.items() if curve}
            best[metric] = {delay: optimum(curve, METRICS[metric].lower) for delay, curve in curves.items()}
            if len(curves) > 1:
                verdicts.append(self._judge(table, scene, metric, curves, best[metric]))
        self._draw(request, table, scene, best)
        return verdicts

    def _judge(
        self, table: Table, scene: str, metric: str, curves: dict[float, Curve], best: dict[float, Optimum]
    ) -> Verdict:
        slope, _ = move_of_optimum(curves, METRICS[metric].lower)
        without = [f"{d:g}" for d, o in best.items() if o.interior(METRICS[metric].least) is not True]
        text = ", ".join(f"{d:g} ms: {o.x:g}{o.spread}" for d, o in best.items())
        # Fidelity that only rises or only falls is best at the same end of the grid for every delay, so the
        # slope is zero.
        none = f"; that it falls on both sides is not shown at {', '.join(without)} ms" if without else ""
        return Verdict(
            f"{scene}, {METRICS[metric].label}",
            CLAIM,
            f"by mean delay {text}{none}; {slope} ms of threshold a ms of delay; "
            f"{table.no_delay_gain(metric, scene=scene, delay_ms=max(best))} at {max(best):g} ms.",
            slope.above(0.0),
            slope,
        )

    def _draw(self, request: StudyRequest, table: Table, scene: str, best: dict[str, dict[float, Optimum]]) -> None:
        with figure(request.out / f"mat-delay-{scene}.png", 2, height_inch=2.8) as (_, axes):
            top, bottom = axes[:, 0]
            for k, (metric, found) in enumerate(best.items()):
                xs = [d * (1 + 0.02 * (k - 1.5)) for d in found]
                ys = [o.x for o in found.values()]
                spread = [[o.x - o.low for o in found.values()], [o.high - o.x for o in found.values()]]
                top.errorbar(
                    xs, ys, spread, marker="o", markersize=4, capsize=2, color=CYCLE[k], label=METRICS[metric].label
                )
            label_lines(top, "best threshold (ms)", None, f"{scene}: the best of the thresholds tried")
            for k, delay in enumerate(table.distinct("delay_ms")):
                draw_curve(bottom, _curve(table, scene, "psnr_moving_db", delay), f"{delay:g} ms", k)
            label_lines(bottom, METRICS["psnr_moving_db"].label, "threshold (ms)")
