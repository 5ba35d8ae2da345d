"""Drawn decisions: the buffer as the deployment has it, choices carried out as the deployment would."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from edge_server.experiments.rollouts.episode import Choice, EpisodeFactory
from edge_server.experiments.rollouts.rollout import choose, named
from edge_server.experiments.rollouts.setting import PURPOSES, seeds
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fields.registry import make_field
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from edge_server.settings import ComputeConfig
from freshfield.scenario import ScenarioError
from tests.edge_server.experiments.rollouts.small import FIELD, NOTHING, scenario, setting

FAULTS = {"preset": "ch6", "faults": {"loss": {"probability": 0.1}, "duplication": {"probability": 0.3}}}


@pytest.fixture(scope="module")
def factory() -> EpisodeFactory:
    return EpisodeFactory(setting(), NOTHING)


def deployed(policy: str, value: float | None, seed: int, at_ns: int, **more) -> VirtualDeployment:
    """The same deployment with its own edge, which decides first at an instant."""
    what = scenario(**more)
    edge = {**what.edge, "policy": {"name": policy, "value": value}}
    terms = RunSettings(steps=4, epoch_ms=60_000.0, first_ms=at_ns / 1e6, scratch=True, compute=ComputeConfig(5.0))
    field = make_field("splat", FIELD, seed=setting().field_seed(seed))
    return build_deployment(dataclasses.replace(what, edge=edge, seed=seed), terms, field=field)


@pytest.mark.parametrize("channel", [{"preset": "ch5"}, FAULTS], ids=["ch5", "faults"])
def test_the_buffer_at_any_instant_is_the_one_of_the_deployment(channel):
    factory = EpisodeFactory(setting(channel), NOTHING)
    for point in factory.episode(11).points:
        for wait_ms in (0, 35, 180):
            at_ns = point.now_ns + wait_ms * 10**6
            live = deployed("all", None, 11, 10**13, channel=channel)
            live.run(at_ns / 1e9)
            newest = live.updates.buffer.newest()
            assert newest
            assert {c: (a.generated_ns, a.received_ns) for c, a in point.newest(at_ns).items()} == {
                c: (b.generated_ns, b.received_ns) for c, b in newest.items()
            }


@pytest.mark.parametrize("policy", ["threshold:70", "wait-arrived:60", "periodic:400", "bandit:"])
def test_a_choice_comes_to_what_it_comes_to_in_the_deployment(policy, tmp_path):
    if policy.startswith("bandit:"):
        learner = Learner(Spec("select", StateLayout(("age", "pose")), hidden=8), seed=4)
        learner.save(tmp_path / "policy.npz")
        policy = f"bandit:{tmp_path / 'policy.npz'}"
    factory = EpisodeFactory(setting(compute=ComputeConfig(5.0)), NOTHING)
    episode = factory.episode(5)
    point = episode.points[0]
    choice = choose(named(policy)(np.random.default_rng(0)), episode, 0)
    found = episode.evaluate(0, choice)["cam00"]
    name, _, value = (policy, "", "") if policy.startswith("bandit:") else policy.partition(":")
    live = deployed(name, float(value) if value else None, 5, point.now_ns)
    live.run(point.now_ns / 1e9 + 1.0)
    expected = live.publications[0]
    assert set(expected.selected) == set(choice.cameras)
    assert (found.psnr_db, found.psnr_moving_db, found.ssim) == (
        expected.psnr_db,
        expected.psnr_moving_db,
        expected.ssim,
    )
    assert found.aaoi_ms == expected.aaoi_ms and found.views == len(expected.selected)
    assert point.now_ns + round(found.wait_ms * 1e6) == expected.published_ns


@pytest.mark.parametrize("scratch", [True, False])
def test_every_action_starts_from_the_same_field_whatever_was_evaluated_before(scratch):
    factory = EpisodeFactory(setting(scratch=scratch), NOTHING)
    episode = factory.episode(2)
    asked = [(k, Choice(point.cameras[:n], point.now_ns)) for k, point in enumerate(episode.points) for n in (1, 2, 4)]
    forwards = [episode.evaluate(*a) for a in asked]
    fresh = EpisodeFactory(setting(scratch=scratch), NOTHING).episode(2)
    backwards = [fresh.evaluate(*a) for a in reversed(asked)][::-1]
    assert forwards == backwards
    assert len({o["cam00"].psnr_db for o in forwards}) == len(forwards)


def test_seeds_of_two_purposes_or_runs_never_meet():
    ranges = [set(seeds(run, purpose, 500)) for run in (0, 1, 2) for purpose in PURPOSES]
    assert len(set.union(*ranges)) == sum(map(len, ranges))
    with pytest.raises(ValueError, match="at most 1000000"):
        seeds(0, "train", 1, first=10**6)


def test_a_setting_without_a_held_out_camera_is_refused():
    with pytest.raises(ScenarioError, match="held_out"):
        dataclasses.replace(setting(), scenario=scenario(cameras={"count": 5}))
