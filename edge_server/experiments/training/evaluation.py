"""Evaluates policies on seeds that were never trained on, decision by decision.

All policies decide at the same instants on the same deliveries, and every update starts from the same field,
so differences are paired. All held-out cameras score every fit once; whose scores count is chosen afterwards.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import PerSeed, Row
from edge_server.experiments.common.tables import complete_mean
from edge_server.experiments.engine import Engine
from edge_server.experiments.experiment_constants import EVALUATION_FITS
from edge_server.experiments.rollouts.episode import Outcome, mean_outcome
from edge_server.experiments.rollouts.rollout import run_rollouts
from edge_server.experiments.rollouts.setting import Setting
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.learning_constants import OMEGAS_MS
from edge_server.scheduler.learned.rewards import Reward

At = tuple[int, int]
"""Seed of an episode and number of a decision."""


@dataclass(frozen=True)
class Candidate:
    """A policy and its labels in the table, at least ``policy``."""

    labels: Row
    actor: str | Actor


def fixed_candidates(kinds: Iterable[str], others: Sequence[str] = ("random", "all")) -> list[Candidate]:
    """Every fixed value of each of ``kinds`` (threshold, wait), labeled ``policy`` and ``value``, and ``others``."""
    values = [
        Candidate({"policy": kind, "value": omega}, f"{kind}:{omega:g}") for kind in kinds for omega in OMEGAS_MS[kind]
    ]
    return [*(Candidate({"policy": name}, name) for name in others), *values]


@dataclass(frozen=True)
class Evaluation:
    """Outcomes of the ``candidates``: for each of them, decision -> its fits -> by camera."""

    candidates: list[Candidate]
    fits: list[dict[At, list[dict[str, Outcome]]]]

    def rows(self, reward: Reward, cameras: Sequence[str], **labels: Any) -> list[Row]:
        """A row for each candidate and seed: the mean ``reward`` of its decisions as ``cameras`` see them, and the
        means of the outcomes; None if a decision lacks a term. Decisions at which nobody has a reward (nothing moves
        in the images that score) are left out for all.

        labels: further labels of every row.
        """
        outcomes = [
            {at: [mean_outcome([fit[c] for c in cameras]) for fit in fits] for at, fits in of.items()}
            for of in self.fits
        ]
        values = [{at: [_value(reward, o) for o in fits] for at, fits in of.items()} for of in outcomes]
        scored = {at for of in values for at, fits in of.items() if any(v is not None for v in fits)}
        found = []
        for candidate, of, rated in zip(self.candidates, outcomes, values):
            mine: dict[str, PerSeed] = {
                "reward": _by_seed({at: complete_mean(fits) for at, fits in rated.items()}, scored)
            }
            for term in (f.name for f in fields(Outcome)):
                mine[term] = _by_seed({at: complete_mean([getattr(o, term) for o in fits]) for at, fits in of.items()})
            own = {**labels, **candidate.labels}
            found += [{**own, "seed": seed, **{n: v.get(seed) for n, v in mine.items()}} for seed in mine["reward"]]
        return found


def evaluate(
    setting: Setting, folders: Folders, engine: Engine, seeds: Sequence[int], candidates: Sequence[Candidate]
) -> Evaluation:
    """Carry out the choice of every candidate at every decision of every seed twice, with fields of different seeds,
    and score it from all held-out cameras."""
    names = [str(k) for k in range(len(candidates))]
    found = run_rollouts(
        engine,
        setting,
        folders,
        seeds,
        {name: c.actor for name, c in zip(names, candidates)},
        name="evaluation",
        cameras=setting.scenario.held_out,
        repeats=EVALUATION_FITS,
    )
    fits = [
        {
            (seed, number): [runs[0].decided[number].outcomes for runs in repeats]
            for seed, repeats in found[name].items()
            for number in range(len(repeats[0][0].decided))
        }
        for name in names
    ]
    return Evaluation(list(candidates), fits)


def _value(reward: Reward, outcome: Outcome) -> float | None:
    found = reward.of(outcome)
    return found.total if found.complete else None


def _by_seed(values: Mapping[At, float | None], kept: Iterable[At] | None = None) -> PerSeed:
    """Mean over each seed's decisions, those of ``kept``. None if one of them has no value, because seeds that lack
    different decisions cannot be compared, or if all are left out."""
    found: dict[int, list[float | None]] = {}
    for (seed, number), value in values.items():
        mine = found.setdefault(seed, [])
        if kept is None or (seed, number) in kept:  # type: ignore[operator]  # a set
            mine.append(value)
    return {seed: complete_mean(mine) for seed, mine in found.items()}
