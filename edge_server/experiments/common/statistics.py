"""Means, intervals and optima over seeds: the seed is the unit that repeats, so all intervals are over seeds.

Nothing here knows what a study is about. Everything random is drawn from a fixed stream: the same figures
give the same intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

_LEVEL = 0.95
_RESAMPLES = 2000
# Resampling fewer seeds than this tells nothing of how seeds differ: no interval is given.
FEWEST = 5


@dataclass(frozen=True)
class Interval:
    """A mean with the ends of its 95 % interval; the ends are NaN where one value cannot give them."""

    mean: float
    low: float
    high: float
    count: int

    def __str__(self) -> str:
        if self.count < 2:
            return f"{self.mean:.2f}"
        return f"{self.mean:.2f} [{self.low:.2f}, {self.high:.2f}]"

    @property
    def half(self) -> float:
        return (self.high - self.low) / 2

    def above(self, bound: float) -> bool | None:
        """Whether the mean lies above ``bound``; None: the interval does not tell."""
        if self.low > bound:
            return True
        return False if self.high < bound else None


def interval(values: Sequence[float | None]) -> Interval:
    """Student's t interval of the mean, over the values that there are."""
    known = np.array([v for v in values if v is not None], float)
    if not len(known):
        return Interval(np.nan, np.nan, np.nan, 0)
    mean = float(known.mean())
    if len(known) < 2:
        return Interval(mean, np.nan, np.nan, len(known))
    half = float(stats.t.ppf(0.5 + _LEVEL / 2, len(known) - 1) * known.std(ddof=1) / np.sqrt(len(known)))
    return Interval(mean, mean - half, mean + half, len(known))


def negated(answer: bool | None) -> bool | None:
    """Not; what cannot be told stays so."""
    return None if answer is None else not answer


def paired(a: Mapping[int, float | None], b: Mapping[int, float | None]) -> Interval:
    """Of a - b over the seeds that have both."""
    return interval([x - y for s in a if (x := a[s]) is not None and (y := b.get(s)) is not None])


def crossed(runs: Sequence[Mapping[int, float | None]]) -> Interval:
    """Of what ``runs`` of the same training come to on the same seeds, over runs and seeds: another training
    would have learnt something else, and other seeds would have asked for something else.

    Runs x seeds is a two-way table of random effects. The interval adds the squares of two halves (MOVER):
    that of the seeds, and that of what the runs' means differ more than the table's rest explains, each with
    its own Student's t; simulated with three runs on 60 seeds it covers 93 to 97 %, however large the runs'
    share is. Resampling would not do: three runs can be resampled in ten ways. Of a single run it is the
    seeds' alone.
    Seeds that lack a value in any run are left out; count: those that are not.
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
    both = t_runs**2 * max(of_runs - of_rest, 0.0) + t_seeds**2 * of_seeds
    half = float(np.sqrt(both / (count * width)))
    return Interval(mean, mean - half, mean + half, width)


@dataclass(frozen=True)
class Optimum:
    """Where a curve over ``xs`` is best, over seeds.

    x: of the best mean. low, high: 95 % of resampled seeds have their best there (NaN for fewer than
    ``FEWEST``). over_first, over_last: how
    much better the best is than the curve's two ends. They are measured on seeds that had no part in choosing
    the best (chosen on one half, measured on the other, and the other way round): a best point chosen and
    measured on the same seeds looks better than it is.
    """

    x: float
    low: float
    high: float
    over_first: Interval
    over_last: Interval

    @property
    def spread(self) -> str:
        """`` (low to high)``, or nothing where it is not known."""
        return "" if np.isnan(self.low) else f" ({self.low:g} to {self.high:g})"

    def interior(self, least: float = 0.0) -> bool | None:
        """Whether the curve rises and falls by more than ``least``; None: the seeds do not tell."""
        sides = (self.over_first.above(least), self.over_last.above(least))
        if False in sides:
            return False
        return None if None in sides else True


def optimum(curve: Mapping[float, Mapping[int, float | None]], lower_is_better: bool = False) -> Optimum:
    """``curve``: x -> seed -> value. Seeds that lack a value anywhere are left out. ValueError: none left."""
    xs = sorted(curve)
    common = set.intersection(*(set(curve[x]) for x in xs))
    seeds = sorted(s for s in common if all(curve[x][s] is not None for x in xs))
    if not seeds:
        raise ValueError("no seed has a value at every point of the curve")
    table = np.array([[curve[x][s] for x in xs] for s in seeds], float)  # (seeds, xs)
    if lower_is_better:
        table = -table
    low, high = np.nan, np.nan
    if len(seeds) >= FEWEST:
        bests = np.array(xs)[table[_picks(len(seeds))].mean(1).argmax(1)]
        low, high = np.percentile(bests, [2.5, 97.5], method="nearest")
    gains = _held_out_gains(table)
    return Optimum(
        float(xs[int(table.mean(0).argmax())]), float(low), float(high),
        interval(list(gains[:, 0])), interval(list(gains[:, 1])),
    )  # fmt: skip


def _picks(count: int) -> NDArray[np.int64]:
    """The same resamples for every figure of so many seeds: (R, count) indices."""
    return np.random.default_rng(5).integers(0, count, (_RESAMPLES, count))


def _held_out_gains(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of each seed (S, 2): the best minus the first and minus the last, the best as the others chose."""
    chosen = _chosen(table)
    return np.stack([chosen - table[:, 0], chosen - table[:, -1]], 1)


