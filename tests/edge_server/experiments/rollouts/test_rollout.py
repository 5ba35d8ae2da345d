"""Episodes and rollouts: as the deployment has them, whoever computes them, and who rewards, reports and has luck."""

import dataclasses
import pickle
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from edge_server.experiments.engine import Engine
from edge_server.experiments.rollouts import rollout as rollout_module
from edge_server.experiments.rollouts.episode import Choice, EpisodeFactory, Outcome, mean_outcome
from edge_server.experiments.rollouts.rollout import Job, choose, learned, named, rollout, run_rollouts
from edge_server.experiments.rollouts.setting import PURPOSES, Setting, seeds
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fields.registry import make_field
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.state import StateLayout
from edge_server.scheduler.policy import SelectionWindow
from edge_server.settings import ComputeConfig
from freshfield.scenario import ScenarioError
from tests.edge_server.experiments.rollouts.small import FIELD, NOTHING, scenario, setting
from tests.edge_server.experiments.sets import write_recording
from tests.support import refused


def one_of(what: Setting, seed: int = 5, camera: str = "cam00") -> Outcome:
    """What using everything comes to at the first decision of an episode."""
    episode = EpisodeFactory(what, NOTHING).episode(seed)
    point = episode.points[0]
    return episode.evaluate(0, Choice(tuple(point.newest(point.now_ns)), point.now_ns), (camera,))[camera]


def test_the_camera_that_reports_neither_rewards_nor_is_trained_on():
    apart = scenario(cameras={"count": 5, "held_out": ["cam00", "cam04"]})
    what = dataclasses.replace(setting(), scenario=apart, report=("cam04",))
    assert what.rewarding == ("cam00",) and what.judging == ("cam04",)
    point = EpisodeFactory(what, NOTHING).episode(5).points[0]
    assert point.cameras == ("cam01", "cam02", "cam03")
    rewarded, judged = one_of(what), one_of(what, camera="cam04")
    turned = dataclasses.replace(what, report=("cam00",))
    assert one_of(turned, camera="cam04") == judged and one_of(turned) == rewarded
    assert rewarded.psnr_db != judged.psnr_db and rewarded.aaoi_ms == judged.aaoi_ms


def test_every_episode_has_a_motion_of_its_own_which_its_cameras_share_and_recordings_none(tmp_path):
    factory = EpisodeFactory(setting(motions=True), NOTHING)
    images = set()
    for seed in (1, 2_000_001):  # of training and of testing
        stage = factory.stage(seed)
        params = {"count": 5, "width": 24, "height": 24, "supersample": 1, "speed_m_per_s": 2.0}
        scene = make_scene("room", {**params, "motion_seed": seed})
        images.add((image := stage.truth.view("cam00", 10**9)[0]).tobytes())
        assert np.array_equal(image, scene.render("cam00", 1.0))
        assert np.array_equal(stage.cameras[0].source.scene.render("cam01", 1.0), scene.render("cam01", 1.0))
    assert len(images) == 2
    same = EpisodeFactory(setting(motions=False), NOTHING)
    assert same.stage(1) is same.stage(2_000_001)
    recorded = scenario(source={"kind": "transforms", "data": str(write_recording(tmp_path))})
    still = EpisodeFactory(dataclasses.replace(setting(motions=True), scenario=recorded), NOTHING)
    assert "motion_seed" not in still.scenario(3).source


def test_pictures_of_one_episode_are_not_taken_for_those_of_another():
    """Frames of two episodes have the same numbers."""
    what = setting(motions=True, parts=("semantics", "age"), decisions=1)
    factory = EpisodeFactory(what, NOTHING)
    after_others = [factory.episode(seed).points[0].state.embeddings for seed in (1, 2)][1]
    alone = EpisodeFactory(what, NOTHING).episode(2).points[0].state.embeddings
    assert after_others.any() and np.array_equal(after_others, alone)


def test_the_scenarios_seed_and_the_repeat_decide_the_fields_luck_and_so_does_the_episode():
    a = setting()
    other = dataclasses.replace(a.scenario, seed=a.scenario.seed + 99)
    b, again = dataclasses.replace(a, scenario=other), dataclasses.replace(a, repeat=1)
    assert len({what.key for what in (a, b, again)}) == 3
    assert len({what.field_seed(seed) for what in (a, b, again) for seed in range(20)}) == 60
    found = [one_of(what).psnr_db for what in (a, b, again)]
    assert len(set(found)) == 3 and one_of(a).psnr_db == found[0]


def deployed(policy: str, value: float | None, seed: int, at_ns: int, **more) -> VirtualDeployment:
    """The same deployment with its own edge, which decides first at an instant."""
    what = scenario(**more)
    edge = {**what.edge, "policy": {"name": policy, "value": value}}
    terms = RunSettings(steps=4, epoch_ms=60_000.0, first_ms=at_ns / 1e6, scratch=True, compute=ComputeConfig(5.0))
    field = make_field("splat", FIELD, seed=setting().field_seed(seed))
    return build_deployment(dataclasses.replace(what, edge=edge, seed=seed), terms, field=field)


