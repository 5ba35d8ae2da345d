"""What accuracy costs in time when it is the reward's: a cheap noisy reward often or an exact slow one; and
what a larger embedding is worth where it can matter to look."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

from edge_server.experiments.common.statistics import crossed
from edge_server.experiments.common.tables import write_csv
from edge_server.experiments.studies.learning.setup import (
    StudyTrainer,
    TrainedPolicy,
    TrainingStudy,
    better,
    embeddings_missing,
    named_runs,
    paired_difference,
    room,
    runs_of,
)
from edge_server.experiments.studies.learning.workshop import PARTS, priced, workshop
from edge_server.experiments.studies.study import StudyRequest, Table, Verdict, by_bool
from edge_server.experiments.training.scheduler.evaluation import Evaluation, baseline_policies, rows
from edge_server.experiments.training.scheduler.report import span
from edge_server.experiments.training.scheduler.setting import OMEGAS_MS, layout_of
from edge_server.experiments.training.scheduler.trainer import Row, TrainingConfig, stage_file
from edge_server.report.style import CYCLE, GREY, figure, label_lines
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.state import StateLayout

EPISODES = {True: 60, False: 600}
# Optimiser steps of a fit that is a reward in training; what is learnt is judged by fits of JUDGED_STEPS.
BUDGETS = (10, 25, 50, 100)
QUICK_BUDGETS = (10, 50)
JUDGED_STEPS = 100
# Shares of a training after which what has been learnt is judged.
STAGES = (0.05, 0.1, 0.25, 0.5, 1.0)
DIMS = (0, 4, 32)  # the first: without semantics
# An embedding is learnt to be used more slowly than an age.
EPISODES_BY_DIM = {True: 300, False: 1200}


class RewardCost(TrainingStudy):
    name = "reward-cost"
    title = "Reward against the time of training, by the effort of a fit; and against embedding size"

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        del table
        parts = {"fit budget": _by_budget, "embedding size": _by_dim}
        written: list[dict[str, Any]] = []
        found: list[Verdict] = []
        with StudyTrainer(request) as trainer:
            for part in request.chosen(list(parts), list(parts)):
                more, verdicts = parts[part](trainer, request)
                written, found = written + more, found + verdicts
        write_csv(request.out / f"{self.name}.csv", written)
        return found


def _by_budget(trainer: StudyTrainer, request: StudyRequest) -> tuple[list[dict[str, Any]], list[Verdict]]:
    """Reward against the time of training, by the steps of a fit."""
    budgets = QUICK_BUDGETS if request.quick else BUDGETS
    reward = trainer.reward("set")
    config = TrainingConfig(
        Spec("select", StateLayout(("age", "pose"))), reward, request.training_episodes(EPISODES)
    )
    config = dataclasses.replace(config, stages=stages(config.batches))
    trained = {steps: trainer.train_repeats(f"reward-cost-{steps}", room("ch5", steps=steps), config)
              for steps in budgets}  # fmt: skip
    candidates: dict[str, Any] = {
        **baseline_policies(OMEGAS_MS["threshold"], ["threshold"], ("random", "all")),
    }
    for steps, stage in itertools.product(budgets, config.stages):
        then = [_then(one, stage) for one in trained[steps]]
        candidates |= named_runs(_called(steps, stage), then)
    # Everything at every stage of every training, by dear fits: fewer seeds than elsewhere.
    judged = room("ch5", steps=JUDGED_STEPS)
    evaluation = trainer.evaluate(judged, candidates, reward, len(request.repeats(8, 40)))
    spent = {steps: [spent_s([o.rows for o in runs], stage) for stage in config.stages]
             for steps, runs in trained.items()}  # fmt: skip
    _draw(request, evaluation, config.stages, spent)
    return rows(evaluation, what="fit budget"), judge(evaluation, config.stages, spent)


def stages(batches: int) -> tuple[int, ...]:
    """After how many batches what has been learnt is judged: early often, then at ever longer intervals."""
    return tuple(sorted({max(1, round(batches * share)) for share in STAGES}))


def spent_s(logs: Sequence[Sequence[Row]], batches: int) -> float:
    """Processor time of the first so many batches, mean over trainings: of drawing their episodes, and of
    warm fields, fits and scores, most of which does not shrink with the effort of a fit. Each counts as what
    it took when it was carried out, so that a training whose fits were known already is no cheaper."""
    return sum(row["processor_seconds"] for rows in logs for row in rows[:batches]) / len(logs)


def judge(evaluation: Evaluation, stages: Sequence[int], spent: dict[int, list[float]]) -> list[Verdict]:
    """Whether a cheap reward has taught more when a dear one has had as much time, all judged by the
    contest's fits. spent: budget -> seconds of processor time at each of the stages."""
    about = f"room, ch5, judged by fits of {JUDGED_STEPS} steps"
    cheap, dear = min(spent), max(spent)
    curves = {steps: [runs_of(evaluation, _called(steps, stage)) for stage in stages] for steps in spent}
    text = "; ".join(
        f"{steps} steps a fit " + ", ".join(f"{span(crossed(runs))} after {at:.1f} s"
                                            for runs, at in zip(curves[steps], spent[steps]))
        for steps in spent
    )  # fmt: skip
    same = paired_difference(curves[cheap][-1], curves[dear][-1])
    number = Verdict(
        about,
        "for the same number of decisions a cheap reward teaches as much as a dear one (no worse by 0.01).",
        f"{cheap} less {dear} steps: {span(same)}; {text}.",
        by_bool(same.above(-0.01)),
    )
    claim = f"in the same time {cheap} steps a fit teach more than {dear}."
    theirs = _in_the_same_time(spent[cheap][-1], spent[dear])
    return [
        number,
        better(about, claim, curves[cheap][-1], curves[dear][theirs],
               f"after {spent[cheap][-1]:.1f} and {spent[dear][theirs]:.1f} s of processor time: "),
    ]  # fmt: skip


