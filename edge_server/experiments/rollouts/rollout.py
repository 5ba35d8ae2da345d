"""One rollout for training, evaluation and comparison: an episode in which an actor decides, whole in one process.

An actor makes a policy from a random generator: a fixed one by name, or one with a learned actor's weights. In a
``deployed`` setting the policy decides in a running deployment, with computing charged, and the outcome is what is
shown. Otherwise it decides at single instants, each time from the same field, so that the outcomes of several samples
of one decision are comparable (``episode``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import msgspec
import numpy as np

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.tables import mean_or_none
from edge_server.experiments.engine import Engine
from edge_server.experiments.experiment_constants import SHOWN_EVERY_MS
from edge_server.experiments.rollouts.episode import SCORES, Choice, Episode, EpisodeFactory, Outcome
from edge_server.experiments.rollouts.setting import Setting
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.scheduler import BANDIT, Epoch, Policy, make_policy, parse_policy
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.bandit import BanditPolicy
from edge_server.settings import read_config

PolicyMaker = Callable[[np.random.Generator], Policy]


@dataclass(frozen=True)
class Decided:
    """A decision and its outcome, as plain values.

    outcomes: by the camera that scored.
    features, action, logp: what a learned policy saw ((N, width)), its action ((N,) bool, or the index of an omega) and
        its log-probability; None and 0 for other policies.
    """

    outcomes: dict[str, Outcome]
    features: list[list[float]] | None = None
    action: Any = None
    logp: float = 0.0


@dataclass(frozen=True)
class Run:
    """One sample of an episode: its single decisions in turn, which are comparable with those of other samples, or of a
    running deployment the outcome of all of it."""

    decided: list[Decided]
    whole: Outcome | None = None


def rollout(
    factory: EpisodeFactory, seed: int, make: PolicyMaker, samples: int = 1, cameras: tuple[str, ...] | None = None
) -> list[Run]:
    """Runs of the episode of ``seed`` under a policy, each with random numbers of its own. The result depends on the
    arguments only.

    make: makes the policy of each run.
    cameras: held-out cameras that score; None: those that reward.
    """
    play = _deployed if factory.setting.deployed else _single_decisions
    return [play(factory, seed, make(np.random.default_rng([seed, k])), cameras) for k in range(samples)]


# --- single decisions -------------------------------------------------------------------------------------


def _single_decisions(factory: EpisodeFactory, seed: int, policy: Policy, cameras: tuple[str, ...] | None) -> Run:
    episode = factory.episode(seed)
    decided = []
    for number in range(len(episode.points)):
        outcomes = episode.evaluate(number, choose(policy, episode, number), cameras)
        seen: tuple[Any, ...] = ()
        if (last := policy.last_decision) is not None:  # of a learned policy
            seen = last.actor.spec.layout.features(last.state).tolist(), last.action.tolist(), last.logp
        decided.append(Decided(outcomes, *seen))
    return Run(decided)


def choose(policy: Policy, episode: Episode, number: int) -> Choice:
    """Plan, wait and select with ``policy`` at a decision, as in the live loop. A policy that would wait past the
    channel's record uses all newest frames at its end."""
    point = episode.points[number]

    def epoch(at_ns: int) -> Epoch:
        newest = point.newest(at_ns)
        generated = {c: frame.generated_edge_ns for c, frame in newest.items()}
        received = {c: frame.received_ns for c, frame in newest.items()}
        known = at_ns == point.now_ns
        return Epoch(
            at_ns, number, generated, lambda parts=(): point.state if known else episode.state(newest, at_ns), received
        )

    plan = policy.plan(epoch(point.now_ns))
    at_ns = min(max(point.now_ns, plan.wait_until_ns), point.until_ns)
    cameras = policy.select(epoch(at_ns), plan)
    while not cameras:
        arrives_ns = point.next_arrival_ns(at_ns)
        if arrives_ns is None:
            at_ns = point.until_ns
            cameras = tuple(point.newest(at_ns))
            break
        at_ns = arrives_ns
        cameras = policy.select(epoch(at_ns), plan)
    return Choice(tuple(cameras), at_ns)


# --- a running deployment ---------------------------------------------------------------------------------


