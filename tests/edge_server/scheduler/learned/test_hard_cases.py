"""The learning scheduler where numbers end: whatever it is given, it stays finite and learns on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.scheduler.learned.bandit import BanditPolicy
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Batch, Diagnostics, Learner
from edge_server.scheduler.learned.state import State, StateLayout
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, FreshOnes, Waits, collect, regret, state, teach

pytestmark = pytest.mark.stability
LAYOUT = StateLayout(("age", "pose", "semantics"), dim=4)
SPECS = [Spec("select", LAYOUT), Spec("wait", LAYOUT, OMEGAS_MS)]
by_action = pytest.mark.parametrize("spec", SPECS, ids=lambda s: s.action)

EXTREME_AGES_MS = [0.0, -0.0, 1e12, -1e12, np.inf, -np.inf, np.nan, 5e-324, 1.7e308, 80.0]
EXTREMES = np.array([np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, 0.0, -0.0, 1.0, 1e20])


def finite(learner: Learner, diagnostics: Diagnostics | None = None) -> None:
    assert all(np.isfinite(w).all() for w in learner.actor.weights.values())
    if diagnostics is not None:
        figures = (
            diagnostics.policy_loss,
            diagnostics.value_loss,
            diagnostics.entropy,
            diagnostics.moved,
            diagnostics.clipped,
            diagnostics.gradient,
        )
        assert np.isfinite(figures).all()
        assert diagnostics.skipped == 0


def decide_and_learn(learner: Learner, states: list[State], rewards=None) -> Diagnostics:
    actions, logps = learner.act(states)
    assert np.isfinite(logps).all() and (logps <= 1e-9).all()
    given = np.random.default_rng(0).standard_normal(len(states)) if rewards is None else rewards
    diagnostics = learner.update(learner.batch(states, actions, logps, given))
    finite(learner, diagnostics)
    assert np.isfinite(learner.value(states)).all()
    return diagnostics


def learns_on(learner: Learner, problem) -> None:
    """What happened before has broken nothing: an easy problem is still learned. Anything learned from noise
    has to be unlearned, hence more updates than a new learner needs."""
    teach(learner, problem, 16)
    finite(learner)
    assert regret(learner, problem) < 0.04


@by_action
def test_extreme_ages(spec):
    n = len(EXTREME_AGES_MS)
    states = []
    for shift in range(n):
        s = state(n, np.random.default_rng(shift), d=4)
        states.append(replace(s, ages_ms=np.roll(EXTREME_AGES_MS, shift), reported=np.ones(n, bool)))
    assert np.isfinite(LAYOUT.batch(states)).all()
    for _ in range(3):
        decide_and_learn(Learner(spec, 0), states)
    order = np.argsort(StateLayout(("age",)).features(states[0])[[0, 9, 2], 0])
    np.testing.assert_array_equal(order, [0, 1, 2])  # 0, 80 and 1e12 ms stay in order


def test_a_camera_whose_age_is_no_number_is_as_silent_as_one_that_never_reported():
    s = state(4, np.random.default_rng(0), d=4)
    s.ages_ms[2] = np.nan
    learner = Learner(replace(SPECS[0], start=0.9), 0)
    assert not LAYOUT.features(s)[2].any()
    assert not any(learner.act([s])[0][0, 2] for _ in range(50))


@by_action
def test_all_cameras_silent(spec):
    learner = Learner(spec, 0)
    silent = [state(5, np.random.default_rng(i), d=4, silent=5) for i in range(8)]
    diagnostics = decide_and_learn(learner, silent)
    assert diagnostics.dropped == 0
    actions, logps = learner.act(silent)
    if spec.action == "select":
        assert not actions.any() and not logps.any()
    mixed = [*silent, *(state(5, np.random.default_rng(i), d=4) for i in range(8))]
    decide_and_learn(learner, mixed)


@pytest.mark.parametrize("part", ["poses", "embeddings"])
@by_action
def test_extreme_poses_and_embeddings(spec, part):
    rng = np.random.default_rng(1)
    states = []
    for _ in range(16):
        s = state(6, rng, d=4)
        array = rng.choice(EXTREMES, getattr(s, part).shape).astype(getattr(s, part).dtype)
        states.append(replace(s, **{part: array}))
    assert np.abs(LAYOUT.batch(states)).max() <= LAYOUT.limit
    decide_and_learn(Learner(spec, 0), states)
    seen = np.concatenate([s.embeddings for s in states if s.embeddings is not None]).astype(np.float64)
    fitted = LAYOUT.standardized(seen)
    assert np.isfinite(fitted.batch(states)).all()
    decide_and_learn(Learner(replace(spec, layout=fitted), 0), states)


@by_action
def test_nan_in_one_cameras_embedding_is_no_news_of_the_others(spec):
    s = state(5, np.random.default_rng(2), d=4)
    assert s.embeddings is not None
    broken = s.embeddings.copy()
    broken[2, 1] = np.nan
    found, whole = LAYOUT.features(replace(s, embeddings=broken)), LAYOUT.features(s)
    others = [0, 1, 3, 4]
    np.testing.assert_array_equal(found[others], whole[others])
    assert not found[2, :4].any() and found[2, 4:].all()  # its age and pose still count
    decide_and_learn(Learner(spec, 0), [replace(s, embeddings=broken)] * 8)


@by_action
@pytest.mark.parametrize("reward", [0.0, 0.873, -1e9, 1e90])
def test_constant_reward_moves_the_policy_nowhere(spec, reward):
    learner = Learner(replace(spec, entropy=0.0), 0)
    before = learner.actor.weights
    states = [state(6, np.random.default_rng(i), d=4) for i in range(32)]
    for _ in range(10):
        diagnostics = decide_and_learn(learner, states, np.full(32, reward))
        assert diagnostics.explained is None and diagnostics.reward == pytest.approx(reward)
    assert all(np.array_equal(w, learner.actor.weights[name]) for name, w in before.items())


def test_after_a_constant_reward_one_that_varies_is_learned():
    learner, problem = Learner(Spec("select", FreshOnes.layout), 0), FreshOnes()
    for number in range(4):
        batch = collect(learner, problem, range(64 * number, 64 * number + 64))
        learner.update(replace(batch, rewards=np.full(64, 0.5)))
    learns_on(learner, problem)


@by_action
def test_zero_variance_advantages(spec):
    """One decision, or the same one with the same reward many times."""
    learner = Learner(spec, 0)
    s = state(6, np.random.default_rng(0), d=4)
    decide_and_learn(learner, [s], np.array([0.4]))
    actions, logps = learner.act([s])
    same = learner.batch([s] * 16, np.repeat(actions, 16, axis=0), np.repeat(logps, 16), np.full(16, 0.7))
    finite(learner, learner.update(same))


@pytest.mark.parametrize("size", [1e-12, 1e-3, 1e6, 1e90])
def test_the_unit_of_a_reward_does_not_matter(size):
    def scaled(batch: Batch) -> Batch:
        return replace(batch, rewards=size * batch.rewards + 3.0 * size)

    learner, problem = Learner(Spec("select", FreshOnes.layout), 0), FreshOnes()
    for number in range(8):
        diagnostics = learner.update(scaled(collect(learner, problem, range(64 * number, 64 * number + 64))))
        finite(learner, diagnostics)
    assert regret(learner, problem) < 0.03


def test_rewards_that_are_no_numbers_are_left_out_and_counted():
    learner, problem = Learner(Spec("select", FreshOnes.layout), 0), FreshOnes()
    for number in range(10):
        batch = collect(learner, problem, range(64 * number, 64 * number + 64))
        batch.rewards[::3] = [np.nan, np.inf, -np.inf, 1e200] * 5 + [np.nan, -1e300]
        diagnostics = learner.update(batch)
        finite(learner, diagnostics)
        assert diagnostics.dropped == 22
    assert regret(learner, problem) < 0.03
    nothing = collect(learner, problem, range(8))
    nothing.rewards[:] = np.nan
    before = learner.actor.weights
    diagnostics = learner.update(nothing)
    assert diagnostics.steps == 0 and diagnostics.dropped == 8 and diagnostics.reward is None
    assert all(np.array_equal(w, learner.actor.weights[k]) for k, w in before.items())


@pytest.mark.parametrize("at", [0, 3])
def test_an_accident_among_the_rewards_does_not_drown_the_others(at):
    """One reward of a million, in the first batch or later: neither the spread nor V is spoilt by it."""
    learner, problem = Learner(Spec("select", FreshOnes.layout), 0), FreshOnes()
    for number in range(10):
        batch = collect(learner, problem, range(64 * number, 64 * number + 64))
        if number == at:
            batch.rewards[5] = 1e6
        finite(learner, learner.update(batch))
    assert regret(learner, problem) < 0.03


@pytest.mark.parametrize("bias", [-1e4, -800.0, -40.0, 40.0, 800.0, 1e4])
def test_probabilities_at_0_and_1(bias):
    learner = pushed(Learner(Spec("select", FreshOnes.layout), 0), bias)
    drawn = [FreshOnes().draw(i) for i in range(64)]
    states = [d.state for d in drawn]
    actions, logps = learner.act(states)
    assert actions.all() if bias > 0 else (actions.sum(axis=1) == 1).all()
    assert np.isfinite(logps).all()
    finite(
        learner, learner.update(learner.batch(states, actions, logps, [d.reward(a)[0] for d, a in zip(drawn, actions)]))
    )


@pytest.mark.parametrize("bias", [-6.0, 6.0])
def test_a_policy_that_was_nearly_certain_learns_on(bias):
    learner = pushed(Learner(Spec("select", FreshOnes.layout), 0), bias)
    teach(learner, FreshOnes(), 24)
    assert regret(learner, FreshOnes()) < 0.05


def pushed(learner: Learner, bias: float) -> Learner:
    import torch

    with torch.no_grad():
        learner._actor["out_b"].fill_(bias)
    return learner


@by_action
@pytest.mark.parametrize("claimed", [-1e300, -800.0, -50.0, 0.0])
def test_ratios_that_overflow(spec, claimed):
    """Log-probabilities that another policy, or a damaged record, claims."""
    learner = Learner(spec, 0)
    states = [state(6, np.random.default_rng(i), d=4) for i in range(32)]
    actions, _ = learner.act(states)
    rewards = np.random.default_rng(1).standard_normal(32)
    for _ in range(5):
        finite(learner, learner.update(learner.batch(states, actions, np.full(32, claimed), rewards)))
    diagnostics = learner.update(learner.batch(states, actions, np.full(32, np.nan), rewards))
    assert diagnostics.dropped == 32


@pytest.mark.parametrize("n", [1, pytest.param(200, marks=pytest.mark.slow)])
def test_one_camera_and_two_hundred(n):
    problem, waits = FreshOnes(cameras=n), Waits(cameras=n)
    chooser = Learner(Spec("select", problem.layout), 0)
    teach(chooser, problem, 8, 32)
    finite(chooser)
    if n == 1:
        assert regret(chooser, problem) == 0.0  # there is but one set that is not empty
    else:
        assert regret(chooser, problem, 30) < 0.1  # a random set loses .35
    waiter = Learner(Spec("wait", waits.layout, OMEGAS_MS), 0)
    teach(waiter, waits, 12, 32)
    finite(waiter)
    assert regret(waiter, waits, 100) < 0.04


@by_action
def test_a_batch_of_rigs_of_different_sizes(spec):
    states = [state(n, np.random.default_rng(n), d=4) for n in (1, 2, 18, 200)]
    decide_and_learn(Learner(spec, 0), states)


@by_action
def test_after_all_of_this_it_learns_on(spec):
    """One learner, every hard case in turn, then a problem it can solve."""
    problem = FreshOnes() if spec.action == "select" else Waits()
    spec = replace(spec, layout=problem.layout)
    learner = Learner(spec, 0)
    rng = np.random.default_rng(0)
    hard = [state(6, rng, silent=k) for k in range(7)]
    hard += [replace(s, ages_ms=rng.choice(EXTREME_AGES_MS, 6), reported=np.ones(6, bool)) for s in hard]
    decide_and_learn(learner, hard)
    decide_and_learn(learner, hard, np.full(14, 0.8))
    decide_and_learn(learner, hard, np.where(np.arange(14) % 3, np.nan, 1e6))
    actions, _ = learner.act(hard)
    finite(learner, learner.update(learner.batch(hard, actions, np.full(14, -1e5), rng.standard_normal(14))))
    learns_on(learner, problem)


def test_a_policy_of_extreme_weights_still_decides():
    spec = SPECS[0]
    actor = Learner(spec, 0).actor
    for size in (1e-300, 1e3, 1e150):
        big = replace(actor, weights={k: size * w for k, w in actor.weights.items()})
        s = state(6, np.random.default_rng(0), d=4, silent=1)
        for explore in (False, True):
            p = BanditPolicy(big, "bandit:test", np.random.default_rng(0), explore)
            chosen, logps = p.actor.act([s], np.random.default_rng(0) if explore else None)
            assert chosen.any() and not chosen[0, 5] and np.isfinite(logps).all()
