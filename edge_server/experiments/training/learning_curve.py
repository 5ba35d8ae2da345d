"""The learning curve of a training as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.experiments.experiment_constants import SMOOTHED_BATCHES
from edge_server.matplotlib_figures import CYCLE, figure, label_lines


def draw_curve(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Draw the learning curve (figures 5.9, 6.8) and the terms of the reward.

    path: the PNG file.
    rows: rows of the log, one per batch.
    """
    terms = [name for name in rows[0] if name.startswith("term_")]
    episodes = [row["episodes"] for row in rows]
    with figure(path, 2, height_inch=2.6, sharex=True) as (_, axes):
        top, bottom = axes[:, 0]
        rewards = _numbers(rows, "reward")
        top.plot(episodes, rewards, color=CYCLE[0], alpha=0.3, linewidth=0.9)
        top.plot(episodes, smoothed(rewards), color=CYCLE[0], label="reward in training")
        label_lines(top, "reward", None, "Learning, explored actions included")
        for k, term in enumerate(terms):
            values = smoothed(_numbers(rows, term))
            # The zero of a term is arbitrary; its change can be compared.
            bottom.plot(episodes, values - values[:1], color=CYCLE[k], label=term.removeprefix("term_"))
        label_lines(bottom, "terms of the reward,\nchange since the start", "episodes")


def smoothed(values: np.ndarray, count: int = SMOOTHED_BATCHES) -> np.ndarray:
    """Moving average over the last ``count`` values, fewer at the beginning, without NaN."""
    parts = [values[max(0, i + 1 - count) : i + 1] for i in range(len(values))]
    return np.array([np.nan if np.isnan(p).all() else np.nanmean(p) for p in parts])


def _numbers(rows: Sequence[dict[str, Any]], name: str) -> np.ndarray:
    return np.array([np.nan if row.get(name) is None else row[name] for row in rows], float)
