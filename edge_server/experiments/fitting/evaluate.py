"""Fits a field in slices of time, scores it after each, and ends early after Ctrl-C."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from edge_server.experiments.fitting import ctrl_c
from edge_server.fidelity.scorer import Score
from edge_server.fields import Budget, Field, FitReport, View

# Dense while a field learns fastest, then every 30 s.
_MARKS_S = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0)
_THEN_EVERY_S = 30.0
# The last slice is at least this share of the whole: the learning rate falls within a slice, and a field
# needs a long one to converge.
_LAST_SHARE = 0.4


@dataclass(frozen=True)
class Scored:
    """Fidelity after ``seconds`` of fitting (evaluation not counted) and ``steps`` optimizer steps; steps and
    loss are None if the slice was interrupted. slice_s: duration of the last slice."""

    seconds: float
    slice_s: float
    steps: int | None
    loss: float | None
    score: Score


def marks_s(total_s: float) -> list[float]:
    """Seconds of fitting after which to evaluate, the last being ``total_s``."""
    later = np.arange(_MARKS_S[-1] + _THEN_EVERY_S, total_s, _THEN_EVERY_S)
    return [m for m in (*_MARKS_S, *map(float, later)) if m <= (1.0 - _LAST_SHARE) * total_s] + [total_s]


def fit_in_slices(
    field: Field,
    training: Sequence[View],
    score: Callable[[], Score],
    until_s: Sequence[float],
    on_scored: Callable[[Scored], None],
    spent_s: float = 0.0,
    spent_steps: int = 0,
) -> bool:
    """Fit until each of ``until_s`` in turn, and score. Returns False if Ctrl-C ended it early, also after
    scoring.

    until_s: seconds of fitting, without evaluation.
    spent_s, spent_steps: seconds and steps of an earlier run.
    """
    seconds, steps = spent_s, spent_steps
    for mark in until_s:
        if mark - seconds < 0.05:
            continue
        began = time.perf_counter()
        report: FitReport | None = None
        # After an interruption the parameters are those of the last step and can be scored and saved.
        with ctrl_c.noted() as pressed, suppress(KeyboardInterrupt):
            report = field.fit(training, Budget(seconds=mark - seconds))
        slice_s = time.perf_counter() - began
        seconds += slice_s
        steps += report.steps if report else 0
        on_scored(Scored(seconds, slice_s, steps if report else None, report.loss if report else None, score()))
        if report is None or pressed.is_set():
            return False
    return True
