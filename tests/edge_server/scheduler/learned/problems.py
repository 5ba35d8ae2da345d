"""Bandits whose best actions are known in closed form, and states as a rig would give them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.ppo import Batch, Learner
from edge_server.scheduler.learned.state import State, StateLayout

OMEGAS_MS = (0.0, 50.0, 100.0, 150.0)
WORTH_MS = 100.0


def collect(learner: Learner, problem: Any, seeds: Sequence[int]) -> Batch:
    """A batch of the learner's exploring decisions in the rounds of ``seeds``."""
    rounds = [problem.draw(seed) for seed in seeds]
    states = [one.state for one in rounds]
    actions, logps = act(learner, states)
    return batch_of(learner, states, actions, logps, [one.reward(a) for one, a in zip(rounds, actions)])


def act(learner: Learner, states: Sequence[State]) -> tuple[Any, Any]:
    """Exploring actions and their log-probabilities; what a checkpoint keeps decides the luck."""
    return learner.actor.act(states, learner._rng["actions"])


def batch_of(learner: Learner, states: Sequence[State], actions: Any, logps: Any, rewards: Any) -> Batch:
    return Batch(learner.spec.layout.batch(states), actions, logps, np.array(rewards, float))


def value(learner: Learner, states: Sequence[State]) -> np.ndarray:
    """V of states, in the reward's unit."""
    weights = {name: w.detach().numpy() for name, w in learner._value.items()}
    found = networks.value(np, weights, learner.spec.layout.batch(states))
    return learner._rewards.mean + learner._rewards.scale * found


def same(a: Learner, b: Learner) -> bool:
    """Whether their actors have the same weights, bit for bit."""
    return all(np.array_equal(w, b.actor.weights[name]) for name, w in a.actor.weights.items())


def state(n: int, rng: np.random.Generator, d: int = 0, silent: int = 0) -> State:
    """``n`` cameras with exponential ages, the last ``silent`` of which never reported."""
    reported = np.arange(n) < n - silent
    z = rng.standard_normal((n, d)).astype(np.float32) if d else None
    ages = np.where(reported, rng.exponential(80.0, n), np.nan)
    return State(ages, rng.standard_normal((n, 6)), z, reported, tuple(f"cam{i:02d}" for i in range(n)))


@dataclass(frozen=True)
class Drawn:
    state: State
    best: Any
    gain: Any
    noise: float

    def reward(self, action: Any) -> float:
        return float(self.gain(action)) + self.noise

    def regret(self, action: Any) -> float:
        return float(self.gain(self.best)) - float(self.gain(action))


@dataclass(frozen=True)
class FreshOnes:
    """Sets: a frame is worth (1 - age / 100 ms) / N: the best set is every frame younger than that, or the
    youngest one where none is."""

    cameras: int = 6
    layout = StateLayout(("age",))

    def draw(self, seed: int) -> Drawn:
        rng = np.random.default_rng([1, seed])
        s = state(self.cameras, rng)
        worth = (1.0 - s.ages_ms / WORTH_MS) / self.cameras
        best = worth > 0
        best[np.argmax(worth)] = True
        return Drawn(s, best, lambda a: (worth * a).sum(), 0.1 * rng.standard_normal())


@dataclass(frozen=True)
class Waits:
    """Omegas: the older the cameras are on average, the longer it pays to wait; the best is in a closed
    form of the mean age."""

    cameras: int = 6
    layout = StateLayout(("age",))

    def draw(self, seed: int) -> Drawn:
        rng = np.random.default_rng([2, seed])
        s = state(self.cameras, rng)
        s.ages_ms[:] *= rng.uniform(0.2, 2.0)
        target = float(np.clip(s.ages_ms.mean() / 40.0, 0.0, 3.0))
        return Drawn(s, round(target), lambda k: -0.1 * abs(target - k), 0.1 * rng.standard_normal())


def teach(learner: Any, problem: Any, updates: int, batch: int = 64) -> None:
    for number in range(updates):
        learner.update(collect(learner, problem, range(number * batch, (number + 1) * batch)))


def regret(learner: Any, problem: Any, decisions: int = 300) -> float:
    """Mean regret of the likeliest actions at instants that were never trained on."""
    drawn = [problem.draw(10**6 + i) for i in range(decisions)]
    actions, _ = learner.actor.act([d.state for d in drawn])
    return float(np.mean([d.regret(a) for d, a in zip(drawn, actions)]))
