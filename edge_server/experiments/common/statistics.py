"""Means, intervals and optima over seeds.

Resampling draws from a fixed random stream, so the same values give the same intervals.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common.tables import number

_LEVEL = 0.95
_Curve = Mapping[float, Mapping[int, float | None]]


@dataclass(frozen=True)
class Interval:
    """A mean with the ends of its 95 % interval, which are NaN for a single value.

    count: number of values.
    degrees: degrees of freedom of its Student's t; None: ``count`` - 1.
    """

    mean: float
    low: float
    high: float
    count: int
    degrees: float | None = None

    def __str__(self) -> str:
        return self.text(2)

    def text(self, digits: int) -> str:
        """``mean [low, high]`` with so many decimals; of a single value the mean alone."""
        mean, low, high = (number(v, digits) for v in (self.mean, self.low, self.high))
        return mean if np.isnan(self.low) else f"{mean} [{low}, {high}]"

    def rounded(self, digits: int) -> list[float | None]:
        """Mean, low and high as JSON values, None for NaN and infinity."""
        return [round(v, digits) if np.isfinite(v) else None for v in (self.mean, self.low, self.high)]

    def above(self, bound: float) -> bool | None:
        """Whether the mean lies above ``bound``; None where the interval contains it. What is always at the bound
        itself is not above it."""
        if self.low > bound:
            return True
        return False if self.high < bound or self.low == self.high == bound else None

    def p_value(self, bound: float) -> float:
        """Two-sided p-value of the hypothesis that the mean is ``bound``: below 0.05 if and only if the interval does
        not contain it. 1 where the interval is not known. Of an interval by resampling it is an approximation, from
        the half width on the side of the bound."""
        half = self.mean - self.low if bound < self.mean else self.high - self.mean
        if not np.isfinite(half):
            return 1.0
        if half <= 0.0:  # all values are the same
            return 0.0
        degrees = self.degrees or max(self.count - 1, 1)
        deviations = abs(self.mean - bound) / half * float(stats.t.ppf(0.5 + _LEVEL / 2, degrees))
        return float(2.0 * stats.t.sf(deviations, degrees))


def discoveries(p_values: Sequence[float], rate: float = tuned.FALSE_DISCOVERY_RATE) -> list[bool]:
    """Which of several hypotheses are rejected at a false discovery rate (Benjamini-Hochberg).

    p_values: of all hypotheses that are tested together.
    """
    return (stats.false_discovery_control(p_values) <= rate).tolist() if len(p_values) else []


def interval(values: Iterable[float | None]) -> Interval:
    """Student's t interval of the mean of the known values."""
    known = np.array([v for v in values if v is not None], float)
    if not len(known):
        return Interval(np.nan, np.nan, np.nan, 0)
    mean = float(known.mean())
    if len(known) < 2:
        return Interval(mean, np.nan, np.nan, len(known))
    half = float(stats.t.ppf(0.5 + _LEVEL / 2, len(known) - 1) * known.std(ddof=1) / np.sqrt(len(known)))
    return Interval(mean, mean - half, mean + half, len(known))


def all_of(answers: Iterable[bool | None]) -> bool | None:
    """Whether every answer is yes: a single no decides, otherwise one unknown (None) leaves it unknown."""
    found = list(answers)
    return False if False in found else None if None in found else True


def paired(a: Mapping[int, float | None], b: Mapping[int, float | None]) -> Interval:
    """Interval of a - b over the seeds that have both."""
    return interval([x - y for s in a if (x := a[s]) is not None and (y := b.get(s)) is not None])


def crossed(runs: Sequence[Mapping[int, float | None]]) -> Interval:
    """Interval of repeated trainings on the same seeds, over runs and seeds.

    Runs x seeds is a two-way table of random effects. The half width is the root of the sum of two squares
    (MOVER): the half width over seeds, and that over runs, of which half of the residual variance is subtracted, each
    with its own Student's t. Simulated with three runs it covers 93.8 to 98 %; with all of the residual variance
    subtracted 91 to 97. Resampling would not do: three runs can be resampled in ten ways only.

    runs: seed -> value of each run; a single run gives the interval over seeds. Seeds without a value in any
        run are left out; ``count`` is the number of the others.
    """
    if not runs:
        return interval([])
    seeds = [s for s in runs[0] if all(run.get(s) is not None for run in runs)]
    if len(runs) == 1 or len(seeds) < 2:
        return interval([sum(v for run in runs if (v := run[s]) is not None) / len(runs) for s in seeds])
    table = np.array([[run[s] for s in seeds] for run in runs], float)  # (runs, seeds)
    count, width = table.shape
    mean, by_run, by_seed = float(table.mean()), table.mean(axis=1), table.mean(axis=0)
    rest = table - by_run[:, None] - by_seed + mean
    degrees = (count - 1, width - 1, (count - 1) * (width - 1))
    of_runs = width * float(((by_run - mean) ** 2).sum()) / degrees[0]
    of_seeds = count * float(((by_seed - mean) ** 2).sum()) / degrees[1]
    of_rest = float((rest**2).sum()) / degrees[2]
    t_runs, t_seeds = (float(stats.t.ppf(0.5 + _LEVEL / 2, d)) for d in degrees[:2])
    parts = max(of_runs - 0.5 * of_rest, 0.0), of_seeds
    half = float(np.sqrt((t_runs**2 * parts[0] + t_seeds**2 * parts[1]) / (count * width)))
    weights = sum(part**2 / d for part, d in zip(parts, degrees))
    freedom = sum(parts) ** 2 / weights if weights > 0.0 else float(width - 1)  # Satterthwaite
    return Interval(mean, mean - half, mean + half, width, freedom)


