"""A contextual bandit: rounds to decide in, and the reward of every action."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

from edge_server.scheduler.learned.state import State

if TYPE_CHECKING:  # only learning needs torch
    from edge_server.scheduler.learned.ppo import Batch, Learner


class Round(Protocol):
    """One instant at which to decide. ``reward`` may be called repeatedly: every action starts from the same
    field, so that actions can be compared."""

    @property
    def state(self) -> State: ...

    def reward(self, action: Any) -> tuple[float, dict[str, float | None]]:
        """The reward (NaN where there is none) and its terms. action: (N,) bool, the cameras used, or the
        index of an omega."""
        ...


class Problem(Protocol):
    """A source of rounds."""

    def draw(self, seed: int) -> Round:
        """The round of ``seed``: the same seed, the same instant."""
        ...


def collect(learner: Learner, problem: Problem, seeds: Sequence[int]) -> Batch:
    """A batch of the learner's exploring decisions in the rounds of ``seeds``."""
    rounds = [problem.draw(seed) for seed in seeds]
    states = [one.state for one in rounds]
    actions, logps = learner.act(states)
    rewards = [one.reward(action)[0] for one, action in zip(rounds, actions)]
    return learner.batch(states, actions, logps, rewards)