def _chosen(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each seed's value (S,) at the point that is best for the other half of the seeds."""
    if len(table) < 2:
        return table[:, table.mean(0).argmax()]
    halves = np.arange(len(table)) % 2
    found = np.empty(len(table))
    for half in (0, 1):
        found[halves == half] = table[halves == half, table[halves != half].mean(0).argmax()]
    return found


def at_its_best(
    curve: Mapping[float, Mapping[int, float | None]], lower_is_better: bool = False
) -> dict[int, float]:
    """seed -> the curve's value where it is best, chosen by seeds that it is not measured on."""
    xs = sorted(curve)
    common = set.intersection(*(set(curve[x]) for x in xs)) if xs else set()
    seeds = sorted(s for s in common if all(curve[x][s] is not None for x in xs))
    if not seeds:
        return {}
    sign = -1.0 if lower_is_better else 1.0
    values = sign * _chosen(sign * np.array([[curve[x][s] for x in xs] for s in seeds], float))
    return dict(zip(seeds, values.tolist()))


def move_of_optimum(
    curves: Mapping[float, Mapping[float, Mapping[int, float | None]]], lower_is_better: bool = False
) -> tuple[Interval, Interval]:
    """How a curve's best x moves with a parameter: parameter -> x -> seed -> value. Returns the slope of best
    x against the parameter, and best x at the last parameter minus that at the first; both by resampling
    seeds, the same ones for every parameter. Ends are NaN for fewer than ``FEWEST`` seeds."""
    sign = -1.0 if lower_is_better else 1.0
    parameters, tables, grids = list(curves), [], []
    common = set.intersection(*(set(v) for curve in curves.values() for v in curve.values()))
    seeds = sorted(s for s in common if all(v[s] is not None for c in curves.values() for v in c.values()))
    for curve in curves.values():
        xs = sorted(curve)
        grids.append(np.array(xs))
        tables.append(sign * np.array([[curve[x][s] for x in xs] for s in seeds], float))

    def text(picks: NDArray[np.int64]) -> tuple[float, float]:
        best = [grid[table[picks].mean(0).argmax()] for grid, table in zip(grids, tables)]
        # A level line has a slope of 1e-16 or so, of either sign.
        line = round(float(np.polyfit(parameters, best, 1)[0]), 9) if len(parameters) > 1 else np.nan
        return line, float(best[-1] - best[0])

    if not seeds:
        nothing = Interval(np.nan, np.nan, np.nan, 0)
        return nothing, nothing
    means = text(np.arange(len(seeds)))
    lows = highs = np.full(2, np.nan)
    if len(seeds) >= FEWEST:
        lows, highs = np.percentile([text(p) for p in _picks(len(seeds))], [2.5, 97.5], axis=0)
    line, move = (Interval(m, float(a), float(b), len(seeds)) for m, a, b in zip(means, lows, highs))
    return line, move


def share_closed(
    policy: Mapping[int, float | None], base: Mapping[int, float | None], limit: Mapping[int, float | None]
) -> Interval:
    """(policy - base) / (limit - base): the share of the way from ``base`` to ``limit``, a ratio of means
    over the seeds that have all three; its interval by resampling seeds. NaN where the limit is no better."""
    rows = [
        (p, b, n) for s in policy
        if (p := policy[s]) is not None and (b := base.get(s)) is not None and (n := limit.get(s)) is not None
    ]  # fmt: skip
    if not rows:
        return Interval(np.nan, np.nan, np.nan, 0)
    table = np.array(rows, float)
    gap = table[:, 2].mean() - table[:, 1].mean()
    if gap <= 0:
        return Interval(np.nan, np.nan, np.nan, len(rows))
    share = float((table[:, 0].mean() - table[:, 1].mean()) / gap)
    if len(rows) < FEWEST:
        return Interval(share, np.nan, np.nan, len(rows))
    means = table[_picks(len(rows))].mean(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = (means[:, 0] - means[:, 1]) / (means[:, 2] - means[:, 1])
    low, high = np.nanpercentile(shares, [2.5, 97.5])
    return Interval(share, float(low), float(high), len(rows))
