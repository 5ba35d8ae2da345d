"""Candidates, selectors and plans: what they promise; a policy that learns, and comes back from its file."""

from __future__ import annotations

import json

import numpy as np
import pytest

from edge_server.fields import View
from edge_server.viewpoints.candidates import ViewpointError, from_poses, half_hemisphere
from edge_server.viewpoints.capture_planner import Budget, plan_capture
from edge_server.viewpoints.features import GEOMETRY
from edge_server.viewpoints.policy import PolicyConfig, train_policy
from edge_server.viewpoints.registry import SELECTORS, CaptureState, make_selector
from freshfield.geometry import Pinhole

LENS = Pinhole.from_fov(16, 16, 50.0)
TARGET = np.array([0.1, -0.2, 0.3])
GEOMETRIC = [name for name, (module, _, _) in SELECTORS.items() if module == "geometric"]
DOME = half_hemisphere(TARGET, 0.8, LENS, 60)


def take(k):
    return View(f"v{k}", np.full((16, 16, 3), k, np.uint8), DOME.poses[k], LENS)


class Fixed:
    """Values that a user's own selector might give."""

    name = "fixed"

    def __init__(self, values):
        self.given = values

    def values(self, state):
        return self.given


def smallest_angle(order):
    cosine = DOME.directions[order] @ DOME.directions[order].T
    return np.arccos(np.clip(cosine[~np.eye(len(order), dtype=bool)], -1, 1)).min()


def test_candidates_look_at_the_target_from_an_even_sector():
    away = DOME.poses[:, :3, 3] - TARGET
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.8)
    np.testing.assert_allclose(DOME.poses[:, :3, 2], -away / 0.8, atol=1e-12)
    assert (away[:, 1] <= 1e-9).all() and (away[:, 2] > 0).all()  # a half of the upper half, on the -y side
    assert smallest_angle(list(range(60))) > 0.4 * np.sqrt(np.pi / 60)
    np.testing.assert_allclose(from_poses(DOME.poses, LENS).target, TARGET, atol=1e-9)


@pytest.mark.parametrize("name", GEOMETRIC)
def test_geometric_selectors_take_the_budget_once_each_and_repeat_by_seed(name):
    plans = [plan_capture(DOME, make_selector(name), Budget(views=9), take, seed=s) for s in (3, 3, 4)]
    assert len(set(plans[0].order)) == 9 and plans[0].order == plans[1].order != plans[2].order
    assert [v.camera for v in plans[0].views] == [f"v{k}" for k in plans[0].order]
    json.dumps(plans[0].as_json(DOME), allow_nan=False)


def test_coverage_spreads_and_travel_weight_shortens_the_path():
    orders = {name: plan_capture(DOME, make_selector(name), Budget(views=9), take, seed=1) for name in GEOMETRIC}
    assert smallest_angle(orders["coverage"].order) > 1.5 * smallest_angle(orders["random"].order)
    short = plan_capture(DOME, make_selector("coverage"), Budget(views=9), take, seed=1, travel_weight=1.0)
    assert short.path_m < 0.8 * orders["coverage"].path_m


def test_a_budget_of_meters_is_kept():
    plan = plan_capture(DOME, make_selector("random"), Budget(path_m=2.0), take)
    assert 1.2 < plan.path_m <= 2.0
    both = plan_capture(DOME, make_selector("random"), Budget(30, 2.0), take)
    assert both.order == plan.order and "Only" in both.note and "the path is used up" in both.note


def test_equal_candidates_are_visited_nearest_first_and_the_plan_says_so():
    plan = plan_capture(DOME, Fixed(np.full(60, 7.0)), Budget(views=4), take)
    nearest = np.argsort(DOME.travel_m(plan.order[0]))
    assert plan.order[1] == int(nearest[1]) and "of equal value" in plan.note
    assert "of equal value: the nearest" in plan.stops[1].why


