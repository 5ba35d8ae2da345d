"""Cases of studies of learned schedulers: resumable trainings, and the evaluation of what they learned.

The batches of a training depend on each other: its checkpoints are in OUT/training. Evaluations are in OUT/results.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from edge_server.experiments.common.seed_table import TRAINING, Row
from edge_server.experiments.engine.content_key import code_digest
from edge_server.experiments.experiment_constants import QUICK_SPLAT, SCRATCH_STEPS, TRAINING_STEPS
from edge_server.experiments.rollouts.setting import Setting, layout_of, reward_of, seeds
from edge_server.experiments.studies.study import StudyRequest, open_engine, print_once
from edge_server.experiments.studies.study_constants import TRAININGS
from edge_server.experiments.studies.trial import Trial
from edge_server.experiments.training.evaluation import Candidate, evaluate, fixed_candidates
from edge_server.experiments.training.learning_curve import draw_curve
from edge_server.experiments.training.trainer import TrainingConfig, read_log, train
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.learner_spec import Action, Spec
from edge_server.scheduler.learned.learning_constants import OMEGAS_MS

SIZE = 64
FOUR_VIEWPOINTS = ("cam00", "cam04", "cam09", "cam17")
# Cameras that judge trained policies: they give no reward and no update uses them.
REPORT = ("cam05", "cam08")


@dataclass(frozen=True)
class RewardChoice:
    """A preset of the reward, the pixels of its PSNR, and weights in place of the preset's."""

    name: str
    on: str = "whole"
    weights: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Training:
    """A training of a case.

    policy: name of the learned policy in the table.
    action: what it decides.
    episodes: by whether it is a quick pass.
    parts: of the state.
    reward: None: the case's first.
    setting: where it learns; None: where the case judges.
    """

    policy: str
    action: Action
    episodes: Mapping[bool, int]
    parts: tuple[str, ...] = ("age", "pose")
    reward: RewardChoice | None = None
    setting: Setting | None = None


@dataclass(frozen=True)
class LearningCase:
    """Trainings and the fixed policies that they are compared with.

    name: of the case; ``--case`` selects by it, and it is a label of the rows.
    setting: where policies are judged.
    rewards: by name; with several, rows have the label ``judged_by``.
    fixed: kinds of fixed policies, each of all values. others: further policies.
    seeds: number of test seeds of a quick and of a full pass.
    """

    name: str
    setting: Setting
    rewards: Mapping[str, RewardChoice]
    trainings: Sequence[Training]
    fixed: Sequence[str]
    others: Sequence[str] = ("random", "all")
    seeds: tuple[int, int] = (10, 100)


def room(channel: Mapping[str, Any] | str = "ch5", **more: Any) -> Setting:
    """The usual setting: a room at 64 x 64, nineteen cameras and a warm splat field.

    channel: a preset, or the section of a scenario.
    more: fields of ``Setting``, ``scratch=True`` as in the thesis; held_out: cameras that reward.
    """
    section = {"preset": channel} if isinstance(channel, str) else dict(channel)
    held_out = more.pop("held_out", ("cam00",))
    scenario = Trial("room", 0, section, size=SIZE, field_options=QUICK_SPLAT).scenario()
    apart = tuple(c for c in scenario.cameras if c in {*held_out, *REPORT})
    scenario = dataclasses.replace(scenario, held_out=apart)
    return Setting(
        scenario, report=REPORT, **{"steps": SCRATCH_STEPS if more.get("scratch") else TRAINING_STEPS, **more}
    )


Cases = Callable[[StudyRequest], Sequence[LearningCase]]


def measure(name: str) -> Callable[[Sequence[LearningCase], StudyRequest], list[Row]]:
    """The rows of a study's cases: a row for each policy, training and test seed, judged by the cameras that report,
    and by those that rewarded (label ``judged_from``)."""

    def of_cases(cases: Sequence[LearningCase], request: StudyRequest) -> list[Row]:
        return [row for case in cases for row in _of_case(name, case, request)]

    return of_cases


def _of_case(name: str, case: LearningCase, request: StudyRequest) -> list[Row]:
    candidates = fixed_candidates(case.fixed, case.others)
    first = next(iter(case.rewards.values()))
    for training in case.trainings:
        for run in range(TRAININGS[request.quick]):
            actor = _train(name, case, training, training.reward or first, run, request)
            candidates.append(Candidate({"policy": training.policy, TRAINING: run}, actor))
    count = len(request.repeats(*case.seeds))
    with open_engine(request, name, threads=1) as engine:
        found = evaluate(case.setting, request.folders, engine, seeds(0, "test", count), candidates)
    views = {"elsewhere": case.setting.judging, "where it is rewarded": case.setting.rewarding}
    rewards = {judge: _reward(choice, request) for judge, choice in case.rewards.items()}
    return [
        row
        for judge, reward in rewards.items()
        for label, cameras in views.items()
        for row in found.rows(reward, cameras, case=case.name, judged_by=judge, judged_from=label)
    ]


def _train(
    name: str, case: LearningCase, training: Training, choice: RewardChoice, run: int, request: StudyRequest
) -> Actor:
    """Carry out a training, or read it if it is finished; draws its curve into the request's folder."""
    setting = training.setting or case.setting
    spec = Spec(training.action, layout_of(setting, training.parts), OMEGAS_MS.get(training.action, ()))
    episodes = request.episodes or training.episodes[request.quick]
    samples = 2 if training.action == "select" else 3
    config = TrainingConfig(spec, _reward(choice, request), episodes, samples=samples, seed=run)
    # Trainings with other settings or code have separate folders.
    about = code_digest() + setting.key + repr(dataclasses.asdict(config))
    label = f"{name}-{case.name}-{training.policy}-{run}".replace(" ", "-").replace(",", "").replace("/", "-")
    folder = request.out / "training" / f"{label}-{hashlib.sha256(about.encode()).hexdigest()[:8]}"
    say = partial(print, f"  {label}:", flush=True)
    learner = train(setting, config, request.folders, request.jobs, folder, say, request.ray)
    draw_curve(request.figure(f"{label}.png"), read_log(folder))
    return learner.actor


def _reward(choice: RewardChoice, request: StudyRequest) -> Any:
    """A preset reward; prints a line, once, if its LPIPS term must be left out."""
    reward, missing = reward_of(choice.name, choice.on, request.folders.lpips)
    if missing:
        print_once(missing)
    weights: dict[str, Any] = dict(choice.weights)
    return dataclasses.replace(reward, **weights)
