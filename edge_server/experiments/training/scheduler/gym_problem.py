"""Decisions with real field fits as a ``Problem`` of ``scheduler.learned.gym_environment``, for external learners.

environment = BanditEnvironment(FitProblem(setting, Spec("select"), make_reward("set"), folders), spec, cameras=18)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.rollouts.episode import Episode, EpisodeFactory, mean_outcome
from edge_server.experiments.rollouts.rollout import choice_of_action
from edge_server.experiments.rollouts.setting import SEEDS_A_PURPOSE, Setting, seeds
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.rewards import Reward
from edge_server.scheduler.learned.state import State


@dataclass(frozen=True)
class FitProblem:
    """Seed s is decision s mod D of training episode s div D, with D decisions per episode. No seed gives a test
    episode.

    spec: the meaning of an action.
    folders: of data sets and weights.
    run: number of the run whose training episodes are drawn.
    """

    setting: Setting
    spec: Spec
    reward: Reward
    folders: Folders = field(default_factory=Folders)
    run: int = 0
    _factory: EpisodeFactory = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_factory", EpisodeFactory(self.setting, self.folders))

    def draw(self, seed: int) -> FitDecision:
        """The decision of ``seed``."""
        episode, number = divmod(seed, self.setting.decisions)
        (of,) = seeds(self.run, "train", 1, episode % SEEDS_A_PURPOSE)
        return FitDecision(self, self._factory.episode(of), number)


@dataclass(frozen=True)
class FitDecision:
    """A ``scheduler.learned.gym_environment.Round``."""

    problem: FitProblem
    episode: Episode
    number: int

    @property
    def state(self) -> State:
        """The state that the decision is made from."""
        return self.episode.points[self.number].state

    def reward(self, action: Any) -> tuple[float, dict[str, float | None]]:
        """Reward of a real fit, NaN if a term is missing, and its terms."""
        choice = choice_of_action(self.problem.spec, action, self.episode, self.number)
        outcomes = self.episode.evaluate(self.number, choice)
        found = self.problem.reward.of(mean_outcome(list(outcomes.values())))
        total = found.total if found.complete else None
        return (math.nan if total is None else total), found.terms
