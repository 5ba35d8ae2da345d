"""A policy that learns while it decides: it follows a change, stays in its limits, falls back and returns."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from edge_server.scheduler import Epoch, make_policy
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.rewards import make_reward
from edge_server.scheduler.learned.state import StateLayout
from edge_server.scheduler.online.online_policy import ExploringActor, OnlinePolicy, OnlineSettings, mean_kl
from edge_server.scheduler.online.online_trainer import (
    OnlineTrainer,
    choose_reward,
    open_online_trainer,
    training_summary,
)
from edge_server.scheduler.online.sequential_test import MIN_REWARDS
from tests.edge_server.scheduler.learned.problems import state

OMEGAS = (20.0, 80.0, 320.0)
SPEC = Spec("threshold", StateLayout(("age",)), OMEGAS, hidden=16, learning_rate=1e-2)
MS = 10**6


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def online(learner: Learner, seed: int = 2, **settings) -> OnlinePolicy:
    """Beside threshold:80; compared from the first decision on unless ``settings`` say otherwise."""
    fixed = make_policy("threshold", 80.0, rng())
    return OnlinePolicy(learner, fixed, "bandit:x", rng(seed), OnlineSettings(**{"warmup": 0, **settings}))


def taught(worth, updates: int = 25) -> Learner:
    """A learner of thresholds that has seen ``worth`` (omega -> reward)."""
    learner = Learner(SPEC, 1)
    states = [state(5, rng(k)) for k in range(64)]
    for _ in range(updates):
        actions, logps = learner.act(states)
        rewards = [worth(OMEGAS[int(a)]) for a in actions]
        learner.update(learner.batch(states, actions, logps, rewards))
    return learner


def epoch(number: int) -> Epoch:
    seen = state(5, rng(1000 + number))
    now_ns = 10**12 + number * 100 * MS
    generated = {c: now_ns - round(a * MS) for c, a in zip(seen.cameras, seen.ages_ms)}
    return Epoch(now_ns, number, generated, lambda parts=(): seen)


def use(policy: OnlinePolicy, worth, count: int, first: int = 0) -> list[float]:
    """Decide ``count`` times, each rewarded by the omega that was used."""
    used = []
    for number in range(first, first + count):
        at = epoch(number)
        plan = policy.plan(at)
        assert policy.select(at, plan)
        used.append(plan.omega_ms)
        if policy.add_reward(number, worth(plan.omega_ms) + 0.05 * float(rng(number).standard_normal())):
            policy.learn()
    return used


def short(omega: float) -> float:
    return -omega / 100.0


def long(omega: float) -> float:
    return omega / 100.0


def test_it_falls_back_after_a_change_and_returns_once_it_has_learned():
    policy = online(taught(short), share=0.3, max_kl=50.0)
    before = use(policy, short, 150)
    assert not policy.fallen_back and np.mean(before) < 60.0
    drifted = use(policy, long, 250, 150)
    assert "worse than threshold:80" in policy.summary()
    assert policy.fallen_back and np.mean(drifted[-50:]) > np.mean(before)
    for number in range(400, 4000, 100):
        use(policy, long, 100, number)
        if not policy.fallen_back:
            break
    assert not policy.fallen_back
    assert np.mean(use(policy, long, 100, 4000)) > 200.0


def test_the_trust_region_holds_for_any_reward():
    policy = online(Learner(SPEC, 1), max_kl=0.2, batch=16)
    for first in range(0, 600, 50):
        use(policy, long, 50, first)
        assert policy.kl_from_loaded <= 0.2
    assert policy.updates > 10 and policy.shortened > 0
    free = online(Learner(replace(SPEC, target_kl=50.0), 1), max_kl=50.0, batch=16)
    use(free, long, 600)
    assert free.kl_from_loaded > 0.2 and free.shortened == 0


@pytest.mark.parametrize("seed", [1, 2])
def test_one_update_moves_it_by_at_most_target_kl(seed: int):
    spec = replace(SPEC, learning_rate=3e-2)
    policy = online(Learner(spec, seed), max_kl=50.0, batch=16)
    steps = []
    for number in range(400):
        at = epoch(number)
        plan = policy.plan(at)
        policy.select(at, plan)
        if policy.add_reward(number, (long if number < 200 else short)(plan.omega_ms)):
            before = policy._learner.actor
            figures = policy.learn()
            batch = spec.layout.batch([epoch(k).state() for k in range(number + 1)])
            steps.append(mean_kl(before, policy._learner.actor, batch))
            assert figures["step_kl"] <= spec.target_kl
    assert len(steps) > 10 and policy.shortened > 0
    assert np.mean(steps) > 0.1 * spec.target_kl, "it is held back, not held"


@pytest.mark.parametrize(("action", "cameras"), [("select", 18), ("select", 200), ("threshold", 18)])
def test_it_is_compared_with_the_exploring_policy_that_acted(action: str, cameras: int):
    """In the first pass nothing has been learned yet, so that even a nearly sure policy has not moved."""
    spec = Spec(action, StateLayout(("age",)), () if action == "select" else OMEGAS, start=0.99, passes=1)
    policy = OnlinePolicy(Learner(spec, 1), make_policy("all", None, rng()), "b", rng(3), OnlineSettings(warmup=0))
    for number in range(60):
        seen = state(cameras, rng(number))
        now_ns = 10**12 + number * 100 * MS
        generated = {c: now_ns - round(a * MS) for c, a in zip(seen.cameras, seen.ages_ms)}
        at = Epoch(now_ns, number, generated, lambda parts=(), seen=seen: seen)
        policy.select(at, policy.plan(at))
        if policy.add_reward(number, float(rng(number).standard_normal())):
            break
    figures = policy.learn()
    assert figures is not None and figures["kl_from_acted"] == pytest.approx(0.0, abs=1e-12)


def test_the_offset_of_live_rewards_does_not_matter():
    """Training compares the actions of one decision; live there is only one, with its plain reward."""

    def trained() -> Learner:
        learner, states = Learner(SPEC, 1), [state(5, rng(k)) for k in range(64)]
        for number in range(2):
            actions, logps = learner.act(states)
            found = rng(number).normal(0.04 * (actions == 0), 0.02)
            learner.update(learner.batch(states, actions, logps, found - found.mean()))
        return learner

    learned = []
    for zero in (0.0, -1.2, 30.0):
        policy = online(trained(), max_kl=50.0)
        use(policy, lambda omega, zero=zero: zero + 0.3 * (omega == 320.0), 200)
        assert policy.updates >= 4
        learned.append(policy._bandit.actor)
    share = [
        np.bincount(a.act([state(5, rng(k)) for k in range(400)], rng(9))[0], minlength=3)[2] / 400
        for a in (trained().actor, *learned)
    ]
    assert share[1] > 1.5 * share[0] and share[2] == share[3] == share[1]
    for other in learned[1:]:
        assert all(np.allclose(w, other.weights[n], atol=1e-6) for n, w in learned[0].weights.items())


@pytest.mark.parametrize("fallen_back", [False, True])
def test_who_decides_does_not_change_by_chance(fallen_back: bool):
    """Rewards independent of the policy that stay high or low for a while, as those of a field do."""
    for seed in range(6):
        policy = online(Learner(SPEC, 1), seed, batch=10**6)
        if fallen_back:
            policy._switch()
        noise, found = rng(100 + seed), 0.0
        for number in range(600):
            at = epoch(number)
            policy.select(at, policy.plan(at))
            found = 0.8 * found + 0.6 * float(noise.standard_normal())
            policy.add_reward(number, found)
            assert policy.fallen_back is fallen_back


def test_the_same_seed_repeats_and_the_learner_is_saved(tmp_path: Path):
    made = [online(taught(short)) for _ in range(2)]
    first, second = (use(a, long, 200) for a in made)
    assert first == second and made[0].status() == made[1].status() and made[0].updates > 0
    made[0].save(tmp_path / "learnt.npz")
    saved, other = (Actor.load(tmp_path / "learnt.npz").weights, made[1]._bandit.actor.weights)
    assert all(np.array_equal(w, other[n]) for n, w in saved.items())


def test_late_missing_and_broken_rewards_are_ignored():
    policy = online(taught(short))
    before = policy._bandit.actor.weights
    for number in range(200):
        at = epoch(number)
        policy.select(at, policy.plan(at))
        assert not policy.add_reward(number, (None, np.nan, np.inf)[number % 3])
        assert not policy.add_reward(number, 1.0)  # twice
    assert policy.learn() is None and not policy.add_reward(10**6, 1.0)
    assert all(np.array_equal(w, before[n]) for n, w in policy._bandit.actor.weights.items())
    assert policy.status()["learnt_reward"]["count"] == 0 and "not known yet" in policy.summary()


def test_decisions_of_the_warmup_do_not_count():
    policy = online(taught(short), warmup=50)
    use(policy, long, 50, 1000)  # a restarted edge continues to count
    assert policy.status()["learnt_reward"]["count"] == policy.status()["fixed_reward"]["count"] == 0
    use(policy, long, 30, 1050)
    counts = [policy.status()[f"{who}_reward"]["count"] for who in ("learnt", "fixed")]
    assert sum(counts) == 30


def test_few_decisions_are_not_compared():
    policy = online(taught(short), share=0.5)
    use(policy, long, MIN_REWARDS)  # of both together: too few of either
    assert not policy.fallen_back


@pytest.mark.parametrize("action", ["select", "threshold"])
def test_mean_kl_agrees_with_torch_and_is_finite_at_the_edges(action):
    spec = Spec(action, StateLayout(("age",)), () if action == "select" else OMEGAS, hidden=8)
    a, b = (Learner(spec, s).actor for s in (1, 2))
    a, b = (
        Actor(spec, {n: w + 0.5 * rng(9).standard_normal(w.shape) * k for n, w in x.weights.items()})
        for k, x in ((1, a), (-1, b))
    )
    features = spec.layout.batch([state(5, rng(k), silent=k % 2) for k in range(7)])
    p, q = (torch.tensor(x.logits(features)) for x in (a, b))
    if action == "select":
        kl = torch.distributions.kl_divergence(
            torch.distributions.Bernoulli(logits=p), torch.distributions.Bernoulli(logits=q)
        )
        expected = float((kl * torch.tensor(features[..., -1])).sum(1).mean())
    else:
        expected = float(
            torch.distributions.kl_divergence(
                torch.distributions.Categorical(logits=p), torch.distributions.Categorical(logits=q)
            ).mean()
        )
    assert mean_kl(a, b, features) == pytest.approx(expected, rel=1e-9) and expected > 1e-4
    assert mean_kl(a, a, features) == pytest.approx(0.0, abs=1e-12)
    far = Actor(spec, {**b.weights, "out_b": np.full_like(b.weights["out_b"], 1e4)})
    assert np.isfinite(mean_kl(a, far, features))


def test_reward_and_fallback_default_to_those_of_the_training(tmp_path: Path):
    taught(short, 1).save(tmp_path / "policy.npz")
    summary = {"reward_name": "thesis", "on": "moving", "best_fixed": "threshold:150"}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    trainer = open_online_trainer(tmp_path / "policy.npz", "", "", rng(), None, tmp_path)
    assert trainer.reward == make_reward("thesis", fidelity="moving")
    assert (trainer.policy.fixed.name, trainer.policy.fixed.value) == ("threshold", 150.0)
    given = open_online_trainer(tmp_path / "policy.npz", "set", "all", rng(), "no weights", tmp_path)
    assert given.reward == make_reward("set", distance=0.0) and given.policy.fixed.name == "all"
    assert training_summary(Path("nowhere/x.npz")) == {}
    assert choose_reward("select", "", Path("nowhere/x.npz"), None).name == "set"
    for bad, said in ((("nonsense", ""), "nonsense"), (("set", "threshold:x"), "fallback: ")):
        with pytest.raises(ValueError, match=said):
            open_online_trainer(tmp_path / "policy.npz", *bad, rng(), None, tmp_path)
    Learner(replace(SPEC, hold_ms=200.0)).save(tmp_path / "policy.npz")
    with pytest.raises(ValueError, match=r"its decisions hold for 200 ms .*without --hold"):
        open_online_trainer(tmp_path / "policy.npz", "", "", rng(), None, tmp_path)


class Score:
    psnr_db = psnr_moving_db = ssim = lpips = None

    def __init__(self, aaoi_ms: float) -> None:
        self.aaoi_ms = aaoi_ms


def test_the_trainer_learns_on_its_own_thread_and_logs_updates(tmp_path: Path):
    policy = online(taught(short), batch=8)
    reward = make_reward("corrected", psnr=0.0, ssim=0.0, distance=0.0, age=-0.01)
    trainer = OnlineTrainer(policy, reward, tmp_path)
    trainer.start()
    for number in range(40):
        at = epoch(number)
        plan = policy.plan(at)
        policy.select(at, plan)
        trainer.add_score(number, Score(plan.omega_ms))
    for _ in range(200):
        if policy.updates:
            break
        time.sleep(0.02)
    trainer.stop()
    trainer.close()
    lines = [json.loads(line) for line in (tmp_path / "learning.jsonl").read_text().splitlines()]
    assert lines and lines[0]["update"] == 1 and lines[0]["decisions"] == 8
    assert Learner.load(tmp_path / "learnt.npz").updates > 25


@pytest.mark.parametrize("action", ["select", "wait"])
def test_exploration_is_part_of_every_action_and_of_its_probability(action):
    spec = Spec(action, StateLayout(("age",)), () if action == "select" else OMEGAS, hidden=8)
    weights = dict(Learner(spec, 1).actor.weights)
    weights["out_b"] = np.full_like(weights["out_b"], 1e3)  # as sure as can be, of cameras
    if action == "wait":
        weights["out_b"][1:] = 0.0
    seen = state(4, rng(1))
    sure, chance = Actor(spec, weights), ExploringActor(spec, weights, 0.2)
    draws = np.array([chance.act([seen], rng(k))[0][0] for k in range(600)])
    assert len({str(sure.act([seen], rng(k))[0][0]) for k in range(50)}) == 1
    if action == "select":
        assert np.allclose(draws.mean(axis=0), 0.9, atol=0.04)
        return
    assert np.allclose(np.bincount(draws, minlength=3) / 600, [1 - 0.4 / 3, 0.2 / 3, 0.2 / 3], atol=0.04)
    probabilities = {int(a): float(p) for k in range(60) for a, p in [np.ravel(chance.act([seen], rng(k)))]}
    assert np.exp(probabilities[0]) == pytest.approx(1 - 0.4 / 3) and np.exp(probabilities[1]) == pytest.approx(0.2 / 3)
