"""Rows of results, one for each seed of a point, and what is asked of them: values, curves and runs by labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from edge_server.experiments.common.statistics import Interval, at_its_best, crossed, interval

Row = dict[str, Any]
PerSeed = dict[int, float | None]
Curve = dict[float, PerSeed]
# The label of repeated trainings, which differ only in their random seed.
TRAINING = "training"


@dataclass
class SeedTable:
    """Rows with labels, a ``seed`` and values, in the order of the points."""

    rows: Sequence[Row]

    def where(self, **labels: Any) -> list[Row]:
        """Rows that carry all the given labels."""
        return [row for row in self.rows if all(row.get(k) == v for k, v in labels.items())]

    def values(self, metric: str, **labels: Any) -> PerSeed:
        """seed -> value of the point with these labels."""
        return {row["seed"]: row.get(metric) for row in self.where(**labels)}

    def mean_text(self, metric: str, digits: int, **labels: Any) -> str:
        """The mean of ``values`` with its interval, for tables."""
        return interval(self.values(metric, **labels).values()).text(digits)

    def curve(self, x: str, metric: str, **labels: Any) -> Curve:
        """x -> seed -> value, for the points that have an x and at least one value."""
        found: Curve = {}
        for row in self.where(**labels):
            if row.get(x) is not None:
                found.setdefault(float(row[x]), {})[row["seed"]] = row.get(metric)
        return {k: v for k, v in sorted(found.items()) if any(y is not None for y in v.values())}

    def runs(self, metric: str, **labels: Any) -> list[PerSeed]:
        """seed -> value of each repeated training of the points with these labels, or of the one point."""
        found: dict[Any, PerSeed] = {}
        for row in self.where(**labels):
            found.setdefault(row.get(TRAINING), {})[row["seed"]] = row.get(metric)
        return list(found.values())

    def best_runs(self, metric: str, lower_is_better: bool, best: str | None = None, **labels: Any) -> list[PerSeed]:
        """As ``runs``; with ``best``, a label of values tried, the value that is best on the other half of the
        seeds."""
        if best is None:
            return self.runs(metric, **labels)
        found = at_its_best(self.curve(best, metric, **labels), lower_is_better)
        return [dict(found)] if found else []

    def distinct(self, *labels: str) -> list[tuple[Any, ...]]:
        """The combinations of the labels' values, in order of appearance, of rows that have all of them."""
        known = [tuple(row.get(label) for label in labels) for row in self.rows]
        return list(dict.fromkeys(values for values in known if None not in values))


def difference(mine: Sequence[Mapping[int, float | None]], other: Sequence[Mapping[int, float | None]]) -> Interval:
    """Interval of mine - other over seeds and repeated trainings: run r of one is paired with run r of the other,
    which was trained on the same episodes; a single run with each of the other's."""
    count = max(len(mine), len(other)) if mine and other else 0
    ours, theirs = (list(runs) * count if len(runs) == 1 else list(runs) for runs in (mine, other))
    return crossed(
        [
            {s: None if (x := a[s]) is None or (y := b.get(s)) is None else x - y for s in a}
            for a, b in zip(ours[:count], theirs[:count])
        ]
    )
