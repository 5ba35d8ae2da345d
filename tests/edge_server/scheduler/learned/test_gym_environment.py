"""The gymnasium environment, and Stable-Baselines3's PPO on it as an oracle of our own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra gym: pip install 'freshfield[gym]'")

from gymnasium.utils.env_checker import check_env

from edge_server.scheduler.learned.gym_environment import BanditEnvironment
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.state import State
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, FreshOnes, Waits, regret, teach

SELECT = Spec("select", FreshOnes.layout)
WAIT = Spec("wait", Waits().layout, OMEGAS_MS)


@pytest.mark.parametrize(("problem", "spec"), [(FreshOnes(), SELECT), (Waits(), WAIT)])
def test_it_is_what_gymnasium_calls_an_environment(problem, spec):
    check_env(BanditEnvironment(problem, spec, 6), skip_render_check=True)


def test_an_episode_is_one_decision_with_the_problems_own_reward():
    environment = BanditEnvironment(Waits(), WAIT, 6)
    seen, _ = environment.reset(seed=3)
    _, reward, over, cut, info = environment.step(2)
    assert over and not cut
    again, _ = environment.reset(seed=3)
    np.testing.assert_array_equal(seen, again)
    assert environment.step(2)[1] == reward == info["terms"]["value"]
    with pytest.raises(RuntimeError, match="reset"):
        environment.step(0)


def test_episodes_follow_each_other_where_no_seed_is_given():
    environment = BanditEnvironment(Waits(), WAIT, 6)
    first, _ = environment.reset(seed=3)
    second, _ = environment.reset()
    assert not np.array_equal(first, second)


def test_decisions_are_drawn_one_after_the_other_from_where_the_seed_says():
    drawn = []

    class Noting(Waits):
        def draw(self, seed: int):
            drawn.append(seed)
            return super().draw(seed)

    environment = BanditEnvironment(Noting(), WAIT, 6)
    for seed in (3, None, None, 3, None, 4):
        environment.reset(seed=seed)
    a, b, c, again, after, other = drawn
    assert (b, c) == (a + 1, a + 2) and (again, after) == (a, a + 1) and other not in (a, b, c)


def test_an_empty_set_becomes_the_youngest_camera():
    environment = BanditEnvironment(FreshOnes(silent=2), SELECT, 6)
    seen, _ = environment.reset(seed=1)
    *_, info = environment.step(np.zeros(6, np.int8))
    assert info["forced"]
    youngest = np.zeros(6, np.int8)
    youngest[np.argmin(np.where(seen[:, -1] > 0, seen[:, 0], np.inf))] = 1
    environment.reset(seed=1)
    *_, other = environment.step(youngest)
    assert other["terms"] == info["terms"] and not other["forced"]


class _Sometimes:
    """Two decisions of three have no reward."""

    layout = FreshOnes.layout

    def draw(self, seed: int):
        decision = FreshOnes().draw(seed)
        known = seed % 3 == 0
        return _Known(decision.state, float(seed) if known else np.nan)


@dataclass(frozen=True)
class _Known:
    state: State
    worth: float

    def reward(self, action):
        return self.worth, {"value": None if np.isnan(self.worth) else self.worth}


def test_where_no_reward_could_be_had_other_learners_get_the_mean_so_far():
    environment = BanditEnvironment(_Sometimes(), SELECT, 6)
    environment.reset(seed=0)
    given, known = [], []
    for _ in range(40):
        *_, info = (found := environment.step(np.ones(6, np.int8)))
        expected = np.mean(known) if known else 0.0
        if info["missing"]:
            assert found[1] == pytest.approx(expected)
        else:
            known.append(found[1])
        given.append(info["missing"])
        environment.reset()
    assert 5 < len(known) < 35 and any(given) and np.isfinite(known).all()


@pytest.mark.slow
@pytest.mark.parametrize(("problem", "spec"), [(FreshOnes(), SELECT), (Waits(), WAIT)])
def test_stable_baselines_and_our_learner_reach_the_same_optimum(problem, spec):
    """Both must come within .02 of the best reward; a random set loses .35 and a random omega .10. Given
    decisions alike, our learner must not be worse by more than the noise of the test."""
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra gym")
    oracle = sb3.PPO(
        "MlpPolicy",
        BanditEnvironment(problem, spec, 6),
        n_steps=256,
        batch_size=64,
        gamma=0.0,
        gae_lambda=1.0,
        learning_rate=1e-3,
        seed=0,
        device="cpu",
    )
    oracle.learn(10_240)
    drawn = [problem.draw(10**6 + i) for i in range(300)]
    theirs = []
    for d in drawn:
        action, _ = oracle.predict(spec.layout.features(d.state), deterministic=True)
        if spec.action == "select":
            youngest = np.arange(6) == np.argmin(d.state.ages_ms)
            action = action.astype(bool) if action.any() else youngest
        theirs.append(d.regret(action))
    learner = Learner(replace(spec, learning_rate=1e-3), 0)
    teach(learner, problem, 40, 256)
    assert np.mean(theirs) < 0.02
    assert regret(learner, problem) < min(0.02, np.mean(theirs) + 0.005)
