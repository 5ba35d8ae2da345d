"""Budgets in seconds, by clocks that show work done: what is promised is kept, however busy the machine."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.common.training_schedule import StepBudget, StepTimer
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small import CLASSES, SMALL, every_field


class Fits:
    """Fits on a clock of its own. step_s: what a step takes; usual: what is known of it."""

    def __init__(self) -> None:
        self.clock_s, self.step_s, self.usual = 0.0, 1.0, StepTimer()

    def fit(self, budget_s: float, first_s: float = 0.0) -> tuple[int, float]:
        """first_s: taken before the first step. Returns steps and seconds."""
        pace = StepBudget(Budget(seconds=budget_s), lambda: self.clock_s)
        self.clock_s += first_s
        while (progress := pace.begin_step(self.usual)) is not None:
            assert 0.0 <= progress <= 1.0
            self.clock_s += self.step_s
            pace.end_step()
        return pace.steps, pace.elapsed_s()


@pytest.mark.parametrize("first_s", [0.0, 0.7])
def test_a_budget_is_used_up_and_never_exceeded_once_a_step_is_known(first_s: float) -> None:
    fits = Fits()
    fits.fit(5.0)
    for budget_s in np.arange(1.75, 6.0, 0.25):
        steps, seconds = fits.fit(budget_s, first_s)
        assert steps >= 1 and budget_s - fits.step_s < seconds <= budget_s
    assert fits.fit(0.95, 0.1) == (0, pytest.approx(0.1))


def test_one_hiccup_changes_nothing_and_load_that_stays_is_known_after_three_steps() -> None:
    fits = Fits()
    fits.fit(8.0)
    # A single step may be a tenth late, but no second one.
    assert fits.fit(0.92) == (1, 1.0) and fits.fit(1.95) == (1, 1.0) and fits.fit(0.9) == (0, 0.0)
    fits.step_s = 40.0
    assert fits.fit(8.0) == (1, 40.0)
    fits.step_s = 1.0
    assert [fits.fit(8.0) for _ in range(3)] == [(8, 8.0)] * 3
    fits.step_s = 3.0
    assert fits.fit(8.0) == (3, 9.0)
    assert [fits.fit(8.0) for _ in range(3)] == [(2, 6.0)] * 3


def test_fits_too_short_for_a_step_make_one_now_and_then() -> None:
    """None at all, and the field would never learn again, nor that the load is gone."""
    fits = Fits()
    fits.fit(8.0)
    made = [fits.fit(0.5)[0] for _ in range(40)]
    assert set(made) == {0, 1} and 10 <= sum(made) <= 20
    fits.step_s = 0.1
    assert sum(fits.fit(0.5)[0] for _ in range(8)) >= 20
    pace, usual, said = StepBudget(Budget(steps=4), lambda: 0.0), StepTimer(), []  # which asks no clock
    while (progress := pace.begin_step(usual)) is not None:
        said.append(progress)
        pace.end_step()
    assert said == [0.0, 0.25, 0.5, 0.75]


class Work(CallerPool):
    """Runs kernels in the calling thread; ``seconds`` goes on by ``each_s`` with every one of them."""

    seconds, each_s = 0.0, 0.01

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        super().run(kernel, *args)
        self.seconds += self.each_s


def _moving(frame: int) -> list[View]:
    ball = np.array([0.05 * frame - 0.3, 0.0, 0.5])
    return [replace(v, generated_ns=frame * 10**8) for v in ring(7, size=32, ball_m=ball)]


@every_field
def test_updates_of_a_moving_scene_keep_their_budget(name: str) -> None:
    """On a machine that got busy after a calm beginning."""
    work, each_s = Work(), 0.04
    field = CLASSES[name](SMALL[name], work)
    field.now = lambda: work.seconds
    field.fit(_moving(0), Budget(steps=130))
    field.fit(_moving(1), Budget(seconds=1.0))
    work.each_s = each_s
    for frame in (2, 3):  # by then it is known what each part of an update takes
        long = field.fit(_moving(frame), Budget(seconds=100.0 * each_s))
    first_s = field.fit(_moving(4), Budget(seconds=0.0)).seconds  # what comes before the first step
    step_s = (long.seconds - first_s) / long.steps
    for frame, steps in enumerate((0.2, 1.6, 4.6, 0.2, 2.2, 8.6), start=5):
        budget_s = first_s + steps * step_s
        report = field.fit(_moving(frame), Budget(seconds=budget_s))
        # Every so many steps densities are sampled: one kernel more.
        assert budget_s - 2.0 * step_s < report.seconds <= budget_s + 1.01 * each_s
    assert report.steps > 5
