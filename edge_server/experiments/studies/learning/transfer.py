"""Policies that are trained on one scene and channel and used on another."""

from __future__ import annotations

import dataclasses

from edge_server.experiments.studies.learning.setup import (
    Parts,
    StudyTrainer,
    TrainingStudy,
    better,
    fixed_of,
    named_runs,
    no_worse,
    room,
    simple_policies,
)
from edge_server.experiments.studies.study import StudyRequest, Verdict
from edge_server.experiments.training.scheduler.evaluation import Evaluation, rows
from edge_server.experiments.training.scheduler.setting import Setting

EPISODES = {True: 40, False: 600}
HOME = "room, swing"
AGE = -0.003


def settings(quick: bool) -> dict[str, Setting]:
    """Settings by name: a policy is trained in each, and the one of ``HOME`` is used in all."""
    found = {HOME: room("swing"), "tower, swing": room("swing", scene="tower")}
    more = {"room at 3 m/s, swing": room("swing", speed_m_per_s=3.0), "room, ch6-slow": room("ch6-slow")}
    return found if quick else found | more


class Transfer(TrainingStudy):
    name = "transfer"
    title = "Trained on one scene and channel, used on another"

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        reward = dataclasses.replace(trainer.reward("corrected"), age=AGE)
        places = settings(request.quick)
        config = trainer.config("wait", reward, EPISODES, tries=3)
        trained = {}
        for place, setting in places.items():
            name = f"{self.name}-{place.replace(', ', '-').replace(' ', '-').replace('/', '')}"
            trained[place] = trainer.train_repeats(name, setting, config)
        for place, setting in places.items():
            candidates = {
                **simple_policies("wait"),
                **named_runs("learnt at home", trained[HOME]),
                **named_runs("learnt here", trained[place]),
            }
            evaluation = trainer.evaluate(setting, candidates, reward, len(request.repeats(8, 100)))
            yield judge(place, evaluation), rows(evaluation, place=place)


def judge(place: str, evaluation: Evaluation) -> list[Verdict]:
    """Verdicts on the policies trained in ``HOME`` and used in ``place``, compared with those trained
    there."""
    home, here = evaluation.runs("learnt at home"), evaluation.runs("learnt here")
    best, text = evaluation.best_fixed("wait")[0], fixed_of(evaluation, "wait")
    found = [better(place, f"learnt in {HOME}, better than the best fixed wait here.", home, best, f"against {text}; ")]
    if place != HOME:
        claim = f"learnt in {HOME}, it loses no more than 5 % to what is learnt here."
        found.append(no_worse(place, claim, home, here, evaluation, 0.05))
    return found
