"""Claims of studies, and the verdicts on them.

A claim is made of a statistic: whether a curve has an optimum, a plateau or a trend, or how two policies differ.

Functions that return a ``Statistic`` take the names of labels; differences are positive where the first is better.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from edge_server.experiments.common.seed_table import TRAINING, Curve, PerSeed, Row, SeedTable, difference
from edge_server.experiments.common.statistics import (
    Interval,
    all_of,
    at_its_best,
    crossed,
    discoveries,
    interval,
    move_of_optimum,
    optimum,
    paired,
)
from edge_server.experiments.common.tables import number
from edge_server.experiments.studies.study_constants import LEAST_DB
from edge_server.scheduler.learned.learning_constants import W_S

NO_DELAY, USE_ALL = "no delay", "all"
HOLDS, DOES_NOT_HOLD, UNDECIDED = "holds", "does not hold", "undecided"


class Metric(NamedTuple):
    """A measured quantity.

    label: text of the axis. lower: whether lower is better. digits: decimals in texts.
    least: smallest difference that supports a claim.
    """

    label: str
    lower: bool
    digits: int
    least: float


METRICS = {
    "psnr_db": Metric("PSNR (dB)", False, 2, LEAST_DB),
    "psnr_moving_db": Metric("PSNR, moving pixels (dB)", False, 2, LEAST_DB),
    "shown_psnr_db": Metric("PSNR as shown (dB)", False, 2, LEAST_DB),
    "shown_psnr_moving_db": Metric("PSNR as shown, moving pixels (dB)", False, 2, LEAST_DB),
    "ssim": Metric("SSIM", False, 3, 0.002),
    "lpips": Metric("LPIPS", True, 3, 0.002),
    "aaoi_ms": Metric("mean age of used views (ms)", True, 1, 0.0),
    "f_w": Metric("F_w (6.37)", True, 3, 0.01),
    "f_w_corrected": Metric(f"F_w with w_s = {-W_S:g}", True, 3, 0.01),
    "kilobytes_per_s": Metric("kilobytes a second, all cameras", True, 0, 0.0),
    "reward": Metric("reward", False, 4, 0.0),
    "path_m": Metric("path (m)", True, 2, 0.0),
    "does_not_know": Metric("share of cases", False, 2, 0.0),
    "agreement_share": Metric("share of the expert's agreement with itself", False, 3, 0.0),
}


@dataclass(frozen=True)
class Finding:
    """What was found for a claim.

    text: in words.
    differences: what must lie above the claim's bound, each of them.
    """

    text: str
    differences: tuple[Interval, ...]

    def above(self, bound: float) -> bool | None:
        """Whether the differences lie above the bound, by their 95 % intervals; None where that is undecided."""
        return all_of(d.above(bound) for d in self.differences)

    def p_value(self, bound: float) -> float:
        """The p-value of ``above``: the largest of all; where some contradict it, the smallest of theirs, times the
        number of all."""
        values = [d.p_value(bound) for d in self.differences if d.above(bound) is False]
        if not values:
            return max(d.p_value(bound) for d in self.differences)
        return min(1.0, len(self.differences) * min(values))


Statistic = Callable[[SeedTable, str, Row], Finding | None]
"""(rows, metric, labels of the verdict) -> what was found; None where nothing was measured."""


@dataclass(frozen=True)
class Claim:
    """A sentence that holds where a statistic lies above a bound.

    bound: None: the metric's least difference. By metric, or one for all.
    where: further labels of the rows that it is about; also named in the verdict.
    metrics: those that it is about; None: the study's.
    """

    text: str
    statistic: Statistic
    bound: float | Mapping[str, float] | None = 0.0
    where: Row = field(default_factory=dict)
    metrics: tuple[str, ...] | None = None

    def bound_of(self, metric: str) -> float:
        if self.bound is None:
            return METRICS[metric].least
        return self.bound if isinstance(self.bound, float | int) else self.bound[metric]


@dataclass(frozen=True)
class Verdict:
    """A claim, the result here, and whether the claim holds.

    about: scene and setting.
    holds: None where it is undecided.
    """

    about: str
    claim: str
    found: str
    holds: bool | None

    @property
    def verdict(self) -> str:
        return UNDECIDED if self.holds is None else HOLDS if self.holds else DOES_NOT_HOLD

    def line(self) -> str:
        return f"[{self.verdict}] {self.about}: {self.claim} Found: {self.found}"


def interior(x: str) -> Statistic:
    """The curve over ``x`` is better somewhere inside than at both ends."""

    def found(table: SeedTable, metric: str, labels: Row) -> Finding | None:
        _, lower, digits, _ = METRICS[metric]
        curve = table.curve(x, metric, **labels)
        if len(curve) < 3:  # there is no inside
            return None
        best = optimum(curve, lower)
        text = (
            f"best at {best.x:g}{best.spread}; inside {best.over_first.text(digits)} better than at the smallest and "
            f"{best.over_last.text(digits)} than at the largest."
        )
        return Finding(text, (best.over_first, best.over_last))

    return found


def plateau(x: str, start: float) -> Statistic:
    """From ``start`` on the curve stays near its best: at the first point from there, and at the last one. The
    differences are those of the points minus the best, which is chosen on other seeds."""

    def found(table: SeedTable, metric: str, labels: Row) -> Finding | None:
        _, lower, digits, _ = METRICS[metric]
        curve = table.curve(x, metric, **labels)
        later = [at for at in curve if at >= start]
        if not later:
            return None
        best = at_its_best(curve, lower)
        ends = {at: _gain(curve[at], best, lower) for at in (later[0], later[-1])}
        text = ", ".join(f"at {at:g} {gap.text(digits)}" for at, gap in ends.items())
        return Finding(f"gained over the best ({optimum(curve, lower).x:g}): {text}.", tuple(ends.values()))

    return found


def trend(x: str, rises: bool | None = None) -> Statistic:
    """The last point of the curve is better than the first; with ``rises`` higher."""

    def found(table: SeedTable, metric: str, labels: Row) -> Finding | None:
        _, lower, digits, _ = METRICS[metric]
        curve = table.curve(x, metric, **labels)
        if len(curve) < 2:  # of one point nothing can be said
            return None
        first, last = min(curve), max(curve)
        change = _gain(curve[last], curve[first], lower if rises is None else not rises)
        ends = (number(interval(curve[at].values()).mean, digits) for at in (first, last))
        text = f"from {first:g} to {last:g}: {' to '.join(ends)}."
        return Finding(text, (change,))

    return found


def optimum_grows(parameter: str, x: str) -> Statistic:
    """The best ``x`` grows with ``parameter``: the slope over the parameters whose curve has an optimum inside. A curve
    that only saturates has none, however early it comes near its top. The best x is the smallest within the least
    difference of the best."""

    def found(table: SeedTable, metric: str, labels: Row) -> Finding | None:
        _, lower, _, least = METRICS[metric]
        curves = {
            value: curve
            for (value,) in table.distinct(parameter)
            if (curve := table.curve(x, metric, **{**labels, parameter: value}))
        }
        best = {value: optimum(curve, lower, least) for value, curve in curves.items()}
        inside = {value: o.interior(least) for value, o in best.items()}
        peaked = {value: curves[value] for value in curves if inside[value] is True}
        text = ", ".join(
            f"{value:g}: {o.x:g}{o.spread}{'' if inside[value] else ', no optimum inside is shown'}"
            for value, o in best.items()
        )
        if len(peaked) < 2:
            # Without two optima nothing can grow: that is as sure as that a side of each other curve does not fall.
            flat = [o for value, o in best.items() if inside[value] is not True]
            sides = [_less(side, least) for o in flat for side in (o.over_first, o.over_last)]
            return Finding(f"best by {parameter} {text}; fewer than two have an optimum inside.", tuple(sides))
        slope, _ = move_of_optimum(peaked, lower, least)
        return Finding(f"best by {parameter} {text}; {slope} per unit where there is one.", (slope,))

    return found


def optimum_falls(curves: Any) -> Statistic:
    """The best x falls as a parameter rises.

    curves: (table, metric, labels) -> parameter -> curve of losses.
    """

    def found(table: SeedTable, metric: str, labels: Row) -> Finding | None:
        of: dict[float, Curve] = curves(table, metric, labels)
        if not of or not all(of.values()):
            return None
        best = ", ".join(f"{value:g}: {optimum(curve, True).x:g}" for value, curve in of.items())
        _, move = move_of_optimum(of, lower_is_better=True)
        fall = Interval(-move.mean, -move.high, -move.low, move.count)
        text = f"best by parameter {best}; it falls by {fall}."
        return Finding(text, (fall,))

    return found


def better(mine: Row, other: Row) -> Statistic:
    """``mine`` is better than ``other``, by labels; ``best``: the label of values of which the best is taken, chosen on
    the other half of the seeds. Repeated trainings count with their spread."""

    def found(table: SeedTable, metric: str, labels: Row) -> Finding | None:
        digits = METRICS[metric].digits
        gap, theirs = _better_by(table, metric, labels, mine, other)
        if not gap.count:
            return None
        same = ": it does the very same" if gap.low == gap.high == 0.0 else ""
        base = crossed(theirs).mean
        share = f" ({100.0 * gap.mean / abs(base):+.1f} %)" if metric == "reward" and _far_from_zero(theirs) else ""
        return Finding(
            f"{gap.text(digits)} better{share} over {_counted(table, {**labels, **mine}, gap)}{same}.", (gap,)
        )

    return found


def better_than_all(mine: Row, others: Sequence[Row], worse: bool = False) -> Statistic:
    """``mine`` is better than each of ``others``. worse: each of ``others`` is better than ``mine``."""

    def found(table: SeedTable, metric: str, labels: Row) -> Finding | None:
        digits = METRICS[metric].digits
        gaps: dict[str, Interval] = {}
        for other in others:
            gap, _ = _better_by(table, metric, labels, *((other, mine) if worse else (mine, other)))
            if gap.count:
                gaps[" ".join(str(v) for k, v in other.items() if k != "best")] = gap
        if not gaps:
            return None
        text = ", ".join(f"{name} {gap.text(digits)}" for name, gap in gaps.items())
        counted = _counted(table, {**labels, **mine}, next(iter(gaps.values())))
        return Finding(f"differences: {text} over {counted}.", tuple(gaps.values()))

    return found


def level(mine: Row) -> Statistic:
    """The mean of ``mine``, for claims that it lies above a bound."""

    def found(table: SeedTable, metric: str, labels: Row) -> Finding | None:
        by_seed: dict[int, list[float]] = {}
        for row in table.where(**{**labels, **mine}):
            if row.get(metric) is not None:
                by_seed.setdefault(row["seed"], []).append(row[metric])
        mean = interval([sum(values) / len(values) for values in by_seed.values()])
        return Finding(f"{mean.text(METRICS[metric].digits)} over {mean.count} seeds.", (mean,)) if mean.count else None

    return found


def judge(claims: Sequence[Claim], metrics: Sequence[str], panels: Sequence[str], table: SeedTable) -> list[Verdict]:
    """The verdicts on all claims of a study, corrected for their number: of those that are decided, an expected share
    of ``FALSE_DISCOVERY_RATE`` is wrong (Benjamini-Hochberg); the others are undecided.

    metrics, panels: of the study, see ``Study``. table: its rows.
    """
    found: list[tuple[str, Claim, Finding, float]] = []
    for values in table.distinct(*panels):
        panel = dict(zip(panels, values))
        for claim in claims:
            labels = {**panel, **claim.where}
            if any(panel.get(k, v) != v for k, v in claim.where.items()):
                continue
            for metric in claim.metrics or metrics:
                finding = claim.statistic(table, metric, labels)
                if finding is not None and finding.differences:
                    about = ", ".join([*map(str, dict.fromkeys(labels.values())), METRICS[metric].label])
                    found.append((about, claim, finding, claim.bound_of(metric)))
    p_values = [finding.p_value(bound) for _, _, finding, bound in found]
    tested = [p for p in p_values if p > 0.0]  # the others are without noise, and not a matter of chance
    decided = iter(discoveries(tested))
    kept = [p == 0.0 or next(decided) for p in p_values]
    return [
        Verdict(about, claim.text, finding.text, finding.above(bound) if sure else None)
        for (about, claim, finding, bound), sure in zip(found, kept)
    ]


def _better_by(table: SeedTable, metric: str, labels: Row, mine: Row, other: Row) -> tuple[Interval, list[PerSeed]]:
    """By how much ``mine`` beats ``other``, of no values where one was not measured; and the latter's runs."""
    lower = METRICS[metric].lower
    ours, theirs = (table.best_runs(metric, lower, **{**labels, **of}) for of in (mine, other))
    return difference(theirs, ours) if lower else difference(ours, theirs), theirs


def _counted(table: SeedTable, labels: Row, gap: Interval) -> str:
    """How many trainings, if any, and seeds a difference is of."""
    runs = {row[TRAINING] for row in table.where(**labels) if row.get(TRAINING) is not None}
    trainings = f"{len(runs)} trainings and " if len(runs) > 1 else "one training and " if runs else ""
    return f"{trainings}{gap.count} seeds"


def _less(of: Interval, amount: float) -> Interval:
    return dataclasses.replace(of, mean=of.mean - amount, low=of.low - amount, high=of.high - amount)


def _gain(a: PerSeed, b: Any, lower: bool) -> Interval:
    """a - b, seed by seed, positive where a is better."""
    return paired(b, a) if lower else paired(a, b)


def _far_from_zero(runs: Sequence[PerSeed]) -> bool:
    base = crossed(runs)
    return base.low > 0.0 or base.high < 0.0
