"""Code shared by the studies of learned schedulers: settings, resumable trainings, evaluations and verdicts.

The batches of a training depend on each other, so the engine cannot run it. Its checkpoints are stored below
OUT/training, and evaluations in OUT/training/evaluations.jsonl; the same command resumes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from camera_node.config import WorldConfig, source_config
from edge_server.experiments.common.source_digest import source_digest
from edge_server.experiments.common.statistics import Interval, crossed, interval
from edge_server.experiments.studies.study import Study, StudyRequest, Table, Verdict
from edge_server.experiments.studies.trial import Trial
from edge_server.experiments.training.scheduler.evaluation import (
    HINDSIGHT,
    Candidate,
    Evaluation,
    PerSeed,
    baseline_policies,
    evaluate_policies,
)
from edge_server.experiments.training.scheduler.report import draw_curve
from edge_server.experiments.training.scheduler.setting import OMEGAS_MS, Setting, reward_of, seeds
from edge_server.experiments.training.scheduler.trainer import Row, TrainingConfig, read_log, train
from edge_server.experiments.training.scheduler.workers import WorkerPool
from edge_server.experiments.virtual.from_scenario import exact_scene
from edge_server.scheduler import Epoch, Policy, SelectionWindow
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.learner_spec import Action, Spec
from edge_server.scheduler.learned.rewards import Reward
from edge_server.scheduler.learned.state import StateLayout
from freshfield.files import write_csv, write_json

FIELD = "splat"
FIELD_OPTIONS = {"effort": "low"}
SIZE = 64
FOUR_VIEWPOINTS = ("cam00", "cam04", "cam09", "cam17")
# Cameras that judge trained policies: they give no reward and no update uses them.
REPORT = ("cam05", "cam08")
# Number of repeated trainings, by whether it is a quick pass; their spread is part of the interval.
RUNS = {True: 1, False: 3}

AGE_AND_POSE = StateLayout(("age", "pose"))

Runs = Sequence[PerSeed]
"""Rewards by seed, of each of several trainings that differ only in their random seed."""
Part = tuple[list[Verdict], list[Row]]
"""Verdicts and rows of the table of one case of a study."""
Parts = Iterator[Part]


class TrainingStudy(Study):
    """Base class of the studies that train policies; they have no independent trials."""

    def report(self, request: StudyRequest, table: Table | None) -> list[Verdict]:
        """Train, evaluate, write OUT/NAME.csv and return the verdicts. table: not used."""
        verdicts: list[Verdict] = []
        rows: list[Row] = []
        with StudyTrainer(request) as trainer:
            for more_verdicts, more_rows in self.run(trainer, request):
                verdicts, rows = verdicts + more_verdicts, rows + more_rows
        write_csv(request.out / f"{self.name}.csv", rows)
        return verdicts

    def run(self, trainer: StudyTrainer, request: StudyRequest) -> Parts:
        """The verdicts and the rows of the table, part by part."""
        raise NotImplementedError


@dataclass(frozen=True)
class TrainedPolicy:
    """A finished training.

    name: its name in tables and the start of its folder's name.
    actor: the trained policy.
    rows: rows of its log.
    seconds: wall-clock time of the training with ``jobs`` processes.
    folder: folder with policy.npz.
    """

    name: str
    actor: Actor
    rows: list[Row]
    seconds: float
    jobs: int
    folder: Path


def room(
    channel: Mapping[str, Any] | str = "ch5",
    *,
    scene: str = "room",
    speed_m_per_s: float = 1.0,
    held_out: tuple[str, ...] = ("cam00",),
    report: tuple[str, ...] = REPORT,
    **more: Any,
) -> Setting:
    """The usual setting: a world at 64 x 64, nineteen cameras and a warm splat field.

    channel: a preset, or the section of a scenario.
    held_out: cameras that reward.
    report: cameras that judge.
    more: fields of ``Setting``; ``scratch=True`` as in the thesis.
    """
    section = {"preset": channel} if isinstance(channel, str) else dict(channel)
    trial = Trial(scene, 0, section, size=SIZE, field=FIELD, field_options=FIELD_OPTIONS, speed_m_per_s=speed_m_per_s)
    scenario = trial.scenario()
    apart = tuple(c for c in scenario.cameras if c in {*held_out, *report})
    scenario = dataclasses.replace(scenario, held_out=apart)
    return Setting(scenario, report=report, **{"steps": 50 if more.get("scratch") else 20, **more})


def simple_policies(kind: str, others: Sequence[str] = ("random", "all")) -> dict[str, Candidate]:
    """All fixed values of ``kind`` (threshold, wait) and ``others``, by name."""
    return dict(baseline_policies(OMEGAS_MS[kind], [kind], others))


class Nearest(Policy):
    """Selects the k cameras nearest to the reward cameras, independent of ages. This baseline knows the
    reward cameras but ignores the state."""

    name = "nearest"
    parameter = "k"

    def __init__(self, setting: Setting, k: int) -> None:
        self.value = float(k)
        source = cast(WorldConfig, source_config(setting.scenario))
        scene, _ = exact_scene(setting.scenario, source)
        stand = {camera: pose[:3, 3] for camera, (_, pose) in scene.cameras.items()}
        watched = [stand[camera] for camera in setting.rewarding]
        far = {c: min(float(np.linalg.norm(stand[c] - w)) for w in watched) for c in setting.scenario.training}
        self._order = sorted(far, key=lambda c: far[c])
        self._k = k

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        near = set([c for c in self._order if c in epoch.generated_ns][: self._k])
        return tuple(c for c in epoch.generated_ns if c in near)


@dataclass
class StudyTrainer:
    """Trains and evaluates policies of one study; a context manager that owns the worker pool."""

    request: StudyRequest
    pool: WorkerPool = field(init=False)
    _printed_missing: bool = False

    def __post_init__(self) -> None:
        self.folder = self.request.out / "training"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.pool = WorkerPool(self.request.folders, self.request.jobs, self.folder / "evaluations.jsonl")

    def __enter__(self) -> StudyTrainer:
        return self

    def __exit__(self, *error: object) -> None:
        self.pool.__exit__(*error)

    def reward(self, name: str, on: str = "whole") -> Reward:
        """A preset reward; prints a line once if its LPIPS term must be left out."""
        reward, missing = reward_of(name, on, self.request.folders.lpips)
        if missing and not self._printed_missing:
            print(f"  {missing}")
            self._printed_missing = True
        return reward

    def train_one(self, name: str, setting: Setting, config: TrainingConfig) -> TrainedPolicy:
        """Carry out a training, or read it if it is finished; draws its curve to OUT/NAME.png."""
        # Trainings with other settings or code have separate folders.
        about = source_digest() + setting.key + repr(dataclasses.asdict(config))
        folder = self.folder / f"{name}-{hashlib.sha256(about.encode()).hexdigest()[:8]}"
        jobs_file = folder / "jobs.json"
        learner = train(setting, config, self.pool, folder, lambda line: print(f"  {name}: {line}", flush=True))
        rows = read_log(folder)
        draw_curve(self.request.out / f"{name}.png", rows)
        if not jobs_file.exists():
            write_json(jobs_file, self.request.jobs)
        seconds = sum(row["seconds"] for row in rows)
        jobs = int(json.loads(jobs_file.read_text()))
        return TrainedPolicy(name, learner.actor, rows, seconds, jobs, folder)

    def train_repeats(self, name: str, setting: Setting, config: TrainingConfig) -> list[TrainedPolicy]:
        """Repeat a training ``RUNS`` times, with different episodes and initial values."""
        return [
            self.train_one(f"{name}-{run}", setting, dataclasses.replace(config, seed=run))
            for run in range(RUNS[self.request.quick])
        ]

    def config(
        self,
        action: Action,
        reward: Reward,
        episodes: Mapping[bool, int],
        layout: StateLayout = AGE_AND_POSE,
        **more: Any,
    ) -> TrainingConfig:
        """The usual training of a learner that decides ``action``.

        episodes: number of episodes, by whether it is a quick pass.
        more: further arguments of ``TrainingConfig``.
        """
        spec = Spec(action, layout, OMEGAS_MS.get(action, ()))
        return TrainingConfig(spec, reward, self.request.episodes or episodes[self.request.quick], **more)

    def actors(self, label: str, name: str, setting: Setting, config: TrainingConfig) -> dict[str, Actor]:
        """The actors of repeated trainings as candidates ``LABEL-0``, ``LABEL-1``, ..."""
        return named_runs(label, self.train_repeats(name, setting, config))

    def evaluate(
        self, setting: Setting, candidates: Mapping[str, Candidate], reward: Reward, count: int, seed: int = 0
    ) -> Evaluation:
        """Evaluate candidates on ``count`` seeds that are not used in training, scored by the reporting
        cameras, which never reward."""
        return self.evaluate_as_rewarded(setting.judged, candidates, reward, count, seed)

    def evaluate_as_rewarded(
        self, setting: Setting, candidates: Mapping[str, Candidate], reward: Reward, count: int, seed: int = 0
    ) -> Evaluation:
        """As ``evaluate``, but scored by the rewarding cameras; it supplements the other evaluation."""
        return evaluate_policies(
            setting,
            self.pool,
            seeds(seed, "test", count),
            candidates,
            reward,
            lambda line: print(f"  evaluation: {line}", flush=True),
        )


def embeddings_missing() -> str | None:
    """One-line reason why policies cannot use images here; None if they can."""
    from edge_server.embed import EmbeddingConfig, EmbeddingError, make_embedder

    try:
        make_embedder(EmbeddingConfig())
    except EmbeddingError as error:
        return str(error)
    return None


def fixed_of(evaluation: Evaluation, kind: str) -> str:
    """Name and reward of the best fixed policy of a kind, as text."""
    values, name = evaluation.best_fixed(kind)
    return f"{name} {interval(values.values()).text(4)}"


def mean_of(runs: Runs) -> PerSeed:
    """Mean reward of repeated trainings, by test seed. Only for texts: its interval would ignore the
    differences between trainings."""
    found: PerSeed = {}
    for s in runs[0]:
        values = [v for run in runs if (v := run[s]) is not None]
        found[s] = sum(values) / len(runs) if len(values) == len(runs) else None
    return found


def named_runs(name: str, trained: Sequence[TrainedPolicy | Actor]) -> dict[str, Actor]:
    """The actors of repeated trainings as candidates ``NAME-0``, ``NAME-1``, ..."""
    return {f"{name}-{run}": one.actor if isinstance(one, TrainedPolicy) else one for run, one in enumerate(trained)}


def paired_difference(mine: PerSeed | Runs, other: PerSeed | Runs) -> Interval:
    """Paired difference over seeds and over repeated trainings: run r of one is paired with run r of the
    other, which was trained on the same episodes."""
    ours, theirs = _runs(mine), _runs(other)
    if len(theirs) == 1:
        theirs = list(theirs) * len(ours)
    if len(ours) == 1:
        ours = list(ours) * len(theirs)
    differences: list[PerSeed] = [
        {s: None if (x := a[s]) is None or (y := b.get(s)) is None else x - y for s in a}
        for a, b in zip(ours, theirs, strict=True)
    ]
    return crossed(differences)


def _runs(values: PerSeed | Runs) -> Runs:
    return [values] if isinstance(values, dict) else values


def _describe_difference(found: Interval, runs: int) -> str:
    """The difference as text, with the numbers of trainings and seeds of its interval."""
    trainings = f"{runs} trainings and " if runs > 1 else ""
    alone = "" if runs > 1 else " of a single training"
    return f"difference {found.text(4)} over {trainings}{found.count} seeds{alone}"


def better(about: str, claim: str, mine: PerSeed | Runs, other: PerSeed | Runs, found: str = "") -> Verdict:
    """The verdict whether ``mine`` is better than ``other``, by the paired interval."""
    difference = paired_difference(mine, other)
    text = _describe_difference(difference, len(_runs(mine)))
    if difference.low == difference.high == 0.0:
        return Verdict(about, claim, f"{found}{text}: it does the very same.", False, difference)
    return Verdict(about, claim, f"{found}{text}.", difference.above(0.0), difference)


def no_worse(
    about: str, claim: str, mine: PerSeed | Runs, other: PerSeed | Runs, evaluation: Evaluation, share: float = 0.01
) -> Verdict:
    """The verdict whether ``mine`` loses at most ``share`` of the absolute value of ``other``'s mean reward.
    The text also gives the loss relative to the difference between random and hindsight, because the zero of
    a reward is arbitrary. Undecided if the reward is too near its zero for a percentage."""
    difference, base = paired_difference(mine, other), crossed(_runs(other))
    text = f"{_describe_difference(difference, len(_runs(mine)))} at {base.mean:.4f}, that is "
    if base.low <= 0.0 <= base.high:
        return Verdict(about, claim, f"{text}no percentage: too near zero.", None, difference)
    text += f"{100 * difference.mean / abs(base.mean):+.2f} %"
    limit = paired_difference(evaluation.rewards(HINDSIGHT), evaluation.rewards("random"))
    if limit.above(0.0):
        text += f", and {100 * difference.mean / limit.mean:+.0f} % of the way from random to hindsight"
    answer = difference.above(-share * abs(base.mean))
    return Verdict(about, claim, f"{text}.", answer, difference)
