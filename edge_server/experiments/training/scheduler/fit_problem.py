"""Decisions with real field fits as a ``Problem``, for external learners.

with WorkerPool(folders) as pool:
    problem = FitProblem(setting, Spec("select"), make_reward("set"), pool)
    environment = ...                      # scheduler.learned.gym_environment, with gymnasium's interface
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from edge_server.experiments.training.scheduler.choices import choice_of_action
from edge_server.experiments.training.scheduler.episode import DecisionPoint
from edge_server.experiments.training.scheduler.setting import SEEDS_A_PURPOSE, Setting, seeds
from edge_server.experiments.training.scheduler.workers import WorkerPool
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.rewards import Reward
from edge_server.scheduler.learned.state import State

KEPT = 16  # number of last drawn episodes whose frames stay in memory


@dataclass(frozen=True)
class FitProblem:
    """A ``scheduler.learned.gym_environment.Problem``: seed s is decision s mod D of training episode s div
    D, with D decisions per episode. No seed gives a test episode.

    spec: the meaning of an action.
    run: number of the run whose training episodes are drawn.
    """

    setting: Setting
    spec: Spec
    reward: Reward
    pool: WorkerPool
    run: int = 0
    _drawn: deque[int] = field(default_factory=lambda: deque(maxlen=KEPT), init=False, repr=False, compare=False)

    def draw(self, seed: int) -> FitDecision:
        episode, number = divmod(seed, self.setting.decisions)
        (of,) = seeds(self.run, "train", 1, episode % SEEDS_A_PURPOSE)
        if of not in self._drawn:
            if len(self._drawn) == KEPT:
                self.pool.forget(self.setting, [self._drawn[0]])
            self._drawn.append(of)
        return FitDecision(self, self.pool.draw(self.setting, [of])[0][number])


@dataclass(frozen=True)
class FitDecision:
    """A ``scheduler.learned.gym_environment.Round``."""

    problem: FitProblem
    moment: DecisionPoint

    @property
    def state(self) -> State:
        return self.moment.state

    def reward(self, action: Any) -> tuple[float, dict[str, float | None]]:
        """Reward of a real fit, NaN if a term is missing, and its terms."""
        problem, moment = self.problem, self.moment
        choice = choice_of_action(problem.spec, action, moment)
        (outcome,) = problem.pool.evaluate(problem.setting, [(moment.seed, moment.number, choice)])
        found = problem.reward.of(outcome)
        total = found.total if found.complete else None
        return (math.nan if total is None else total), found.terms
