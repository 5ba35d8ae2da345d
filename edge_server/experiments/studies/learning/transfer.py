"""Trained on one scene and channel, used on another."""

from __future__ import annotations

import dataclasses
from typing import Any

from edge_server.experiments.common.tables import write_csv
from edge_server.experiments.studies.learning.setup import (
    StudyTrainer,
    TrainingStudy,
    better,
    fixed_of,
    named_runs,
    no_worse,
    room,
    runs_of,
)
from edge_server.experiments.studies.study import StudyRequest, Table, Verdict
from edge_server.experiments.training.scheduler.evaluation import Evaluation, baseline_policies, rows
from edge_server.experiments.training.scheduler.setting import OMEGAS_MS, Setting
from edge_server.experiments.training.scheduler.trainer import TrainingConfig
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.state import StateLayout

EPISODES = {True: 40, False: 600}
HOME = "room, swing"
AGE = -0.003


def settings(quick: bool) -> dict[str, Setting]:
    """Where policies are used; they are trained in each, and that of ``HOME`` is used in all."""
    found = {HOME: room("swing"), "tower, swing": room("swing", scene="tower")}
    more = {"room at 3 m/s, swing": room("swing", speed_m_per_s=3.0), "room, ch6-slow": room("ch6-slow")}
    return found if quick else found | more


class Transfer(TrainingStudy):
    name = "transfer"
    title = "Trained on one scene and channel, used on another"

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        del table
        found: list[Verdict] = []
        written: list[dict[str, Any]] = []
        spec = Spec("wait", StateLayout(("age", "pose")), OMEGAS_MS["wait"])
        with StudyTrainer(request) as trainer:
            reward = dataclasses.replace(trainer.reward("corrected"), age=AGE)
            places = settings(request.quick)
            config = TrainingConfig(spec, reward, request.training_episodes(EPISODES), tries=3)
            trained = {
                place: trainer.train_repeats(
                    f"{self.name}-{place.replace(', ', '-').replace(' ', '-').replace('/', '')}",
                    setting, config,
                )
                for place, setting in places.items()
            }  # fmt: skip
            for place, setting in places.items():
                candidates: dict[str, Any] = {
                    **baseline_policies(OMEGAS_MS["wait"], ["wait"], ("random", "all")),
                    **named_runs("learnt at home", trained[HOME]),
                    **named_runs("learnt here", trained[place]),
                }  # fmt: skip
                evaluation = trainer.evaluate(setting, candidates, reward, len(request.repeats(8, 100)))
                written += rows(evaluation, place=place)
                found += judge(place, evaluation)
        write_csv(request.out / f"{self.name}.csv", written)
        return found


def judge(place: str, evaluation: Evaluation) -> list[Verdict]:
    """How what was learnt at home does at a place, beside what was learnt there."""
    home, here = runs_of(evaluation, "learnt at home"), runs_of(evaluation, "learnt here")
    best, text = evaluation.best_fixed("wait")[0], fixed_of(evaluation, "wait")
    found = [better(place, f"learnt in {HOME}, better than the best fixed wait here.", home, best,
                    f"against {text}; ")]  # fmt: skip
    if place != HOME:
        claim = f"learnt in {HOME}, it loses no more than 5 % to what is learnt here."
        found.append(no_worse(place, claim, home, here, evaluation, 0.05))
    return found
