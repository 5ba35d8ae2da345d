"""Figure 5.8: the best threshold against the mean delay of the channel."""

from __future__ import annotations

import dataclasses

import numpy as np

from edge_server.offline.study.base import METRICS, Ask, Curve, Point, Table, Verdict, by_bool, with_data
from edge_server.offline.study.drawing import draw_curve
from edge_server.offline.study.mat import RECORDED, trial_of
from edge_server.offline.study.statistics import Optimum, optimum
from edge_server.report.style import CYCLE, figure, label_lines

DELAYS_MS = (15.0, 30.0, 45.0, 60.0, 90.0, 120.0, 180.0)
QUICK_DELAYS_MS = (20.0, 60.0, 180.0)
# Thresholds tried, in mean delays: the same shape of grid wherever the ages lie.
SHARES = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
QUICK_SHARES = (0.75, 1.5, 2.5, 4.0, 8.0)
PERIOD_MS = 30.0
CLAIM = "the best threshold grows with the mean delay (5.8)."
_METRICS = ("psnr_db", "psnr_moving_db", "ssim", "lpips")


class MatDelay:
    name = "mat-delay"
    title = "The best maximum age against the mean delay (figure 5.8)"

    def points(self, ask: Ask) -> list[Point]:
        found = []
        for scene in with_data(ask, ("room",), RECORDED.get):
            for seed in ask.repeats(8, 40):
                for delay in QUICK_DELAYS_MS if ask.quick else DELAYS_MS:
                    channel = {"preset": "ch5", "service": {"law": "exponential", "mean_ms": delay}}
                    base = trial_of(ask, scene, seed=seed, channel=channel, every_ms=1500.0)
                    for share in QUICK_SHARES if ask.quick else SHARES:
                        gamma = round(PERIOD_MS + share * delay, 1)
                        trial = dataclasses.replace(base, policy="threshold", value=gamma)
                        labels = {"scene": scene, "delay_ms": delay, "gamma_ms": gamma}
                        found.append(Point(labels, trial))
        return found

    def report(self, ask: Ask, table: Table) -> list[Verdict]:
        verdicts = []
        for scene in table.distinct("scene"):
            best: dict[str, dict[float, Optimum]] = {}
            for metric in _METRICS:
                best[metric] = {}
                for delay in table.distinct("delay_ms"):
                    curve = table.curve("gamma_ms", metric, scene=scene, delay_ms=delay)
                    if curve:
                        best[metric][delay] = optimum(curve, METRICS[metric][1])
                if len(best[metric]) > 1:
                    verdicts.append(self._judge(table, scene, metric, best[metric]))
            self._draw(ask, table, scene, best)
        return verdicts

    def _judge(self, table: Table, scene: str, metric: str, best: dict[float, Optimum]) -> Verdict:
        slope, low, high = _slope(table, scene, metric)
        told = ", ".join(f"{d:g} ms: {o.x:g} ({o.low:g} to {o.high:g})" for d, o in best.items())
        ends = [
            d for d, o in best.items() if o.x == max(table.curve("gamma_ms", metric, scene=scene, delay_ms=d))
        ]
        beyond = f"; at {', '.join(f'{d:g}' for d in ends)} ms the best is the largest tried" if ends else ""
        rising = True if low > 0 else False if high <= 0 else None
        return Verdict(
            f"{scene}, {METRICS[metric][0]}",
            CLAIM,
            f"by mean delay {told}{beyond}; "
            f"{slope:.2f} [{low:.2f}, {high:.2f}] ms of threshold a ms of delay.",
            by_bool(rising),
        )

    def _draw(self, ask: Ask, table: Table, scene: str, best: dict[str, dict[float, Optimum]]) -> None:
        with figure(ask.out / f"mat-delay-{scene}.png", 2, height_inch=2.8) as (_, axes):
            top, bottom = axes[:, 0]
            for k, (metric, found) in enumerate(best.items()):
                xs = [d * (1 + 0.02 * (k - 1.5)) for d in found]
                ys = [o.x for o in found.values()]
                spread = [[o.x - o.low for o in found.values()], [o.high - o.x for o in found.values()]]
                top.errorbar(xs, ys, spread, marker="o", markersize=4, capsize=2, color=CYCLE[k],
                             label=METRICS[metric][0])  # fmt: skip
            label_lines(top, "best threshold (ms)", None, f"{scene}: the best of the thresholds tried")
            for k, delay in enumerate(table.distinct("delay_ms")):
                curve: Curve = table.curve("gamma_ms", "psnr_moving_db", scene=scene, delay_ms=delay)
                draw_curve(bottom, curve, f"{delay:g} ms", k)
            label_lines(bottom, METRICS["psnr_moving_db"][0], "threshold (ms)")


def _slope(table: Table, scene: str, metric: str, resamples: int = 1000) -> tuple[float, float, float]:
    """Slope of best threshold against delay, and its 95 % interval by resampling seeds."""
    delays = table.distinct("delay_ms")
    sign = -1.0 if METRICS[metric][1] else 1.0
    tables, grids = [], []
    for delay in delays:
        curve = table.curve("gamma_ms", metric, scene=scene, delay_ms=delay)
        seeds = sorted(set.intersection(*(set(v) for v in curve.values())))
        values = [[curve[g][s] for g in curve] for s in seeds]
        tables.append(sign * np.array(values, float))
        grids.append(np.array(list(curve)))
    count = min(len(t) for t in tables)
    rng = np.random.default_rng(11)

    def best(picks: np.ndarray) -> float:
        ys = [g[np.nanmean(t[picks], 0).argmax()] for g, t in zip(grids, tables)]
        return float(np.polyfit(delays, ys, 1)[0])

    slopes = [best(rng.integers(0, count, count)) for _ in range(resamples)]
    low, high = np.percentile(slopes, [2.5, 97.5])
    return best(np.arange(count)), float(low), float(high)
