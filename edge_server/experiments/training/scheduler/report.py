"""Reports of a training: its learning curve, and its evaluation against all other policies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.experiments.common.statistics import interval, paired
from edge_server.experiments.training.scheduler.evaluation import HINDSIGHT, Evaluation, PerSeed
from edge_server.report.style import CYCLE, GRAY, figure, label_lines

# Number of batches averaged in a point of the smoothed curve.
_SMOOTH = 9


def draw_curve(path: Path, rows: Sequence[dict[str, Any]], levels: dict[str, float] | None = None) -> None:
    """Draw the learning curve (figures 5.9, 6.8) and the terms of the reward.

    path: the PNG file.
    rows: rows of the log, one per batch.
    levels: label -> reward of a policy without learning, on the test seeds.
    """
    terms = [name for name in rows[0] if name.startswith("term_")]
    episodes = [row["episodes"] for row in rows]
    with figure(path, 2, height_inch=2.6, sharex=True) as (_, axes):
        top, bottom = axes[:, 0]
        rewards = _numbers(rows, "reward")
        top.plot(episodes, rewards, color=CYCLE[0], alpha=0.3, linewidth=0.9)
        top.plot(episodes, smoothed(rewards), color=CYCLE[0], label="reward in training")
        for k, (label, level) in enumerate((levels or {}).items()):
            top.axhline(level, color=GRAY, linestyle=(":", "--", "-.")[k % 3], linewidth=1.1, label=label)
        label_lines(top, "reward", None, "Learning, explored actions included")
        for k, term in enumerate(terms):
            values = smoothed(_numbers(rows, term))
            # The zero of a term is arbitrary; its change can be compared.
            bottom.plot(episodes, values - values[:1], color=CYCLE[k], label=term.removeprefix("term_"))
        label_lines(bottom, "terms of the reward,\nchange since the start", "episodes")


def smoothed(values: np.ndarray, count: int = _SMOOTH) -> np.ndarray:
    """Moving average over the last ``count`` values, fewer at the beginning, without NaN."""
    parts = [values[max(0, i + 1 - count) : i + 1] for i in range(len(values))]
    return np.array([np.nan if np.isnan(p).all() else np.nanmean(p) for p in parts])


def summary(evaluation: Evaluation, trained: str, fixed: str) -> dict[str, Any]:
    """Results of an evaluation for JSON: rewards, paired differences and shares, each as mean and ends of the
    95 % interval over seeds.

    trained: name of the trained policy.
    fixed: kind of the baseline, threshold or wait, of which the best value is compared.
    """
    mine = evaluation.rewards(trained)
    best, name = evaluation.best_fixed(fixed)
    best_values = evaluation.best_values(fixed)
    return {
        "seeds": evaluation.seeds(trained)[1],
        "seeds_without_value": evaluation.seeds(trained)[0] - evaluation.seeds(trained)[1],
        "reward": interval(mine.values()).rounded(6),
        "rewards": {n: interval(evaluation.rewards(n).values()).rounded(6) for n in (*evaluation.outcomes, HINDSIGHT)},
        "over_random": paired(mine, evaluation.rewards("random")).rounded(6),
        "over_best_fixed": paired(mine, best).rounded(6),
        "best_fixed": name,
        "share": evaluation.share(mine).rounded(6),
        "best_fixed_share": evaluation.share(best).rounded(6),
        "best_value_by_decision": best_values["quartiles"],
        "knowing_it_is_worth": best_values["gain"].rounded(6),
    }


def lines(evaluation: Evaluation, trained: str, fixed: str) -> list[str]:
    """``summary`` as lines of text."""
    mine, random = evaluation.rewards(trained), evaluation.rewards("random")
    best, name = evaluation.best_fixed(fixed)
    best_values = evaluation.best_values(fixed)
    drawn, known = evaluation.seeds(trained)
    lacking = "" if known == drawn else f"; {drawn - known} more have a decision without a reward"
    return [
        f"reward {interval(mine.values()).text(4)} on {known} unseen seeds{lacking}",
        f"over random {paired(mine, random).text(4)}, over the best fixed {fixed} ({name}) "
        f"{paired(mine, best).text(4)}",
        f"share of what could be won: {evaluation.share(mine).text(2)}; the best fixed {fixed} has "
        f"{evaluation.share(best).text(2)}",
        f"the best {fixed} of a decision is {quartiles(best_values)}; to know it would be worth "
        f"{best_values['gain'].text(4)} over the best fixed one",
    ]


def quartiles(best_values: dict[str, Any]) -> str:
    """The quartiles of ``Evaluation.best_values`` as text."""
    low, middle, high = best_values["quartiles"]
    return "not known" if middle is None else f"{middle:g} ms (quartiles {low:g} to {high:g})"


def percent(values: PerSeed, base: PerSeed) -> str:
    """Gain in mean reward over ``base`` in percent of its absolute value, as in the thesis. The text says
    that there is no percentage if the arbitrary zero of the reward is near ``base`` or between the two."""
    a, b = interval(values.values()), interval(base.values())
    if not (b.mean * a.mean > 0.0 and (b.low > 0.0 or b.high < 0.0)):
        return f"no percentage ({a.mean:.4f} against {b.mean:.4f}, near zero or of other signs)"
    return f"{100.0 * (a.mean - b.mean) / abs(b.mean):+.1f} %"


def _numbers(rows: Sequence[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([np.nan if row.get(name) is None else row[name] for row in rows], float)
