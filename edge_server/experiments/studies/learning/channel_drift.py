"""A channel that changes during use: rewards of a fixed policy, and of ones trained before and after."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge_server.experiments.studies.learning.setup import (
    RUNS,
    Parts,
    StudyTrainer,
    TrainingStudy,
    better,
    room,
    simple_policies,
)
from edge_server.experiments.studies.study import StudyRequest, Verdict
from edge_server.experiments.training.scheduler.choices import choose, named
from edge_server.experiments.training.scheduler.episode import DecisionPoint
from edge_server.experiments.training.scheduler.evaluation import PerSeed
from edge_server.experiments.training.scheduler.report import smoothed
from edge_server.experiments.training.scheduler.setting import Setting, seeds
from edge_server.experiments.training.scheduler.trainer import TrainingConfig
from edge_server.report.style import CYCLE, figure, label_lines
from edge_server.scheduler import Policy
from edge_server.scheduler.learned.bandit import BanditPolicy
from edge_server.scheduler.learned.rewards import Reward

EPISODES = {True: 40, False: 600}
# Number of episodes of one run before and after the change.
BEFORE, AFTER = 10, 60
AGE = -0.003
PRICE = 0.003
# The camera nearest to the one that rewards.
DYING = "cam01"
POLICIES = ("fixed", "learnt", "learnt afterwards")

Rewards = dict[str, list[float]]


@dataclass(frozen=True)
class Change:
    """A change of the channel.

    before, after: channel sections.
    gone: camera that sends nothing afterwards.
    price: cost of a view in the reward. If above 0, the policy selects single views instead of a threshold of
        age, so its decision depends on which cameras there are.
    """

    before: dict[str, Any]
    after: dict[str, Any]
    gone: str | None = None
    price: float = 0.0

    def settings(self) -> tuple[Setting, Setting]:
        """The settings of decisions before and after the change."""
        return room(self.before), room(self.after, silent=(self.gone,) if self.gone else ())

    def config(self, trainer: StudyTrainer, training: int) -> TrainingConfig:
        """The configuration of the trainings, before and after the change."""
        if self.price:
            reward = dataclasses.replace(trainer.reward("set"), views=-self.price)
            return trainer.config("select", reward, EPISODES, seed=training)
        reward = dataclasses.replace(trainer.reward("corrected"), age=AGE)
        return trainer.config("threshold", reward, EPISODES, tries=3, seed=training)


def changes() -> dict[str, Change]:
    """The changes by name."""
    usual = {"preset": "ch5"}
    slow = {"preset": "ch5", "service": {"law": "exponential", "mean_ms": 200.0}}
    return {
        "delays three times as long": Change(usual, slow),
        "bursts": Change(usual, {"preset": "swing"}),
        "one camera dies": Change(usual, usual, DYING),
        "half of the frames lost": Change(usual, {"preset": "ch5", "faults": {"loss": {"probability": 0.5}}}),
        "the best camera dies where views cost": Change(usual, usual, DYING, PRICE),
    }


class Drift(TrainingStudy):
    name = "drift"
    title = "The channel changes during use: fixed, learnt before, learnt afterwards"

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        known = changes()
        for name in request.chosen(list(known), list(known)[:1]):
            trainings = RUNS[request.quick]
            each = max(1, len(request.repeats(3, 9)) // trainings)
            runs = [
                [_one_run(trainer, name, known[name], training, training * each + k) for k in range(each)]
                for training in range(trainings)
            ]
            all_runs = [run for of in runs for run in of]
            _draw(request, name, all_runs)
            yield (
                judge(f"room, {name}", runs),
                [
                    {"drift": name, "run": r, "policy": policy, "decision": k, "reward": value}
                    for r, run in enumerate(all_runs)
                    for policy, values in run.items()
                    for k, value in enumerate(values)
                ],
            )


def _one_run(trainer: StudyTrainer, name: str, change: Change, training: int, run: int) -> Rewards:
    """Rewards of every decision by policy, scored by the reporting cameras. All policies decide at the same
    instants."""
    before, after = change.settings()
    config = change.config(trainer, training)
    reward, priced = config.reward, "priced-" * bool(change.price)
    home = trainer.train_one(f"drift-before-{priced}{training}", before, config)
    there = trainer.train_one(f"drift-{name.replace(' ', '-')}-{training}", after, config)
    chosen = trainer.evaluate(before, simple_policies("threshold", ("random",)), reward, 6, seed=7)
    fixed = named(chosen.best_fixed("threshold")[1])
    rng = np.random.default_rng([run, 7])
    policies: dict[str, Policy] = {
        "fixed": fixed(rng),
        "learnt": BanditPolicy(home.actor, "learnt", rng),
        "learnt afterwards": BanditPolicy(there.actor, "learnt afterwards", rng),
    }
    rewards: Rewards = {policy: [] for policy in POLICIES}
    number = 0
    for setting, count, first in ((before, BEFORE, 0), (after, AFTER, BEFORE)):
        numbers = seeds(run + 1, "test", count, first)
        moments = [m for episode in trainer.pool.draw(setting, numbers) for m in episode]
        for policy in POLICIES:
            rewards[policy] += _decide(trainer, setting, policies[policy], moments, reward, number)
        number += len(moments)
    return rewards


def _decide(
    trainer: StudyTrainer, setting: Setting, policy: Policy, moments: list[DecisionPoint], reward: Reward, first: int
) -> list[float]:
    """Rewards of decisions, numbered from ``first`` on, scored by the reporting cameras."""
    requests = [(m.seed, m.number, choose(policy, m, first + k)) for k, m in enumerate(moments)]
    found = [reward.of(outcome) for outcome in trainer.pool.evaluate(setting.judged, requests)]
    return [r.total if r.complete and r.total is not None else np.nan for r in found]


def judge(about: str, runs: Sequence[Sequence[Rewards]]) -> list[Verdict]:
    """Verdicts on the second half of the decisions after the change, when there was time to learn.

    runs: the runs of each training.
    """

    def late(policy: str) -> list[PerSeed]:
        return [
            {r: float(np.nanmean(_after(run[policy])[len(_after(run[policy])) // 2 :])) for r, run in enumerate(of)}
            for of in runs
        ]

    return [
        better(
            about,
            "what was learnt before the change is better than the fixed policy that was best before.",
            late("learnt"),
            late("fixed"),
        ),
        better(
            about,
            "what is learnt on the new channel is better than what was learnt on the old.",
            late("learnt afterwards"),
            late("learnt"),
        ),
    ]


def _after(values: list[float]) -> np.ndarray:
    return np.array(values[len(values) * BEFORE // (BEFORE + AFTER) :])


def _draw(request: StudyRequest, name: str, runs: list[Rewards]) -> None:
    with figure(request.out / f"drift-{name.replace(' ', '-')}.png", 1, height_inch=3.2) as (_, axes):
        at = axes[0, 0]
        for k, policy in enumerate(POLICIES):
            mean = np.nanmean([run[policy] for run in runs], axis=0)
            at.plot(smoothed(mean, 40), color=CYCLE[k], label=policy)
        at.axvline(len(mean) * BEFORE // (BEFORE + AFTER), color="#999999", linestyle=":")
        label_lines(at, "reward, mean of 40 decisions", "decision", f"The channel changes: {name}")
