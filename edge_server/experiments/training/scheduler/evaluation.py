"""What was learnt against everything else, on seeds that nobody trained on, decision by decision.

All policies decide at the same instants on the same deliveries, and every update starts from the same field:
differences are paired. The unit that repeats is the episode's seed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np

from edge_server.experiments.studies.statistics import Interval, at_its_best, interval, paired, share_closed
from edge_server.experiments.training.scheduler.choices import Maker, choice_of_action, choices, named
from edge_server.experiments.training.scheduler.episode import Choice, DecisionPoint, Outcome
from edge_server.experiments.training.scheduler.setting import Setting
from edge_server.experiments.training.scheduler.workers import Asked, WorkerPool
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.rewards import Reward

PerSeed = dict[int, float | None]
At = tuple[int, int]
"""Seed of an episode and number of a decision."""

# What there is without learning, thresholds and waits aside.
RIVALS = (
    "random", "all", "periodic:500", "round-robin:6", "freshest-k:4", "freshest-k:6", "freshest-k:9",
    "freshest-k:12", "age-driven", "mask", "freshen",
)  # fmt: skip
HINDSIGHT = "hindsight"
_ASKED_AT_ONCE = 400


@dataclass
class Evaluation:
    """Outcomes by policy and decision. reward: by which they are judged; another one costs nothing. again:
    the same choices carried out once more, with other luck: what looked best at a decision is measured where
    it was not chosen, since the best of many lucky fits is better than any of them."""

    reward: Reward
    outcomes: dict[str, dict[At, Outcome]] = field(default_factory=dict)
    again: dict[str, dict[At, Outcome]] = field(default_factory=dict)

    def value(self, outcome: Outcome) -> float | None:
        """Its reward; None where a term is missing: it could not be compared."""
        found = self.reward.of(outcome)
        return found.total if found.complete else None

    def rewards(self, name: str) -> PerSeed:
        """seed -> mean reward of its decisions. ``hindsight``: at every decision what was the best of all
        that was tried there, which none can know: chosen by one fit and measured by another."""
        if name == HINDSIGHT:
            return _by_seed(self._top(list(self.outcomes))[0], self._nobodys())
        return _by_seed(self._values(name), self._nobodys())

    def decisions(self, name: str) -> dict[At, float | None]:
        """Reward at every decision, mean of its fits; None where a term is missing."""
        return self._values(name)

    def seeds(self, name: str) -> tuple[int, int]:
        """How many seeds there are, and how many have a value."""
        found = self.rewards(name)
        return len(found), sum(v is not None for v in found.values())

    def term(self, name: str, term: str) -> Interval:
        """Mean of one term of the outcomes over seeds."""
        found = {at: _mean([getattr(o, term) for o in self._fits(name, at)]) for at in self.outcomes[name]}
        return interval(list(_by_seed(found).values()))

    def best_fixed(self, kind: str) -> tuple[PerSeed, str]:
        """Rewards of ``kind`` (threshold, wait) at its best value, chosen on one half of the seeds and
        measured on the other; and the name of the best over all."""
        curve = {
            float(name.partition(":")[2]): self.rewards(name)
            for name in self.outcomes if name.startswith(f"{kind}:")
        }  # fmt: skip
        means = {x: interval(list(values.values())).mean for x, values in curve.items()}
        best = max(means, key=lambda x: means[x])
        return dict(at_its_best(curve)), f"{kind}:{best:g}"

    def against(self, name: str, other: PerSeed) -> Interval:
        """Paired difference in reward, over seeds."""
        return paired(self.rewards(name), other)

    def share(self, values: PerSeed) -> Interval:
        """(r - random) / (hindsight - random): the share of what could be won."""
        return share_closed(values, self.rewards("random"), self.rewards(HINDSIGHT))

    def varies(self, kind: str) -> dict[str, Any]:
        """How far the best value of ``kind`` differs between decisions, and what knowing it would be worth:
        hindsight among these values alone minus the best fixed one, paired over seeds. Nothing is known of
        either where every choice was carried out only once."""
        names = [name for name in self.outcomes if name.startswith(f"{kind}:")]
        top, best = self._top(names)
        gain = paired(_by_seed(top, self._nobodys()), self.best_fixed(kind)[0])
        values = [float(names[k].partition(":")[2]) for k in best]
        quartiles = np.percentile(values, [25, 50, 75]).tolist() if values else [None] * 3
        return {"quartiles": quartiles, "gain": gain}

    def _nobodys(self) -> set[At]:
        """Decisions at which nobody's outcome has a value: nothing moves where the cameras look that judge,
        say. That is in what was looked at, not in what was chosen."""
        known = {at for of in self.outcomes.values() for at, o in of.items() if self.value(o) is not None}
        return {at for of in self.outcomes.values() for at in of} - known

    def _fits(self, name: str, at: At) -> list[Outcome]:
        second = self.again.get(name, {}).get(at)
        return [self.outcomes[name][at], *([second] if second is not None else [])]

    def _values(self, name: str) -> dict[At, float | None]:
        return {at: _mean([self.value(o) for o in self._fits(name, at)]) for at in self.outcomes[name]}

    def _top(self, names: Sequence[str]) -> tuple[dict[At, float | None], list[int]]:
        """Decision -> the reward of what was the best of ``names``: chosen by each of two fits and measured
        by the other, of those that have both; None where none has. And the number of each best one."""
        found: dict[At, float | None] = {}
        best: list[int] = []
        for at in self.outcomes[names[0]] if names else ():
            pairs = {k: [self.value(o) for o in self._fits(n, at)] for k, n in enumerate(names)
                     if at in self.outcomes[n]}  # fmt: skip
            known = {k: p for k, p in pairs.items() if len(p) == 2 and None not in p}
            if not known:
                found[at] = None
                continue
            numbers, table = list(known), np.array(list(known.values()), float)
            first, second = table.argmax(axis=0).tolist()
            found[at] = float(table[first, 1] + table[second, 0]) / 2
            best += [numbers[first], numbers[second]]
        return found, best


class OracleCandidate(Protocol):
    """A rival that may look at more of a decision than a policy sees."""

    def choice(self, moment: DecisionPoint) -> Choice: ...


Candidate = Maker | Actor | OracleCandidate


def evaluate_policies(
    setting: Setting,
    pool: WorkerPool,
    seeds: Sequence[int],
    rivals: Mapping[str, Candidate],
    reward: Reward,
    say: Any = None,
) -> Evaluation:
    """Carry out what each of ``rivals`` chooses at every decision of every seed, twice, with fields of other
    seeds. Give it ``Setting.judged``: what rewarded does not judge."""
    evaluation = Evaluation(reward, {name: {} for name in rivals}, {name: {} for name in rivals})
    episodes = pool.draw(setting, seeds)
    asked: list[tuple[str, Asked]] = []
    # All that is asked of one episode stands together: its pictures and its field are at hand once.
    for moments in episodes:
        for place, (name, rival) in enumerate(rivals.items()):
            if isinstance(rival, Actor):
                acts, _ = rival.act([m.state for m in moments])
                chosen = [choice_of_action(rival.spec, a, m) for a, m in zip(acts, moments)]
            elif callable(rival):
                chosen = choices(rival, moments, place)
            else:
                chosen = [rival.choice(m) for m in moments]
            asked += [(name, (m.seed, m.number, c)) for m, c in zip(moments, chosen)]
    fits = [
        (evaluation.outcomes, setting),
        (evaluation.again, dataclasses.replace(setting, repeat=setting.repeat + 1)),
    ]
    for turn, (into, where) in enumerate(fits):
        for first in range(0, len(asked), _ASKED_AT_ONCE):
            part = asked[first : first + _ASKED_AT_ONCE]
            found = pool.evaluate(where, [a for _, a in part])
            for (name, (seed, number, _)), outcome in zip(part, found):
                into[name][seed, number] = outcome
            if say is not None:
                say(f"{turn * len(asked) + first + len(part)}/{2 * len(asked)} evaluations")
    return evaluation


def rivals(
    omegas_ms: Sequence[float], kinds: Sequence[str], others: Sequence[str] = RIVALS
) -> dict[str, Maker]:
    """The policies without learning that are tried, by name."""
    fixed = [f"{kind}:{omega:g}" for kind in kinds for omega in omegas_ms]
    return {name: named(name) for name in (*others, *fixed)}


def rows(evaluation: Evaluation, **labels: Any) -> list[dict[str, Any]]:
    """A row for each policy: its reward, how much that is over random, its share, and the outcomes' terms;
    intervals over seeds. labels: put before all of them."""
    terms = [f.name for f in fields(Outcome)]
    found = []
    for name in [*evaluation.outcomes, HINDSIGHT]:
        mine = evaluation.rewards(name)
        intervals = {
            "reward": interval(list(mine.values())),
            "over_random": paired(mine, evaluation.rewards("random")),
            "share": evaluation.share(mine),
        }
        row = {**labels, "policy": name}
        for what, i in intervals.items():
            row |= {what: i.mean, f"{what}_low": i.low, f"{what}_high": i.high}
        if name != HINDSIGHT:
            row |= {term: evaluation.term(name, term).mean for term in terms}
        found.append(row)
    return found


def _by_seed(values: Mapping[At, float | None], nobodys: Container[At] = ()) -> PerSeed:
    """Mean over each seed's decisions; None where one of them has no value, lest seeds be compared that
    lack different ones. nobodys: decisions that are left out; None where all of a seed's are."""
    found: dict[int, list[float | None]] = {}
    for (seed, number), value in values.items():
        mine = found.setdefault(seed, [])
        if (seed, number) not in nobodys:
            mine.append(value)
    return {
        seed: float(np.mean(np.array(mine, float))) if mine and None not in mine else None
        for seed, mine in found.items()
    }


def _mean(values: Sequence[float | None]) -> float | None:
    """None where one is missing."""
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None