@dataclass(frozen=True)
class Optimum:
    """The optimum of a curve over seeds.

    x: where the mean is best; the smallest x where it is within the least difference of the best.
    low, high: ends of the 95 % interval of x by resampling seeds; NaN for fewer than ``FEWEST_SEEDS``.
    over_first, over_last: how much better the best point between them is than the two ends of the curve. Chosen on
        one half of the seeds and measured on the other, and the other way round, because a maximum is biased upwards
        on the seeds that chose it. An end is never chosen: less itself it would be 0 for certain.
    """

    x: float
    low: float
    high: float
    over_first: Interval
    over_last: Interval

    @property
    def spread(self) -> str:
        """`` (low to high)``, or nothing where they are unknown."""
        return "" if np.isnan(self.low) else f" ({self.low:g} to {self.high:g})"

    def interior(self, least: float = 0.0) -> bool | None:
        """Whether the curve rises and falls by more than ``least``; None where that is undecided."""
        return all_of(side.above(least) for side in (self.over_first, self.over_last))


def optimum(curve: _Curve, lower_is_better: bool = False, least: float = 0.0) -> Optimum:
    """The optimum of a curve.

    curve: x -> seed -> value; seeds that lack a value at any x are left out.
    least: smallest difference that counts: a curve that saturates is best where it is first this near to its top.
    If no seed is left, everything is NaN.
    """
    xs = sorted(curve)
    seeds = _common_seeds([curve])
    if not seeds:
        return Optimum(np.nan, np.nan, np.nan, interval([]), interval([]))
    table = _table(curve, seeds, lower_is_better)
    low, high = np.nan, np.nan
    if len(seeds) >= tuned.FEWEST_SEEDS:
        bests = np.array(xs)[_first_best(table[_picks(len(seeds))].mean(1), least)]
        low, high = np.percentile(bests, [2.5, 97.5], method="nearest")
    inner = table[:, 1:-1] if len(xs) > 2 else table
    over_first, over_last = (interval(_chosen(inner) - table[:, end]) for end in (0, -1))
    return Optimum(float(xs[int(_first_best(table.mean(0), least))]), float(low), float(high), over_first, over_last)


def _first_best(means: NDArray[np.float64], least: float) -> NDArray[np.int64]:
    """Index of the first value on the last axis that is within ``least`` of the highest."""
    return np.asarray((means >= means.max(axis=-1, keepdims=True) - least).argmax(axis=-1), np.int64)


def _common_seeds(curves: Sequence[_Curve]) -> list[int]:
    """Seeds that have a value at every point of all curves."""
    points = [values for curve in curves for values in curve.values()]
    common = set.intersection(*map(set, points)) if points else set()
    return sorted(s for s in common if all(values[s] is not None for values in points))


def _table(curve: _Curve, seeds: Sequence[int], lower_is_better: bool) -> NDArray[np.float64]:
    """Values (seeds, xs) of a curve, negated where lower is better."""
    table = np.array([[curve[x][s] for x in sorted(curve)] for s in seeds], float)
    return -table if lower_is_better else table


def _picks(count: int) -> NDArray[np.int64]:
    """Indices (resamples, count) of resampled seeds, always the same for one count."""
    return np.random.default_rng(5).integers(0, count, (tuned.RESAMPLES, count))


def _chosen(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each seed's value (S,) at the point that is best for the other half of the seeds."""
    if len(table) < 2:
        return table[:, table.mean(0).argmax()]
    halves = np.arange(len(table)) % 2
    found = np.empty(len(table))
    for half in (0, 1):
        found[halves == half] = table[halves == half, table[halves != half].mean(0).argmax()]
    return found


def at_its_best(curve: _Curve, lower_is_better: bool = False) -> dict[int, float]:
    """seed -> value of the curve at its best x, which is chosen on the other half of the seeds."""
    seeds = _common_seeds([curve])
    if not seeds:
        return {}
    values = _chosen(_table(curve, seeds, lower_is_better))
    return dict(zip(seeds, (-values if lower_is_better else values).tolist()))


def move_of_optimum(
    curves: Mapping[float, _Curve], lower_is_better: bool = False, least: float = 0.0
) -> tuple[Interval, Interval]:
    """How the best x of a curve moves with a parameter.

    curves: parameter -> x -> seed -> value.
    least: as in ``optimum``.

    Returns the slope of the best x against the parameter, and the best x at the last parameter minus that at
    the first. Intervals by resampling seeds, the same ones for every parameter; their ends are NaN for fewer
    than ``FEWEST_SEEDS`` seeds.
    """
    parameters = list(curves)
    seeds = _common_seeds(list(curves.values()))
    grids = [np.array(sorted(curve)) for curve in curves.values()]
    tables = [_table(curve, seeds, lower_is_better) for curve in curves.values()]

    if not seeds:
        nothing = Interval(np.nan, np.nan, np.nan, 0)
        return nothing, nothing
    picks = np.concatenate([np.arange(len(seeds))[None], _picks(len(seeds))])  # the seeds themselves, then resampled
    best = np.stack([grid[_first_best(table[picks].mean(1), least)] for grid, table in zip(grids, tables)], axis=1)
    away = np.array(parameters, float) - np.mean(parameters)
    slope = best @ away / (away @ away) if len(parameters) > 1 else np.full(len(best), np.nan)
    # Rounded, because a level line has a slope of 1e-16 or so of either sign.
    found = np.stack([np.round(slope, 9), best[:, -1] - best[:, 0]], axis=1)
    enough = len(seeds) >= tuned.FEWEST_SEEDS
    lows, highs = np.percentile(found[1:], [2.5, 97.5], axis=0) if enough else np.full((2, 2), np.nan)
    line, move = (Interval(float(m), float(a), float(b), len(seeds)) for m, a, b in zip(found[0], lows, highs))
    return line, move
