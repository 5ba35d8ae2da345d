"""Reward against training time, with many cheap, noisy rewards or few expensive, exact ones; and reward
against the size of the embedding, in a scene where images can help."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

from edge_server.experiments.common.statistics import crossed
from edge_server.experiments.studies.learning.setup import (
    Parts,
    StudyTrainer,
    TrainingStudy,
    better,
    embeddings_missing,
    named_runs,
    paired_difference,
    room,
    simple_policies,
)
from edge_server.experiments.studies.learning.workshop import PARTS, priced, workshop
from edge_server.experiments.studies.study import StudyRequest, Verdict
from edge_server.experiments.training.scheduler.evaluation import Candidate, Evaluation, baseline_policies, rows
from edge_server.experiments.training.scheduler.setting import layout_of
from edge_server.experiments.training.scheduler.trainer import Row, stage_file
from edge_server.report.style import CYCLE, GRAY, figure, label_lines
from edge_server.scheduler.learned.actor import Actor

EPISODES = {True: 60, False: 600}
# Optimizer steps of the fits that reward in training; fits of JUDGED_STEPS judge the trained policies.
BUDGETS = (10, 25, 50, 100)
QUICK_BUDGETS = (10, 50)
JUDGED_STEPS = 100
# Shares of a training after which its policy is judged.
STAGES = (0.05, 0.1, 0.25, 0.5, 1.0)
DIMS = (0, 4, 32)  # the first: without semantics
# Learning to use an embedding takes longer than learning to use an age.
EPISODES_BY_DIM = {True: 300, False: 1200}


class RewardCost(TrainingStudy):
    name = "reward-cost"
    title = "Reward against the time of training, by the effort of a fit; and against embedding size"

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        parts = {"fit budget": _by_budget, "embedding size": _by_dim}
        for part in request.chosen(list(parts), list(parts)):
            yield parts[part](trainer, request)


def _by_budget(trainer: StudyTrainer, request: StudyRequest) -> tuple[list[Verdict], list[Row]]:
    """Reward against the time of training, by the steps of a fit."""
    budgets = QUICK_BUDGETS if request.quick else BUDGETS
    reward = trainer.reward("set")
    config = trainer.config("select", reward, EPISODES)
    config = dataclasses.replace(config, stages=stages(config.batches))
    trained = {
        steps: trainer.train_repeats(f"reward-cost-{steps}", room("ch5", steps=steps), config) for steps in budgets
    }
    candidates = simple_policies("threshold")
    for steps, stage in itertools.product(budgets, config.stages):
        actors = [Actor.load(stage_file(one.folder, stage)) for one in trained[steps]]
        candidates |= named_runs(_stage_name(steps, stage), actors)
    # Every stage of every training is judged by expensive fits, so on fewer seeds than in other studies.
    judged = room("ch5", steps=JUDGED_STEPS)
    evaluation = trainer.evaluate(judged, candidates, reward, len(request.repeats(8, 40)))
    spent = {
        steps: [spent_s([o.rows for o in runs], stage) for stage in config.stages] for steps, runs in trained.items()
    }
    _draw(request, evaluation, config.stages, spent)
    return judge(evaluation, config.stages, spent), rows(evaluation, what="fit budget")


def stages(batches: int) -> tuple[int, ...]:
    """Numbers of batches after which the policy is judged, at growing intervals."""
    return tuple(sorted({max(1, round(batches * share)) for share in STAGES}))


def spent_s(logs: Sequence[Sequence[Row]], batches: int) -> float:
    """Processor time of the first ``batches`` batches, mean over trainings: episodes, warm fields, fits and
    scores. Each counts with the time that it took when it was carried out, so a training whose fits were
    already known is not cheaper."""
    return sum(row["processor_seconds"] for rows in logs for row in rows[:batches]) / len(logs)


def judge(evaluation: Evaluation, stages: Sequence[int], spent: dict[int, list[float]]) -> list[Verdict]:
    """Verdicts whether training with a cheap reward is better than with an expensive one.

    stages: numbers of batches.
    spent: steps of a fit -> seconds of processor time at each of the stages.
    """
    about = f"room, ch5, judged by fits of {JUDGED_STEPS} steps"
    cheap, dear = min(spent), max(spent)
    curves = {steps: [evaluation.runs(_stage_name(steps, stage)) for stage in stages] for steps in spent}
    text = "; ".join(
        f"{steps} steps a fit "
        + ", ".join(f"{crossed(runs).text(4)} after {at:.1f} s" for runs, at in zip(curves[steps], spent[steps]))
        for steps in spent
    )
    same = paired_difference(curves[cheap][-1], curves[dear][-1])
    same_count = Verdict(
        about,
        "for the same number of decisions a cheap reward teaches as much as a dear one (no worse by 0.01).",
        f"{cheap} less {dear} steps: {same.text(4)}; {text}.",
        same.above(-0.01),
        same,
    )
    claim = f"in the same time {cheap} steps a fit teach more than {dear}."
    theirs = _in_the_same_time(spent[cheap][-1], spent[dear])
    return [
        same_count,
        better(
            about,
            claim,
            curves[cheap][-1],
            curves[dear][theirs],
            f"after {spent[cheap][-1]:.1f} and {spent[dear][theirs]:.1f} s of processor time: ",
        ),
    ]


def _in_the_same_time(limit_s: float, dear: Sequence[float]) -> int:
    """Index of the last stage of the expensive training that took no longer than the cheap one, else 0. (The
    next stage is not used, because a policy may become worse again, and a later loss must not count.)"""
    return max((k for k, seconds in enumerate(dear) if seconds <= limit_s), default=0)


def _stage_name(steps: int, stage: int) -> str:
    return f"{steps} steps, {stage} batches"


def _by_dim(trainer: StudyTrainer, request: StudyRequest) -> tuple[list[Verdict], list[Row]]:
    """Reward against the width of the embedding; empty if no embedder is available."""
    if missing := embeddings_missing():
        print(f"  embedding sizes are left out: {missing}")
        return [], []
    usual = workshop(1.0)
    evaluations: dict[str, Evaluation] = {}
    for dim in DIMS:
        name = f"d = {dim}"
        edge = {**usual.scenario.edge, "embedding": {"dim": dim or DIMS[-1]}}
        setting = dataclasses.replace(usual, scenario=dataclasses.replace(usual.scenario, edge=edge))
        layout = layout_of(setting, PARTS if dim else PARTS[1:])
        reward = priced(trainer, "moving")
        config = trainer.config("select", reward, EPISODES_BY_DIM, layout)
        candidates: dict[str, Candidate] = {
            **baseline_policies((), (), ("random",)),
            **trainer.actors(name, f"reward-cost-d{dim}", setting, config),
        }
        evaluations[name] = trainer.evaluate(setting, candidates, reward, len(request.repeats(10, 100)))
    _draw_dims(request, evaluations)
    found = [row for name, evaluation in evaluations.items() for row in rows(evaluation, what=name)]
    return judge_dims(evaluations), found


def judge_dims(evaluations: dict[str, Evaluation]) -> list[Verdict]:
    """Verdicts whether each embedding is better than none (``d = 0``)."""
    runs = {name: evaluation.runs(name) for name, evaluation in evaluations.items()}
    return [
        better("tower, ch5, somebody moves", f"{name} is better than none.", values, runs["d = 0"])
        for name, values in runs.items()
        if name != "d = 0"
    ]


def _draw(request: StudyRequest, evaluation: Evaluation, stages: Sequence[int], spent: dict[int, list[float]]) -> None:
    with figure(request.out / "reward-cost.png", 1, height_inch=3.0) as (_, axes):
        for k, (steps, seconds) in enumerate(spent.items()):
            means = [crossed(evaluation.runs(_stage_name(steps, stage))).mean for stage in stages]
            axes[0, 0].plot(
                seconds, means, marker="o", markersize=4, color=CYCLE[k % len(CYCLE)], label=f"{steps} steps a fit"
            )
        label_lines(axes[0, 0], f"reward by {JUDGED_STEPS} steps", "seconds of processor time", "What a reward costs")


def _draw_dims(request: StudyRequest, evaluations: dict[str, Evaluation]) -> None:
    """Draw the gain over no embedding against the width of the embedding: paired differences with
    intervals."""
    runs = [evaluation.runs(name) for name, evaluation in evaluations.items()]
    found = [paired_difference(mine, runs[0]) for mine in runs[1:]]
    off = [[one.mean - one.low for one in found], [one.high - one.mean for one in found]]
    with figure(request.out / "reward-cost-dims.png", 1, height_inch=3.0) as (_, axes):
        axes[0, 0].axhline(0.0, color=GRAY, linewidth=1.0)
        axes[0, 0].errorbar(
            [str(dim) for dim in DIMS[1:]], [one.mean for one in found], off, fmt="o", color=CYCLE[0], capsize=3
        )
        label_lines(axes[0, 0], "reward over none", "numbers of an embedding", "What a larger embedding is worth")
