"""What was learnt against everything else, on seeds that nobody trained on, decision by decision.

All policies decide at the same instants on the same deliveries, and every update starts from the same field:
differences are paired. The unit that repeats is the episode's seed.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.offline.study.statistics import Interval, at_its_best, interval, paired, share_closed
from edge_server.offline.training.choosing import Maker, choices, named, of_action
from edge_server.offline.training.crew import Asked, Crew
from edge_server.offline.training.episode import Outcome
from edge_server.offline.training.setting import Setting
from edge_server.scheduler.learned.decide import Actor
from edge_server.scheduler.learned.rewards import Reward

PerSeed = dict[int, float | None]

# What there is without learning, thresholds and waits aside.
RIVALS = (
    "random", "all", "periodic:500", "round-robin:6", "freshest-k:4", "freshest-k:6", "freshest-k:9",
    "freshest-k:12", "age-driven", "mask", "freshen",
)  # fmt: skip
HINDSIGHT = "hindsight"
_ASKED_AT_ONCE = 400


@dataclass
class Contest:
    """Outcomes by policy and decision. reward: by which they are judged; another one costs nothing."""

    reward: Reward
    outcomes: dict[str, dict[tuple[int, int], Outcome]] = field(default_factory=dict)

    def value(self, outcome: Outcome) -> float | None:
        """Its reward; None where a term is missing: it could not be compared."""
        found = self.reward.of(outcome)
        return found.total if found.complete else None

    def rewards(self, name: str) -> PerSeed:
        """seed -> mean reward of its decisions. ``hindsight``: at every decision the best of all that was
        tried there, which no policy can beat and none can know."""
        if name != HINDSIGHT:
            return _by_seed({at: self.value(o) for at, o in self.outcomes[name].items()})
        best: dict[tuple[int, int], float | None] = {}
        for found in self.outcomes.values():
            for at, outcome in found.items():
                value = self.value(outcome)
                if value is not None:
                    best[at] = max(value, known) if (known := best.get(at)) is not None else value
        return _by_seed(best)

    def term(self, name: str, term: str) -> Interval:
        """Mean of one term of the outcomes over seeds."""
        return interval(
            list(_by_seed({at: getattr(o, term) for at, o in self.outcomes[name].items()}).values())
        )

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
        hindsight among these values alone minus the best fixed one, paired over seeds."""
        names = [name for name in self.outcomes if name.startswith(f"{kind}:")]
        at_all = list(self.outcomes[names[0]])
        table = np.array([[_number(self.value(self.outcomes[n][at])) for n in names] for at in at_all])
        usable = np.isfinite(table).all(axis=1)
        best = table[usable].argmax(axis=1)
        values = np.array([float(n.partition(":")[2]) for n in names])
        top = dict(zip([at for at, ok in zip(at_all, usable) if ok], table[usable].max(axis=1).tolist()))
        gain = paired(_by_seed(top), self.best_fixed(kind)[0])
        quartiles = np.percentile(values[best], [25, 50, 75]) if len(best) else [np.nan] * 3
        return {"quartiles": [float(q) for q in quartiles], "gain": gain}


def hold(
    setting: Setting,
    crew: Crew,
    seeds: Sequence[int],
    rivals: Mapping[str, Maker | Actor],
    reward: Reward,
    say: Any = None,
) -> Contest:
    """Carry out what each of ``rivals`` chooses at every decision of every seed."""
    episodes = crew.draw(setting, seeds)
    asked: list[tuple[str, Asked]] = []
    for place, (name, rival) in enumerate(rivals.items()):
        for moments in episodes:
            if isinstance(rival, Actor):
                acts, _ = rival.act([m.state for m in moments])
                chosen = [of_action(rival.spec, a, m) for a, m in zip(acts, moments)]
            else:
                chosen = choices(rival, moments, place)
            asked += [(name, (m.seed, m.number, c)) for m, c in zip(moments, chosen)]
    contest = Contest(reward)
    for first in range(0, len(asked), _ASKED_AT_ONCE):
        part = asked[first : first + _ASKED_AT_ONCE]
        found = crew.evaluate(setting, [a for _, a in part])
        for (name, (seed, number, _)), outcome in zip(part, found):
            contest.outcomes.setdefault(name, {})[seed, number] = outcome
        if say is not None:
            say(f"{min(first + _ASKED_AT_ONCE, len(asked))}/{len(asked)} evaluations")
    return contest


def rivals(
    omegas_ms: Sequence[float], kinds: Sequence[str], others: Sequence[str] = RIVALS
) -> dict[str, Maker]:
    """The policies without learning that are tried, by name."""
    fixed = [f"{kind}:{omega:g}" for kind in kinds for omega in omegas_ms]
    return {name: named(name) for name in (*others, *fixed)}


def rows(contest: Contest, **labels: Any) -> list[dict[str, Any]]:
    """A row for each policy: its reward, how much that is over random, its share, and the outcomes' terms;
    intervals over seeds. labels: put before all of them."""
    terms = [f.name for f in fields(Outcome)]
    found = []
    for name in [*contest.outcomes, HINDSIGHT]:
        mine = contest.rewards(name)
        intervals = {
            "reward": interval(list(mine.values())),
            "over_random": paired(mine, contest.rewards("random")),
            "share": contest.share(mine),
        }
        row = {**labels, "policy": name}
        for what, i in intervals.items():
            row |= {what: i.mean, f"{what}_low": i.low, f"{what}_high": i.high}
        if name != HINDSIGHT:
            row |= {term: contest.term(name, term).mean for term in terms}
        found.append(row)
    return found


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A CSV of mappings; what one of them lacks stays empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(rows)


def _by_seed(values: Mapping[tuple[int, int], float | None]) -> PerSeed:
    """Mean over each seed's decisions; None where one of them has no value, lest seeds be compared that
    lack different ones."""
    found: dict[int, list[float | None]] = {}
    for (seed, _), value in values.items():
        found.setdefault(seed, []).append(value)
    return {
        seed: None if any(v is None for v in mine) else float(np.mean(np.array(mine, float)))
        for seed, mine in found.items()
    }


def _number(value: float | None) -> float:
    return np.nan if value is None else value
