"""The gymnasium environment, and Stable-Baselines3's PPO on it as an oracle of our own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra gym: pip install 'freshfield[gym]'")

from gymnasium.utils.env_checker import check_env

from edge_server.scheduler.learned.gym_environment import BanditEnvironment
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.state import State
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, FreshOnes, Waits

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
