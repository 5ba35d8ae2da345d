"""The channel changes during use: how a fixed policy, a learnt one and one that is still learning take it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from edge_server.offline.study.base import Ask, Point, Table, Verdict
from edge_server.offline.study.learning import Lesson, School, better, room
from edge_server.offline.train_scheduler import OMEGAS_MS
from edge_server.offline.training.choosing import choose, named
from edge_server.offline.training.contest import PerSeed, rivals, write_rows
from edge_server.offline.training.episode import Moment
from edge_server.offline.training.report import smoothed
from edge_server.offline.training.setting import Setting, seeds
from edge_server.offline.training.trainer import Course
from edge_server.report.style import CYCLE, figure, label_lines
from edge_server.scheduler import Policy
from edge_server.scheduler.learned.apprentice import Apprentice, Leash
from edge_server.scheduler.learned.bandit import Bandit
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.rewards import Reward
from edge_server.scheduler.learned.spec import Spec
from edge_server.scheduler.learned.state import StateLayout

EPISODES = {True: 40, False: 600}
# Of one run, before and after the change.
BEFORE, AFTER = 10, 60
# Episodes whose rewards come back together: live, they come some seconds after the decisions.
_TOGETHER = 5
AGE = -0.003
# The nearest to the held-out camera.
DYING = "cam01"
POLICIES = ("fixed", "learnt", "still learning", "learnt afterwards")

Rewards = dict[str, list[float]]


def changes() -> dict[str, tuple[dict[str, Any], dict[str, Any], str | None]]:
    """Name -> the channel before and after, and a camera that is gone afterwards."""
    usual = {"preset": "ch5"}
    slow = {"preset": "ch5", "service": {"law": "exponential", "mean_ms": 200.0}}
    return {
        "delays three times as long": (usual, slow, None),
        "bursts": (usual, {"preset": "swing"}, None),
        "one camera dies": (usual, usual, DYING),
        "half of the frames lost": (usual, {"preset": "ch5", "faults": {"loss": {"probability": 0.5}}}, None),
    }


class Drift:
    name = "drift"
    title = "The channel changes during use: fixed, learnt, and still learning"

    def points(self, ask: Ask) -> list[Point]:
        return []

    def report(self, ask: Ask, table: Table) -> list[Verdict]:
        del table
        found: list[Verdict] = []
        written: list[dict[str, Any]] = []
        with School(ask) as school:
            reward = dataclasses.replace(school.reward("corrected"), age=AGE)
            for name, (before, after, gone) in list(changes().items())[: 1 if ask.quick else None]:
                runs = [
                    _one_run(school, name, room(before), room(after), reward, run, ask.quick, gone)
                    for run in ask.repeats(3, 10)
                ]
                found += _judge(f"room, {name}", runs)
                _draw(ask, name, runs)
                written += [
                    {"drift": name, "run": r, "policy": policy, "decision": k, "reward": value}
                    for r, run in enumerate(runs) for policy, values in run.items()
                    for k, value in enumerate(values)
                ]  # fmt: skip
        write_rows(ask.out / f"{self.name}.csv", written)
        return found


def _one_run(
    school: School,
    name: str,
    before: Setting,
    after: Setting,
    reward: Reward,
    run: int,
    quick: bool,
    gone: str | None,
) -> Rewards:
    """Rewards of every decision, by policy: the same decisions for all of them."""
    spec = Spec("threshold", StateLayout(("age", "pose")), OMEGAS_MS["threshold"])
    course = Course(spec, reward, EPISODES[quick], tries=3)
    home = school.teach(Lesson("drift-before", before, course))
    there = school.teach(Lesson(f"drift-{name.replace(' ', '-')}", after, course))
    chosen = school.contest(before, rivals(spec.omegas_ms, ["threshold"], ("random",)), reward, 6, seed=7)
    fixed = named(chosen.best_fixed("threshold")[1])
    rng = np.random.default_rng([run, 7])
    policies: dict[str, Policy] = {
        "fixed": fixed(rng),
        "learnt": Bandit(home.actor, "learnt", rng),
        "still learning": Apprentice(
            Learner.load(home.folder / "policy.npz"),
            fixed(rng),
            "still learning",
            rng,
            Leash(bound=5.0, settle=0),
        ),
        "learnt afterwards": Bandit(there.actor, "learnt afterwards", rng),
    }
    rewards: Rewards = {policy: [] for policy in POLICIES}
    number = 0
    for setting, count, first in ((before, BEFORE, 0), (after, AFTER, BEFORE)):
        numbers = seeds(run + 1, "test", count, first)
        for start in range(0, count, _TOGETHER):
            part = numbers[start : start + _TOGETHER]
            moments = [m for episode in school.crew.draw(setting, part) for m in episode]
            if gone and setting is after:
                moments = [without(m, gone) for m in moments]
            for policy in POLICIES:
                rewards[policy] += _decide(school, setting, policies[policy], moments, reward, number)
            number += len(moments)
    return rewards


def without(moment: Moment, camera: str) -> Moment:
    """The same decision had ``camera`` never sent anything."""
    state = moment.state
    silent = np.array([c == camera for c in moment.cameras])
    return dataclasses.replace(
        moment,
        arrivals=tuple(a for a in moment.arrivals if a.camera != camera),
        state=dataclasses.replace(
            state, ages_ms=np.where(silent, np.nan, state.ages_ms), reported=state.reported & ~silent
        ),
    )


def _decide(
    school: School, setting: Setting, policy: Policy, moments: list[Moment], reward: Reward, first: int
) -> list[float]:
    """Rewards of decisions that are numbered from ``first`` on; one that learns learns from them."""
    choices = [choose(policy, m, first + k) for k, m in enumerate(moments)]
    outcomes = school.crew.evaluate(setting, [(m.seed, m.number, c) for m, c in zip(moments, choices)])
    totals = [r.total if (r := reward.of(outcome)).complete else None for outcome in outcomes]
    if isinstance(policy, Apprentice):
        for k, total in enumerate(totals):
            if policy.scored(first + k, total):
                policy.learn()
    return [np.nan if total is None else total for total in totals]


def _judge(about: str, runs: list[Rewards]) -> list[Verdict]:
    """Over the second half of what follows the change, when there has been time to learn."""

    def late(policy: str) -> PerSeed:
        return {r: float(np.nanmean(_after(run[policy])[len(_after(run[policy])) // 2 :]))
                for r, run in enumerate(runs)}  # fmt: skip

    recovered = [recovery(run) for run in runs]
    told = ", ".join("not within the run" if r is None else f"{r} decisions" for r in recovered)
    return [
        better(about, "one that goes on learning is better than what was learnt before the change.",
               late("still learning"), late("learnt"),
               f"half of what the change cost is made up after: {told} (a run each); "),
        better(about, "and better than the fixed policy that was best before.", late("still learning"),
               late("fixed")),
        better(about, "what is learnt on the new channel is better than what was learnt on the old.",
               late("learnt afterwards"), late("learnt")),
    ]  # fmt: skip


def recovery(run: Rewards) -> int | None:
    """Decisions after the change until the one that learns has made up half of what the change cost the
    learnt one, beside one learnt on the new channel; None: not within the run, or it cost nothing."""
    mine, old, new = (smoothed(_after(run[p]), 40) for p in ("still learning", "learnt", "learnt afterwards"))
    lost = float(np.nanmean(new - old))
    if not lost > 0.0:
        return None
    there = np.flatnonzero((mine - old >= 0.5 * lost) & (np.arange(len(mine)) >= 20))
    return int(there[0]) if len(there) else None


def _after(values: list[float]) -> np.ndarray:
    return np.array(values[len(values) * BEFORE // (BEFORE + AFTER) :])


def _draw(ask: Ask, name: str, runs: list[Rewards]) -> None:
    with figure(ask.out / f"drift-{name.replace(' ', '-')}.png", 1, height_inch=3.2) as (_, axes):
        at = axes[0, 0]
        for k, policy in enumerate(POLICIES):
            mean = np.nanmean([run[policy] for run in runs], axis=0)
            at.plot(smoothed(mean, 40), color=CYCLE[k], label=policy)
        at.axvline(len(mean) * BEFORE // (BEFORE + AFTER), color="#999999", linestyle=":")
        label_lines(at, "reward, mean of 40 decisions", "decision", f"The channel changes: {name}")
