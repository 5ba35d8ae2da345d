"""The environments of gymnasium: what its own checker asks for, and that they decide as policies do."""

from __future__ import annotations

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed (extra gym)")
from gymnasium.utils.env_checker import check_env  # noqa: E402

import freshfield.gym  # noqa: E402
from edge_server.experiments.rollouts.episode import mean_outcome  # noqa: E402
from edge_server.experiments.rollouts.rollout import choose, named  # noqa: E402

SMALL = {"decisions": 3, "steps": 2, "size": 16, "warm_steps": 4, "span_ms": 500.0}


def make(name: str, **more):
    return gymnasium.make(f"freshfield/{name}-v0", scenario="room", **{**SMALL, **more}).unwrapped


def test_gymnasiums_checker_finds_nothing():
    gymnasium.register_envs(freshfield.gym)
    check_env(make("Select"), skip_render_check=True)


def test_a_step_is_what_the_policy_of_its_action_gets():
    env = make("Wait", omegas_ms=(0.0, 80.0))
    env.reset(seed=3)
    episode, rewards = env._episode, []
    for number in range(SMALL["decisions"]):
        policy = named("wait:80")(np.random.default_rng(0))
        expected = mean_outcome(list(episode.evaluate(number, choose(policy, episode, number)).values()))
        _, reward, over, _, info = env.step(1)
        assert info["psnr_moving_db"] == expected.psnr_moving_db and info["missing"] == ()
        rewards.append(reward)
    assert over and all(rewards)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(1)
