"""Tests whether the ages at a decision predict its best omega.

In hindsight, which knows what arrives later, the best omega differs between decisions. A rule fitted to the
rewards of all values at every decision shows the gain that is possible with the ages alone. If there is none,
a learner cannot do better than the best fixed value.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.common.statistics import Interval, interval
from edge_server.experiments.training.scheduler.episode import DecisionPoint
from edge_server.experiments.training.scheduler.evaluation import Evaluation

# Percentiles of the cameras' ages that the rule uses.
_QUANTILES = (0, 10, 25, 50, 75, 90, 100)
_SCALE_MS = 100.0
_RIDGE = 30.0


def by_ages(evaluation: Evaluation, kind: str, moments: Sequence[DecisionPoint]) -> Interval:
    """Reward of a rule that chooses the value of ``kind`` (wait, threshold) by the ages, minus that of the
    best fixed value, paired over seeds. Both are fitted to all seeds except the one that they are measured
    on, with the rewards of all values at every decision."""
    names = [name for name in evaluation.outcomes if name.startswith(f"{kind}:")]
    values = {name: evaluation.decisions(name) for name in names}
    known = [
        m
        for m in moments
        if m.state.reported.any() and all(values[n].get((m.seed, m.number)) is not None for n in names)
    ]
    if not known:
        return interval([])
    rewards = np.array([[values[n][m.seed, m.number] for n in names] for m in known], float)
    features, seeds = _features(known), np.array([m.seed for m in known])
    found: list[float | None] = []
    for seed in np.unique(seeds) if len(np.unique(seeds)) > 1 else ():
        here = seeds == seed
        chosen = _rule(features[~here], rewards[~here], features[here])
        fixed = int(rewards[~here].mean(axis=0).argmax())
        mine = rewards[here]
        found.append(float((mine[np.arange(len(mine)), chosen] - mine[:, fixed]).mean()))
    return interval(found)


def _features(moments: Sequence[DecisionPoint]) -> NDArray[np.float64]:
    """(n, features): standardized quantiles of the logarithms of a decision's ages, their squares, and 1."""
    ages = [np.maximum(m.state.ages_ms[m.state.reported], 0.0) for m in moments]
    x = np.array([np.percentile(np.log1p(a / _SCALE_MS), _QUANTILES) for a in ages])
    x = (x - x.mean(axis=0)) / np.maximum(x.std(axis=0), 1e-6)
    return np.hstack([x, x**2, np.ones((len(x), 1))])


def _rule(x: NDArray[np.float64], rewards: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.int64]:
    """Index of the value with the highest predicted reward at each row of ``at``, by ridge regression of the
    rewards relative to their mean."""
    better = rewards - rewards.mean(axis=1, keepdims=True)
    usual = better.mean(axis=0)
    weights = np.linalg.solve(x.T @ x + _RIDGE * np.eye(x.shape[1]), x.T @ (better - usual))
    return np.asarray((at @ weights + usual).argmax(axis=1), np.int64)
