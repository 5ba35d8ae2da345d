"""One rollout: it depends on its arguments only, and decides in a running deployment as ``simulate`` does."""

from __future__ import annotations

import dataclasses
import pickle
from functools import partial

import pytest

from edge_server.experiments.engine import Engine
from edge_server.experiments.rollouts import rollout as rollout_module
from edge_server.experiments.rollouts.episode import EpisodeFactory
from edge_server.experiments.rollouts.rollout import Job, learned, named, rollout, run_rollouts
from edge_server.experiments.rollouts.setting import Setting, seeds
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from edge_server.settings import ComputeConfig
from tests.edge_server.experiments.rollouts.small import NOTHING, setting

SELECT = Spec("select", StateLayout(("age", "pose")), hidden=8)


def deployed(**more) -> Setting:
    """Updates that follow arrivals, with computing charged."""
    small = setting(
        compute=ComputeConfig(ms_per_step=2.0, ms_per_view=1.0), deployed=True, lead_ms=400.0, span_ms=1200.0
    )
    edge = {**small.scenario.edge, "updates": "arrivals", "update_ms": 50.0, "steps": 2, "grace_ms": 0.0, **more}
    return dataclasses.replace(small, scenario=dataclasses.replace(small.scenario, edge=edge))


def test_samples_have_actions_of_their_own_and_share_the_episode():
    factory = EpisodeFactory(setting(), NOTHING)
    actor = Learner(SELECT, 0).actor
    runs = rollout(factory, 3, learned(actor, explore=True), 3)
    assert runs == rollout(EpisodeFactory(setting(), NOTHING), 3, learned(actor, explore=True), 3)
    assert len({str([d.action for d in run.decided]) for run in runs}) > 1
    assert len({str([d.features for d in run.decided]) for run in runs}) == 1
    state = factory.episode(3).points[1].state
    one = runs[0].decided[1]
    assert one.features == SELECT.layout.features(state).tolist() and one.slot == 1
    greedy = rollout(factory, 3, learned(actor), 2)
    assert greedy[0] == greedy[1] and greedy[0].decided[0].logp < 0.0
    fixed = rollout(factory, 3, named("all"))[0].decided
    assert fixed[0].features is None and fixed[0].outcomes["cam00"].views >= 3.0


@pytest.mark.parametrize(
    "what",
    [pytest.param(setting(), id="single decisions"), pytest.param(deployed(), id="deployed", marks=pytest.mark.slow)],
)
def test_a_job_gives_the_same_wherever_and_after_whatever_it_is_computed(what: Setting):
    """As processes have it: each job is sent to one, which has computed other jobs before, or none."""
    actor = Learner(dataclasses.replace(SELECT, hold_ms=300.0 * what.deployed), 0).actor
    makers = {"random": named("random"), "learned": learned(actor, explore=True)}
    work = partial(rollout_module._carry_out, setting=what, folders=NOTHING, makers=makers)
    jobs = [Job(what.key, seed, name, samples=2) for seed in seeds(0, "test", 2) for name in makers]
    found = [work(job) for job in jobs]
    assert len({str(one) for one in found}) == len(jobs)
    rollout_module._factory.cache_clear()
    sent = pickle.loads(pickle.dumps(work))
    assert [sent(job) for job in reversed(jobs)] == found[::-1]


def test_results_are_kept_by_weights_and_not_by_the_names_of_their_files(tmp_path):
    def known() -> int:
        return len((tmp_path / "known.jsonl").read_text().splitlines())

    def roll(path) -> None:
        with Engine(tmp_path / "known.jsonl", threads=1, say=lambda line: None) as engine:
            run_rollouts(engine, setting(), NOTHING, [5], {"mine": f"bandit:{path}"})

    a, b = tmp_path / "a.npz", tmp_path / "b.npz"
    Learner(SELECT, 0).actor.save(a)
    b.write_bytes(a.read_bytes())
    roll(a)
    roll(b)
    assert known() == 1
    Learner(SELECT, 1).actor.save(a)
    roll(a)
    assert known() == 2
