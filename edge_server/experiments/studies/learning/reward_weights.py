"""Sensitivity to the weights of the reward (6.36-6.38): policies trained with each are judged by all."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from edge_server.experiments.common.statistics import any_of
from edge_server.experiments.studies.learning.setup import (
    Parts,
    StudyTrainer,
    TrainingStudy,
    better,
    paired_difference,
    room,
    simple_policies,
)
from edge_server.experiments.studies.study import StudyRequest, Verdict
from edge_server.experiments.training.scheduler.evaluation import Evaluation, rows
from edge_server.scheduler.learned.rewards import Reward

EPISODES = {True: 40, False: 600}


class Weights(TrainingStudy):
    name = "weights"
    title = "Sensitivity to the weights of the reward (6.36-6.38)"

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        setting, rewards, candidates = room("swing"), variants(trainer), simple_policies("wait")
        for name, reward in rewards.items():
            config = trainer.config("wait", reward, EPISODES, tries=3)
            candidates |= trainer.actors(f"learnt {name}", f"{self.name}-{name}", setting, config)
        count = len(request.repeats(8, 100))
        evaluation = trainer.evaluate(setting, candidates, rewards["corrected"], count)
        for name, reward in rewards.items():
            evaluation.reward = reward
            yield judge(evaluation, name, list(rewards)), rows(evaluation, judged_by=name)


def judge(evaluation: Evaluation, name: str, names: Sequence[str]) -> list[Verdict]:
    """Verdicts on the policies trained with the reward ``name`` and with the others of ``names``, all judged
    by ``name``, which is the evaluation's reward."""
    mine, about = evaluation.runs(f"learnt {name}"), f"room, swing, {name}"
    best, fixed = evaluation.best_fixed("wait")
    losses = {o: paired_difference(mine, evaluation.runs(f"learnt {o}")) for o in names if o != name}
    worst = max(losses, key=lambda o: losses[o].mean)
    return [
        better(
            about, "what was learnt by it is better than the best fixed wait.", mine, best, f"the best is {fixed}; "
        ),
        Verdict(
            about,
            "it matters: what was learnt by other weights is worse by these.",
            "; ".join(f"{o} {loss.text(4)}" for o, loss in losses.items()) + f"; most: {worst}.",
            any_of(loss.above(0.0) for loss in losses.values()),
            losses[worst],
        ),
    ]


def variants(trainer: StudyTrainer) -> dict[str, Reward]:
    """Rewards by name: the thesis's, ours with the corrected sign, and variants with a lower weight of
    age."""
    corrected = trainer.reward("corrected")
    return {
        "thesis": trainer.reward("thesis"),
        "corrected": corrected,
        "age a fifth": dataclasses.replace(corrected, age=corrected.age / 5),
        "age a fiftieth": dataclasses.replace(corrected, age=corrected.age / 50),
        "moving": dataclasses.replace(corrected, fidelity="moving", age=corrected.age / 5),
    }