def test_half_of_the_views_are_refused():
    def spoilt(k):
        return take(k) if k % 2 else None

    plan = plan_capture(DOME, make_selector("random"), Budget(views=8), spoilt)
    assert len(plan.stops) == 8 and all(k % 2 for k in plan.order) and plan.refused
    assert f"{len(plan.refused)} views were refused" in plan.note
    every = plan_capture(DOME, make_selector("random"), Budget(views=50), spoilt)
    assert len(every.stops) == 30 and "Only 30 of 50 views: no candidate is left" in every.note
    with pytest.raises(ViewpointError, match="all 60 reachable candidates were refused"):
        plan_capture(DOME, make_selector("random"), Budget(views=8), lambda k: None)


UNIT_DOME = half_hemisphere((0, 0, 0), 1.0, LENS, 30)
QUICK = PolicyConfig(views=4, updates=25, episodes=12, hidden=16, way=0.0, learning_rate=1e-2)
HEIGHT, WAY = GEOMETRY.index("z"), GEOMETRY.index("way")


def take_of_unit(k):
    return View(f"v{k}", np.full((16, 16, 3), k, np.uint8), UNIT_DOME.poses[k], LENS)


def height(features):
    return features[..., HEIGHT]


@pytest.fixture(scope="module")
def trained():
    return train_policy(UNIT_DOME, height, QUICK, seed=1)


def test_a_policy_learns_what_is_rewarded(trained):
    policy, returns = trained
    assert np.mean(returns[-3:]) > np.mean(returns[:3]) + 0.5
    plan = plan_capture(UNIT_DOME, policy, Budget(views=4), take_of_unit, seed=0)
    chance = plan_capture(UNIT_DOME, make_selector("random"), Budget(views=4), take_of_unit, seed=0)
    assert len(set(plan.order)) == 4 and plan.order[0] == chance.order[0]
    high = UNIT_DOME.directions[:, 2]
    assert high[plan.order[1:]].mean() > np.quantile(high, 0.7)


def test_training_repeats_by_seed_and_unreachable_candidates_are_never_taken():
    half = UNIT_DOME.within(np.arange(30) % 2)
    short = PolicyConfig(views=4, updates=2, episodes=6, hidden=8)
    (one, a), (two, b) = (train_policy(half, height, short, seed=3) for _ in range(2))
    assert a == b and all(np.array_equal(one.weights[k], two.weights[k]) for k in one.weights)
    assert half.reachable[plan_capture(half, one, Budget(views=15), take_of_unit).order].all()
    with pytest.raises(ViewpointError, match="3 candidates can be reached, an episode has 4"):
        train_policy(UNIT_DOME.within(np.arange(30) < 3), height, short)


def test_embeddings_of_captured_pictures_are_part_of_the_state():
    embeddings = np.random.default_rng(0).normal(size=(30, 3))
    short = PolicyConfig(views=4, updates=1, episodes=6, hidden=8)
    policy, _ = train_policy(
        UNIT_DOME, height, short, embeddings=embeddings, embed=lambda images: embeddings[[i[0, 0, 0] for i in images]]
    )
    state = CaptureState(UNIT_DOME, 4, np.random.default_rng(0), None, [5, 9], [take_of_unit(5), take_of_unit(9)])
    values = policy.values(state)
    state.views[0] = take_of_unit(20)  # another picture there
    assert not np.array_equal(values, policy.values(state))
    policy.embed = None
    with pytest.raises(ViewpointError, match="give it the embedder"):
        policy.values(state)


def test_a_policy_comes_back_from_its_file(trained, tmp_path):
    policy, _ = trained
    policy.save(tmp_path / "policy.npz")
    loaded = make_selector(f"ppo:{tmp_path / 'policy.npz'}")
    dome = half_hemisphere((0, 0, 0), 1.0, LENS, 100)
    state = CaptureState(dome, 4, np.random.default_rng(0), None, [5, 9], [take_of_unit(5), take_of_unit(9)])
    np.testing.assert_array_equal(loaded.values(state), policy.values(state))
