"""The learning scheduler where numbers end: whatever it is given, it stays finite and learns on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.scheduler.learned.ppo import Diagnostics, Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import State, StateLayout
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, FreshOnes, collect, regret, state

pytestmark = pytest.mark.stability
LAYOUT = StateLayout(("age", "pose", "semantics"), dim=4)
SPECS = [Spec("select", LAYOUT), Spec("wait", LAYOUT, OMEGAS_MS)]
by_action = pytest.mark.parametrize("spec", SPECS, ids=lambda s: s.action)

EXTREME_AGES_MS = [0.0, -0.0, 1e12, -1e12, np.inf, -np.inf, np.nan, 5e-324, 1.7e308, 80.0]
EXTREMES = np.array([np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, 0.0, -0.0, 1.0, 1e20])


def finite(learner: Learner, diagnostics: Diagnostics | None = None) -> None:
    assert all(np.isfinite(w).all() for w in learner.actor.weights.values())
    if diagnostics is not None:
        d = diagnostics
        assert np.isfinite((d.policy_loss, d.value_loss, d.entropy, d.moved, d.clipped, d.gradient)).all()
        assert d.skipped == 0


def decide_and_learn(learner: Learner, states: list[State], rewards=None) -> Diagnostics:
    actions, logps = learner.act(states)
    assert np.isfinite(logps).all() and (logps <= 1e-9).all()
    given = np.random.default_rng(0).standard_normal(len(states)) if rewards is None else rewards
    diagnostics = learner.update(learner.batch(states, actions, logps, given))
    finite(learner, diagnostics)
    assert np.isfinite(learner.value(states)).all()
    return diagnostics


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


@pytest.mark.parametrize("part", ["poses", "embeddings"])
@by_action
def test_extreme_poses_and_embeddings(spec, part):
    rng = np.random.default_rng(1)
    states = []
    for _ in range(16):
        s = state(6, rng, d=4)
        array = rng.choice(EXTREMES, getattr(s, part).shape).astype(getattr(s, part).dtype)
        states.append(replace(s, **{part: array}))
    assert np.abs(LAYOUT.batch(states)).max() <= max(8.0, np.log1p(LAYOUT.oldest_ms / LAYOUT.age_scale_ms))
    decide_and_learn(Learner(spec, 0), states)
    seen = np.concatenate([s.embeddings for s in states if s.embeddings is not None]).astype(np.float64)
    fitted = LAYOUT.standardized(seen)
    assert np.isfinite(fitted.batch(states)).all()
    decide_and_learn(Learner(replace(spec, layout=fitted), 0), states)


@by_action
@pytest.mark.parametrize("reward", [0.873, 1e90])
def test_constant_reward_moves_the_policy_nowhere(spec, reward):
    learner = Learner(replace(spec, entropy=0.0), 0)
    before = learner.actor.weights
    states = [state(6, np.random.default_rng(i), d=4) for i in range(32)]
    for _ in range(10):
        diagnostics = decide_and_learn(learner, states, np.full(32, reward))
        assert diagnostics.explained is None and diagnostics.reward == pytest.approx(reward)
    assert all(np.array_equal(w, learner.actor.weights[name]) for name, w in before.items())


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
    diagnostics = learner.update(nothing)
    assert diagnostics.steps == 0 and diagnostics.dropped == 8 and diagnostics.reward is None


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