def _in_the_same_time(limit_s: float, dear: Sequence[float]) -> int:
    """The last stage of the dear one that took no longer than the cheap one; its first, if none did. (Not the
    next that took longer: what is learnt may be lost again, and a loss that came later would count.)"""
    return max((k for k, seconds in enumerate(dear) if seconds <= limit_s), default=0)


def _called(steps: int, stage: int) -> str:
    return f"{steps} steps, {stage} batches"


def _then(trained: TrainedPolicy, batches: int) -> Actor:
    """What it had learnt after so many batches."""
    return Actor.load(stage_file(trained.folder, batches))


def _by_dim(trainer: StudyTrainer, request: StudyRequest) -> tuple[list[dict[str, Any]], list[Verdict]]:
    """Reward against the width of the embedding; nothing where there are no embeddings."""
    if missing := embeddings_missing():
        print(f"  embedding sizes are left out: {missing}")
        return [], []
    usual = workshop(1.0)
    contests: dict[str, Evaluation] = {}
    for dim in DIMS:
        edge = {**usual.scenario.edge, "embedding": {"dim": dim or DIMS[-1]}}
        setting = dataclasses.replace(usual, scenario=dataclasses.replace(usual.scenario, edge=edge))
        layout = layout_of(setting, PARTS if dim else PARTS[1:])
        reward = priced(trainer, "moving")
        config = TrainingConfig(Spec("select", layout), reward, request.training_episodes(EPISODES_BY_DIM))
        trained = trainer.train_repeats(f"reward-cost-d{dim}", setting, config)
        candidates: dict[str, Any] = {
            **baseline_policies((), (), ("random",)),
            **named_runs(f"d = {dim}", trained),
        }
        contests[f"d = {dim}"] = trainer.evaluate(setting, candidates, reward, len(request.repeats(10, 100)))
    _draw_dims(request, contests)
    return [row for name, c in contests.items() for row in rows(c, what=name)], judge_dims(contests)


def judge_dims(contests: dict[str, Evaluation]) -> list[Verdict]:
    """Whether each embedding is worth more than none, ``d = 0``."""
    runs = {name: runs_of(evaluation, name) for name, evaluation in contests.items()}
    return [better("tower, ch5, somebody moves", f"{name} is better than none.", values, runs["d = 0"])
            for name, values in runs.items() if name != "d = 0"]  # fmt: skip


def _draw(
    request: StudyRequest, evaluation: Evaluation, stages: Sequence[int], spent: dict[int, list[float]]
) -> None:
    with figure(request.out / "reward-cost.png", 1, height_inch=3.0) as (_, axes):
        for k, (steps, seconds) in enumerate(spent.items()):
            means = [crossed(runs_of(evaluation, _called(steps, stage))).mean for stage in stages]
            axes[0, 0].plot(seconds, means, marker="o", markersize=4, color=CYCLE[k % len(CYCLE)],
                            label=f"{steps} steps a fit")  # fmt: skip
        label_lines(axes[0, 0], f"reward by {JUDGED_STEPS} steps", "seconds of processor time",
                    "What a reward costs")  # fmt: skip


def _draw_dims(request: StudyRequest, contests: dict[str, Evaluation]) -> None:
    """What is learnt over what is learnt without, against the width of the embedding: paired differences with
    their intervals."""
    runs = [runs_of(evaluation, name) for name, evaluation in contests.items()]
    found = [paired_difference(mine, runs[0]) for mine in runs[1:]]
    off = [[one.mean - one.low for one in found], [one.high - one.mean for one in found]]
    with figure(request.out / "reward-cost-dims.png", 1, height_inch=3.0) as (_, axes):
        axes[0, 0].axhline(0.0, color=GREY, linewidth=1.0)
        axes[0, 0].errorbar([str(dim) for dim in DIMS[1:]], [one.mean for one in found], off, fmt="o",
                            color=CYCLE[0], capsize=3)  # fmt: skip
        label_lines(axes[0, 0], "reward over none", "numbers of an embedding",
                    "What a larger embedding is worth")  # fmt: skip
