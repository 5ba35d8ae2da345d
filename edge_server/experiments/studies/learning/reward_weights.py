"""How much the weights of a reward matter (6.36-6.38): policies trained with each are judged by all."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from edge_server.experiments.common.statistics import any_of
from edge_server.experiments.studies.learning.setup import (
    Parts,
    StudyTrainer,
    TrainingStudy,
    better,
    named_runs,
    paired_difference,
    room,
    runs_of,
    simple_policies,
)
from edge_server.experiments.studies.study import StudyRequest, Verdict, by_bool
from edge_server.experiments.training.scheduler.evaluation import Evaluation, rows
from edge_server.experiments.training.scheduler.report import span
from edge_server.experiments.training.scheduler.setting import OMEGAS_MS
from edge_server.experiments.training.scheduler.trainer import TrainingConfig
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.rewards import Reward
from edge_server.scheduler.learned.state import StateLayout

EPISODES = {True: 40, False: 600}


class Weights(TrainingStudy):
    name = "weights"
    title = "Sensitivity to the weights of the reward (6.36-6.38)"

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        setting, spec = room("swing"), Spec("wait", StateLayout(("age", "pose")), OMEGAS_MS["wait"])
        rewards, candidates = variants(trainer), simple_policies("wait")
        for name, reward in rewards.items():
            config = TrainingConfig(spec, reward, request.training_episodes(EPISODES), tries=3)
            trained = trainer.train_repeats(f"{self.name}-{name}", setting, config)
            candidates |= named_runs(f"learnt {name}", trained)
        count = len(request.repeats(8, 100))
        evaluation = trainer.evaluate(setting, candidates, rewards["corrected"], count)
        for name, reward in rewards.items():
            evaluation.reward = reward
            yield judge(evaluation, name, list(rewards)), rows(evaluation, judged_by=name)


def judge(evaluation: Evaluation, name: str, names: Sequence[str]) -> list[Verdict]:
    """Verdicts on the policies trained with the reward ``name`` and with the others of ``names``, all judged
    by ``name``, which is the evaluation's reward."""
    mine, about = runs_of(evaluation, f"learnt {name}"), f"room, swing, {name}"
    best, fixed = evaluation.best_fixed("wait")
    losses = {o: paired_difference(mine, runs_of(evaluation, f"learnt {o}")) for o in names if o != name}
    worst = max(losses, key=lambda o: losses[o].mean)
    return [
        better(about, "what was learnt by it is better than the best fixed wait.", mine, best,
               f"the best is {fixed}; "),
        Verdict(about, "it matters: what was learnt by other weights is worse by these.",
                "; ".join(f"{o} {span(loss)}" for o, loss in losses.items()) + f"; most: {worst}.",
                by_bool(any_of(loss.above(0.0) for loss in losses.values())), losses[worst]),
    ]  # fmt: skip


def variants(trainer: StudyTrainer) -> dict[str, Reward]:
    """Rewards by name: the thesis's, ours with the corrected sign, and ages that count less."""
    corrected = trainer.reward("corrected")
    return {
        "thesis": trainer.reward("thesis"),
        "corrected": corrected,
        "age a fifth": dataclasses.replace(corrected, age=corrected.age / 5),
        "age a fiftieth": dataclasses.replace(corrected, age=corrected.age / 50),
        "moving": dataclasses.replace(corrected, fidelity="moving", age=corrected.age / 5),
    }