@pytest.mark.parametrize("policy", ["threshold:70", "wait-arrived:60", "periodic:400", "bandit:"])
def test_a_choice_comes_to_what_it_comes_to_in_the_deployment(policy, tmp_path):
    if policy.startswith("bandit:"):
        Learner(SELECT, seed=4).save(tmp_path / "policy.npz")
        policy = f"bandit:{tmp_path / 'policy.npz'}"
    episode = EpisodeFactory(setting(compute=ComputeConfig(5.0)), NOTHING).episode(5)
    point = episode.points[0]
    choice = choose(named(policy)(np.random.default_rng(0)), episode, 0)
    found = episode.evaluate(0, choice)["cam00"]
    name, _, value = (policy, "", "") if policy.startswith("bandit:") else policy.partition(":")
    live = deployed(name, float(value) if value else None, 5, point.now_ns)
    live.run(point.now_ns / 1e9 + 1.0)
    expected = live.publications[0]
    assert set(expected.selected) == set(choice.cameras)
    for name in ("psnr_db", "psnr_moving_db", "ssim", "aaoi_ms"):
        assert getattr(found, name) == getattr(expected, name), name
    assert found.views == len(expected.selected)
    assert point.now_ns + round(found.wait_ms * 1e6) == expected.published_ns


@pytest.mark.parametrize("patience", [0, 2, 10**9])
def test_a_policy_that_selects_nothing_is_asked_again_at_each_arrival_and_gets_all_in_the_end(patience):
    episode = EpisodeFactory(setting(), NOTHING).episode(5)
    point = episode.points[0]
    arrivals_ns, asked_ns = [point.now_ns], []
    while (arrives_ns := point.next_arrival_ns(arrivals_ns[-1])) is not None:
        arrivals_ns.append(arrives_ns)

    def select(epoch, window):
        asked_ns.append(epoch.now_ns)
        return ("cam01",) if len(asked_ns) > patience else ()

    choice = choose(SimpleNamespace(plan=lambda epoch: SelectionWindow(), select=select), episode, 0)
    assert asked_ns == arrivals_ns[: patience + 1] and len(arrivals_ns) > 4
    if patience < len(arrivals_ns):
        assert (choice.cameras, choice.at_ns) == (("cam01",), arrivals_ns[patience])
    else:
        assert (set(choice.cameras), choice.at_ns) == (set(point.newest(point.until_ns)), point.until_ns)


@pytest.mark.parametrize("scratch", [True, False])
def test_every_action_starts_from_the_same_field_whatever_was_evaluated_before(scratch):
    episode = EpisodeFactory(setting(scratch=scratch), NOTHING).episode(2)
    asked = [(k, Choice(point.cameras[:n], point.now_ns)) for k, point in enumerate(episode.points) for n in (1, 2, 4)]
    forwards = [episode.evaluate(*a) for a in asked]
    fresh = EpisodeFactory(setting(scratch=scratch), NOTHING).episode(2)
    assert [fresh.evaluate(*a) for a in reversed(asked)] == forwards[::-1]
    assert len({o["cam00"].psnr_db for o in forwards}) == len(forwards)


def test_seeds_of_two_purposes_or_runs_never_meet():
    ranges = [set(seeds(run, purpose, 500)) for run in (0, 1, 2) for purpose in PURPOSES]
    assert len(set.union(*ranges)) == sum(map(len, ranges))
    refused(ValueError, "at most 1000000", seeds, 0, "train", 1, first=10**6)


def test_a_setting_without_a_held_out_camera_is_refused():
    refused(ScenarioError, "held_out", dataclasses.replace, setting(), scenario=scenario(cameras={"count": 5}))


SELECT = Spec("select", StateLayout(("age", "pose")), hidden=8)


def following_arrivals(**more) -> Setting:
    """Updates that follow arrivals, with computing charged."""
    compute = ComputeConfig(ms_per_step=2.0, ms_per_view=1.0)
    small = setting(compute=compute, deployed=True, lead_ms=400.0, span_ms=1200.0)
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
    assert one.features == SELECT.layout.features(state).tolist()
    greedy = rollout(factory, 3, learned(actor), 2)
    assert greedy[0] == greedy[1] and greedy[0].decided[0].logp < 0.0
    fixed = rollout(factory, 3, named("all"))[0].decided
    assert fixed[0].features is None and fixed[0].outcomes["cam00"].views >= 3.0


@pytest.mark.parametrize("deployed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_job_gives_the_same_wherever_and_after_whatever_it_is_computed(deployed: bool, monkeypatch):
    """As processes have it: each job is sent to one, which has computed other jobs before, or none."""
    what = following_arrivals() if deployed else setting()
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


@pytest.fixture
def environment():
    """Makes environments of gymnasium."""
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed (extra gym)")
    few = {"decisions": 3, "steps": 2, "size": 16, "warm_steps": 4, "span_ms": 500.0, "scenario": "room"}
    return lambda name, **more: gymnasium.make(f"freshfield.gym:freshfield/{name}-v0", **few, **more).unwrapped


def test_gymnasiums_checker_finds_nothing(environment):
    pytest.importorskip("gymnasium.utils.env_checker").check_env(environment("Select"), skip_render_check=True)


def test_a_step_of_an_environment_is_what_the_policy_of_its_action_gets(environment):
    env = environment("Wait", omegas_ms=(0.0, 80.0))
    env.reset(seed=3)
    episode, rewards = env._episode, []
    for number in range(3):
        policy = named("wait:80")(np.random.default_rng(0))
        expected = mean_outcome(list(episode.evaluate(number, choose(policy, episode, number)).values()))
        _, reward, over, _, info = env.step(1)
        assert info["psnr_moving_db"] == expected.psnr_moving_db and info["missing"] == ()
        rewards.append(reward)
    assert over and all(rewards)
    with pytest.raises(pytest.importorskip("gymnasium").error.ResetNeeded):
        env.step(1)
