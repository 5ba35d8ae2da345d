"""What there is to learn: an instant at which to decide, and what each decision would be worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

from edge_server.scheduler.learned.state import State

if TYPE_CHECKING:  # torch is for learning alone
    from edge_server.scheduler.learned.ppo import Batch, Learner


class Decision(Protocol):
    """One instant. ``reward`` may be asked any number of times: every action starts from the same field, so
    that actions can be compared."""

    @property
    def state(self) -> State: ...

    def reward(self, action: Any) -> tuple[float, dict[str, float | None]]:
        """The reward, NaN where none could be had, and its terms. action: (N,) bool, the cameras used, or
        the index of an omega."""
        ...


class Problem(Protocol):
    def draw(self, seed: int) -> Decision:
        """The instant of ``seed``: the same seed, the same instant."""
        ...


def collect(learner: Learner, problem: Problem, seeds: Sequence[int]) -> Batch:
    """Decide at the instants of ``seeds`` as the learner does while it explores."""
    decisions = [problem.draw(seed) for seed in seeds]
    states = [decision.state for decision in decisions]
    actions, logps = learner.act(states)
    rewards = [decision.reward(action)[0] for decision, action in zip(decisions, actions)]
    return learner.batch(states, actions, logps, rewards)
