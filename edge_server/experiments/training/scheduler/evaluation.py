"""Compares policies on seeds that were never trained on, decision by decision.

All policies decide at the same instants on the same deliveries, and every update starts from the same field,
so differences are paired. Intervals are over the episodes' seeds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np

from edge_server.experiments.common.statistics import Interval, at_its_best, interval, paired, share_closed
from edge_server.experiments.training.scheduler.choices import Maker, choice_of_action, choices, named
from edge_server.experiments.training.scheduler.episode import Choice, DecisionPoint, Outcome
from edge_server.experiments.training.scheduler.setting import Setting
from edge_server.experiments.training.scheduler.workers import Request, WorkerPool
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.rewards import Reward

PerSeed = dict[int, float | None]
At = tuple[int, int]
"""Seed of an episode and number of a decision."""

# Policies without learning, thresholds and waits aside.
BASELINE_POLICIES = (
    "random",
    "all",
    "periodic:500",
    "round-robin:6",
    "freshest-k:4",
    "freshest-k:6",
    "freshest-k:9",
    "freshest-k:12",
    "age-driven",
)
HINDSIGHT = "hindsight"
_REQUESTS_AT_ONCE = 400


@dataclass
class Evaluation:
    """Outcomes by policy and decision.

    reward: rates the outcomes; it may be replaced without new evaluations.
    repeated: outcomes of the same choices with fields of other seeds. The choice that is best in one outcome
        is measured in the other, because the maximum of noisy fits is biased upwards.
    """

    reward: Reward
    outcomes: dict[str, dict[At, Outcome]] = field(default_factory=dict)
    repeated: dict[str, dict[At, Outcome]] = field(default_factory=dict)

    def value(self, outcome: Outcome) -> float | None:
        """Reward of an outcome; None if a term is missing."""
        found = self.reward.of(outcome)
        return found.total if found.complete else None

    def rewards(self, name: str) -> PerSeed:
        """seed -> mean reward of its decisions. For ``hindsight``: of the best choice of all policies at each
        decision, chosen by one fit and measured by another."""
        values = self._hindsight(list(self.outcomes))[0] if name == HINDSIGHT else self.decisions(name)
        return _by_seed(values, self._unscored())

    def decisions(self, name: str) -> dict[At, float | None]:
        """Reward of every decision, mean of its fits; None if a term is missing."""
        return {at: _mean([self.value(o) for o in self._fits(name, at)]) for at in self.outcomes[name]}

    def runs(self, name: str) -> list[PerSeed]:
        """Rewards of each of the repeated trainings ``NAME-0``, ``NAME-1``, ..."""
        of = [n for n in self.outcomes if n.startswith(f"{name}-") and n[len(name) + 1 :].isdigit()]
        return [self.rewards(n) for n in of]

    def seeds(self, name: str) -> tuple[int, int]:
        """Number of seeds, and of those with a value."""
        found = self.rewards(name)
        return len(found), sum(v is not None for v in found.values())

    def term(self, name: str, term: str) -> Interval:
        """Mean of one field of the outcomes, over seeds."""
        found = {at: _mean([getattr(o, term) for o in self._fits(name, at)]) for at in self.outcomes[name]}
        return interval(_by_seed(found).values())

    def best_fixed(self, kind: str) -> tuple[PerSeed, str]:
        """Rewards of ``kind`` (threshold, wait) at its best value, chosen on one half of the seeds and
        measured on the other; and the name of the best value over all seeds."""
        curve = {
            float(name.partition(":")[2]): self.rewards(name) for name in self.outcomes if name.startswith(f"{kind}:")
        }
        means = {x: interval(values.values()).mean for x, values in curve.items()}
        best = max(means, key=lambda x: means[x])
        return dict(at_its_best(curve)), f"{kind}:{best:g}"

    def share(self, values: PerSeed) -> Interval:
        """(r - random) / (hindsight - random): the share of the possible gain."""
        return share_closed(values, self.rewards("random"), self.rewards(HINDSIGHT))

    def best_values(self, kind: str) -> dict[str, Any]:
        """How much the best value of ``kind`` varies between decisions: its ``quartiles``, and the ``gain``
        from knowing it: hindsight among these values minus the best fixed one, paired over seeds. Both are
        unknown if every choice was carried out only once."""
        names = [name for name in self.outcomes if name.startswith(f"{kind}:")]
        rewards, best = self._hindsight(names)
        gain = paired(_by_seed(rewards, self._unscored()), self.best_fixed(kind)[0])
        values = [float(names[k].partition(":")[2]) for k in best]
        quartiles = np.percentile(values, [25, 50, 75]).tolist() if values else [None] * 3
        return {"quartiles": quartiles, "gain": gain}

    def _unscored(self) -> set[At]:
        """Decisions at which no policy has a reward, for example because nothing moves in the images that
        score. They are left out for all policies."""
        known = {at for of in self.outcomes.values() for at, o in of.items() if self.value(o) is not None}
        return {at for of in self.outcomes.values() for at in of} - known

    def _fits(self, name: str, at: At) -> list[Outcome]:
        second = self.repeated.get(name, {}).get(at)
        return [self.outcomes[name][at], *([second] if second is not None else [])]

    def _hindsight(self, names: Sequence[str]) -> tuple[dict[At, float | None], list[int]]:
        """Decision -> reward of the best of ``names`` there, and the indices of all best ones.

        The best is chosen by each of two fits and measured by the other, among the policies that have both;
        None if none has.
        """
        found: dict[At, float | None] = {}
        best: list[int] = []
        for at in self.outcomes[names[0]] if names else ():
            pairs = {
                k: [self.value(o) for o in self._fits(n, at)] for k, n in enumerate(names) if at in self.outcomes[n]
            }
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
    """A candidate that may use more of a decision than a policy sees."""

    def choice(self, moment: DecisionPoint) -> Choice: ...


Candidate = Maker | Actor | OracleCandidate


def evaluate_policies(
    setting: Setting,
    pool: WorkerPool,
    seeds: Sequence[int],
    candidates: Mapping[str, Candidate],
    reward: Reward,
    say: Callable[[str], None] | None = None,
) -> Evaluation:
    """Carry out the choice of every candidate at every decision of every seed twice, with fields of different
    seeds.

    setting: a ``Setting.judged``, because the cameras that reward must not judge.
    candidates: by name.
    say: called with lines of progress.
    """
    evaluation = Evaluation(reward, {name: {} for name in candidates}, {name: {} for name in candidates})
    requests: list[tuple[str, Request]] = []
    # All requests of one episode are adjacent, so that its images and its field are made once.
    for moments in pool.draw(setting, seeds):
        for place, (name, candidate) in enumerate(candidates.items()):
            if isinstance(candidate, Actor):
                actions, _ = candidate.act([m.state for m in moments])
                chosen = [choice_of_action(candidate.spec, a, m) for a, m in zip(actions, moments)]
            elif callable(candidate):
                chosen = choices(candidate, moments, place)
            else:
                chosen = [candidate.choice(m) for m in moments]
            requests += [(name, (m.seed, m.number, c)) for m, c in zip(moments, chosen)]
    other_seeds = dataclasses.replace(setting, repeat=setting.repeat + 1)
    fits = [(evaluation.outcomes, setting), (evaluation.repeated, other_seeds)]
    for turn, (into, where) in enumerate(fits):
        for first in range(0, len(requests), _REQUESTS_AT_ONCE):
            part = requests[first : first + _REQUESTS_AT_ONCE]
            found = pool.evaluate(where, [request for _, request in part])
            for (name, (seed, number, _)), outcome in zip(part, found):
                into[name][seed, number] = outcome
            if say is not None:
                say(f"{turn * len(requests) + first + len(part)}/{2 * len(requests)} evaluations")
    return evaluation


def baseline_policies(
    omegas_ms: Sequence[float], kinds: Sequence[str], others: Sequence[str] = BASELINE_POLICIES
) -> dict[str, Maker]:
    """The policies without learning that are evaluated, by name."""
    fixed = [f"{kind}:{omega:g}" for kind in kinds for omega in omegas_ms]
    return {name: named(name) for name in (*others, *fixed)}


def rows(evaluation: Evaluation, **labels: Any) -> list[dict[str, Any]]:
    """A table row for each policy: its reward, its gain over random, its share and the fields of its
    outcomes; intervals over seeds. labels: first columns of every row."""
    terms = [f.name for f in fields(Outcome)]
    found = []
    for name in [*evaluation.outcomes, HINDSIGHT]:
        mine = evaluation.rewards(name)
        intervals = {
            "reward": interval(mine.values()),
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


def _by_seed(values: Mapping[At, float | None], left_out: Container[At] = ()) -> PerSeed:
    """Mean over each seed's decisions, except those ``left_out``. None if one of them has no value, because
    seeds that lack different decisions cannot be compared, or if all are left out."""
    found: dict[int, list[float | None]] = {}
    for (seed, number), value in values.items():
        mine = found.setdefault(seed, [])
        if (seed, number) not in left_out:
            mine.append(value)
    return {
        seed: float(np.mean(np.array(mine, float))) if mine and None not in mine else None
        for seed, mine in found.items()
    }


def _mean(values: Sequence[float | None]) -> float | None:
    """The mean; None if a value is missing or there are none."""
    known = [v for v in values if v is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None