def _deployed(factory: EpisodeFactory, seed: int, policy: Policy, cameras: tuple[str, ...] | None) -> Run:
    """Run an episode under ``policy``: the outcome of all that was shown after the lead."""
    setting, scenario = factory.setting, factory.scenario(seed)
    edge, stage, field = read_config(scenario), factory.stage(seed), factory.field(seed)
    field.reset()
    settings = RunSettings(
        steps=edge.steps,
        compute=setting.compute,
        grace_ms=edge.grace_ms,
        epoch_ms=edge.update_ms,
        score_every_ms=None,
        shown_every_ms=SHOWN_EVERY_MS,
    )
    truth, embedder = stage.truth.of(cameras or setting.rewarding), factory.embedder
    deployment = build_deployment(
        scenario, settings, field=field, cameras=stage.cameras, truth=truth, embedder=embedder
    )
    deployment.updates.policy = policy
    deployment.run((setting.lead_ms + setting.span_ms) / 1e3)
    lead_ns = round(setting.lead_ms * 1e6)
    shown = [s for s in deployment.shown if s.published_ns >= lead_ns]
    updates = [p for p in deployment.publications if p.published_ns >= lead_ns]
    whole = Outcome(
        **{name: mean_or_none([getattr(s, name) for s in shown]) for name in SCORES},
        aaoi_ms=mean_or_none([p.aaoi_ms for p in updates]),
        views=mean_or_none([p.views for p in updates]) or 0.0,
        wait_ms=mean_or_none([p.update_ms for p in updates]) or 0.0,
    )
    return Run([], whole)


# --- actors ------------------------------------------------------------------------------------------------


def named(name: str) -> PolicyMaker:
    """Maker of a policy as people write it, such as ``threshold:120``. Raises ValueError."""
    return partial(make_policy, *parse_policy(name))


def learned(actor: Actor, explore: bool = False) -> PolicyMaker:
    """Maker of a policy with these weights. explore: actions are drawn; otherwise the most probable ones."""
    return partial(BanditPolicy, actor, "learned", explore=explore)


# --- on the engine -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """What determines the runs of one episode under one actor.

    setting: its key. actor: name of a policy, or digest of the weights.
    repeats: how often, each time with a field of another seed.
    """

    setting: str
    seed: int
    actor: str
    samples: int = 1
    cameras: tuple[str, ...] = ()
    repeats: int = 1


def run_rollouts(
    engine: Engine,
    setting: Setting,
    folders: Folders,
    seeds: Sequence[int],
    actors: Mapping[str, str | Actor],
    *,
    explore: bool = False,
    name: str = "rollouts",
    **job: Any,
) -> dict[str, dict[int, list[list[Run]]]]:
    """Actor -> seed -> runs, for each of the job's repeats and samples.

    actors: by name: a policy as people write it, or a learned actor.
    explore: whether learned actors draw their actions.
    job: further fields of ``Job``.
    Raises ScenarioError, DatasetError, ValueError or EngineError.
    """
    loaded = {n: _loaded(who) for n, who in actors.items()}
    digests = {n: who if isinstance(who, str) else who.digest for n, who in loaded.items()}
    makers = {n: named(who) if isinstance(who, str) else learned(who, explore) for n, who in loaded.items()}
    by_digest = {digests[n]: makers[n] for n in actors}
    files = folders.files_of(setting.scenario)
    jobs = [Job(setting.key, seed, digests[n], **job) for seed in seeds for n in actors]
    found = engine.run(
        partial(_carry_out, setting=setting, folders=folders, makers=by_digest),
        jobs,
        name,
        files=lambda one: files,
        group=lambda one: one.seed,  # one process renders the images of an episode, once
        batch=len(actors),
    )
    kept: dict[str, dict[int, list[list[Run]]]] = {n: {} for n in actors}
    for (seed, n), repeats in zip([(seed, n) for seed in seeds for n in actors], found):
        kept[n][seed] = msgspec.convert(repeats, list[list[Run]])
    return kept


def _carry_out(job: Job, *, setting: Setting, folders: Folders, makers: Mapping[str, PolicyMaker]) -> Any:
    """``rollout`` of a job, once for each of its repeats, as JSON values."""
    return [
        [
            dataclasses.asdict(run)
            for run in rollout(
                _factory(dataclasses.replace(setting, repeat=setting.repeat + k), folders),
                job.seed,
                makers[job.actor],
                job.samples,
                job.cameras or None,
            )
        ]
        for k in range(job.repeats)
    ]


def embeddings_seen(seed: int, *, setting: Setting, folders: Folders) -> list[list[float]]:
    """The embeddings of all frames that are newest at the decisions of an episode."""
    states = [point.state for point in _factory(setting, folders).episode(seed).points]
    return [row for s in states if s.embeddings is not None for row in s.embeddings[s.reported].tolist()]


# A process keeps the images of a few settings.
_factory = lru_cache(3)(EpisodeFactory)


def _loaded(who: str | Actor) -> str | Actor:
    """The actor in the file of ``bandit:FILE``, so that results are keyed by its weights; anything else as it is."""
    if isinstance(who, str) and who.startswith(BANDIT):
        return Actor.load(parse_policy(who)[0].removeprefix(BANDIT))
    return who
