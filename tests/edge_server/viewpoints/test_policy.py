"""The policy over candidates learns a reward, weighs the way, and comes back from its file."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields import View
from edge_server.viewpoints.candidates import ViewpointError, half_hemisphere
from edge_server.viewpoints.capture_planner import Budget, plan_capture
from edge_server.viewpoints.features import GEOMETRY
from edge_server.viewpoints.policy import PolicyConfig, train_policy
from edge_server.viewpoints.registry import CaptureState, make_selector
from freshfield.geometry import Pinhole

LENS = Pinhole.from_fov(16, 16, 50.0)
DOME = half_hemisphere((0, 0, 0), 1.0, LENS, 30)
QUICK = PolicyConfig(views=4, updates=25, episodes=12, hidden=16, way=0.0, learning_rate=1e-2)
HEIGHT, WAY = GEOMETRY.index("z"), GEOMETRY.index("way")


def take(k):
    return View(f"v{k}", np.full((16, 16, 3), k, np.uint8), DOME.poses[k], LENS)


def height(features):
    return features[..., HEIGHT]


@pytest.fixture(scope="module")
def trained():
    return train_policy(DOME, height, QUICK, seed=1)


def test_a_policy_learns_what_is_rewarded(trained):
    policy, returns = trained
    assert np.mean(returns[-3:]) > np.mean(returns[:3]) + 0.5
    plan = plan_capture(DOME, policy, Budget(views=4), take, seed=0)
    chance = plan_capture(DOME, make_selector("random"), Budget(views=4), take, seed=0)
    assert len(set(plan.order)) == 4 and plan.order[0] == chance.order[0]
    high = DOME.directions[:, 2]
    assert high[plan.order[1:]].mean() > np.quantile(high, 0.7)


def test_training_repeats_by_seed_and_unreachable_candidates_are_never_taken():
    half = DOME.within(np.arange(30) % 2)
    short = PolicyConfig(views=4, updates=2, episodes=6, hidden=8)
    (one, a), (two, b) = (train_policy(half, height, short, seed=3) for _ in range(2))
    assert a == b and all(np.array_equal(one.weights[k], two.weights[k]) for k in one.weights)
    assert half.reachable[plan_capture(half, one, Budget(views=15), take).order].all()
    with pytest.raises(ViewpointError, match="3 candidates can be reached, an episode has 4"):
        train_policy(DOME.within(np.arange(30) < 3), height, short)


def test_embeddings_of_captured_pictures_are_part_of_the_state():
    embeddings = np.random.default_rng(0).normal(size=(30, 3))
    short = PolicyConfig(views=4, updates=1, episodes=6, hidden=8)
    policy, _ = train_policy(
        DOME, height, short, embeddings=embeddings, embed=lambda images: embeddings[[i[0, 0, 0] for i in images]]
    )
    state = CaptureState(DOME, 4, np.random.default_rng(0), None, [5, 9], [take(5), take(9)])
    values = policy.values(state)
    state.views[0] = take(20)  # another picture there
    assert not np.array_equal(values, policy.values(state))
    policy.embed = None
    with pytest.raises(ViewpointError, match="give it the embedder"):
        policy.values(state)


def test_a_policy_comes_back_from_its_file(trained, tmp_path):
    policy, _ = trained
    policy.save(tmp_path / "policy.npz")
    loaded = make_selector(f"ppo:{tmp_path / 'policy.npz'}")
    dome = half_hemisphere((0, 0, 0), 1.0, LENS, 100)
    state = CaptureState(dome, 4, np.random.default_rng(0), None, [5, 9], [take(5), take(9)])
    np.testing.assert_array_equal(loaded.values(state), policy.values(state))
