"""Candidates, selectors and plans: what they promise; Fisher information against torch; a policy that learns."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from edge_server.fields import View
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.kernels.project import BASE
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.viewpoints.candidates import Candidates, ViewpointError, from_poses, half_hemisphere
from edge_server.viewpoints.capture_planner import Budget, plan_capture, travel_m
from edge_server.viewpoints.features import GEOMETRY, StepFeatures
from edge_server.viewpoints.fisher import FisherRF, information
from edge_server.viewpoints.policy import CandidatePolicy, PolicyConfig, train_policy
from edge_server.viewpoints.preference_model import Answer, fit_reward
from edge_server.viewpoints.registry import SELECTORS, CaptureState, make_selector
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat import torch_oracle
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, random_params
from tests.support import refused

LENS = Pinhole.from_fov(16, 16, 50.0)
TARGET = np.array([0.1, -0.2, 0.3])
GEOMETRIC = [name for name, (module, _, _) in SELECTORS.items() if module == "geometric"]
DOME = half_hemisphere(TARGET, 0.8, LENS, 60)


def taker(candidates):
    """Captures candidate k: its gray level says which it is."""
    return lambda k: View(f"v{k}", np.full((16, 16, 3), k, np.uint8), candidates.poses[k], LENS)


take = taker(DOME)


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


def test_equal_candidates_are_visited_nearest_first():
    fixed = SimpleNamespace(name="fixed", values=lambda state: np.full(60, 7.0))  # a user's own selector
    plan = plan_capture(DOME, fixed, Budget(views=4), take)
    assert plan.order[1] == int(np.argsort(travel_m(DOME, plan.order[0]))[1]) and "of equal value" in plan.note


def test_half_of_the_views_are_refused():
    plan = plan_capture(DOME, make_selector("random"), Budget(views=50), lambda k: take(k) if k % 2 else None)
    assert len(plan.stops) == 30 and all(k % 2 for k in plan.order) and len(plan.refused) == 30
    assert "30 views were refused" in plan.note and "Only 30 of 50 views: no candidate is left" in plan.note
    with pytest.raises(ViewpointError, match="all 60 reachable candidates were refused"):
        plan_capture(DOME, make_selector("random"), Budget(views=8), lambda k: None)


UNIT_DOME = half_hemisphere((0, 0, 0), 1.0, LENS, 30)
QUICK = PolicyConfig(views=4, updates=25, episodes=12, hidden=16, way=0.0, learning_rate=1e-2)
HEIGHT = GEOMETRY.index("z")
take_of_unit = taker(UNIT_DOME)


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
    refused(ViewpointError, "give it the embedder", policy.values, state)


def test_a_policy_comes_back_from_its_file(trained, tmp_path):
    policy, _ = trained
    policy.save(tmp_path / "policy.npz")
    loaded = make_selector(f"ppo:{tmp_path / 'policy.npz'}")
    dome = half_hemisphere((0, 0, 0), 1.0, LENS, 100)
    state = CaptureState(dome, 4, np.random.default_rng(0), None, [5, 9], [take_of_unit(5), take_of_unit(9)])
    np.testing.assert_array_equal(loaded.values(state), policy.values(state))


TINY = Pinhole(9, 7, 9.0, 9.5, 4.3, 3.6)
BENT = replace(TINY, distortion=(-0.12, 0.03, 0.01, -0.015))
BACK = np.array([0.2, 0.5, 0.9], np.float32)
POSES = [look_at(eye, (0.05, 0.0, 0.1)) for eye in ((1.0, -2.5, 0.8), (-0.4, -1.2, 2.0))]


def snapshot(params, threads=1):
    return SplatSnapshot(BOX, params, BACK, Pool(threads, 0), 1)


def oracle(params, pose, lens):
    """Sum over pixels and colors of squared derivatives, one backward pass a color of a pixel."""
    wanted = torch.tensor(params, dtype=torch.float64, requires_grad=True)
    cam = torch.as_tensor(camera_rows([pose], [lens], BOX)[0], dtype=torch.float64)
    flat = torch_oracle.flatten(cam, wanted, 0)
    back = torch.as_tensor(BACK, dtype=torch.float64)
    color = torch_oracle.composite(flat, lens.width, lens.height, back)[0]
    total = torch.zeros_like(wanted)
    for value in color.ravel():
        total += torch.autograd.grad(value, wanted, retain_graph=True)[0] ** 2
    return total.numpy()


@pytest.mark.parametrize("lens", [TINY, BENT])
def test_information_is_the_sum_of_squared_derivatives(lens):
    params = random_params(6, seed=4)
    params[5, :3] = (0.0, 0.0, 500.0)  # outside all pictures
    for pose, found in zip(POSES, information(snapshot(params), POSES, [lens] * 2, images=800), strict=True):
        exact = oracle(params, pose, lens)
        np.testing.assert_allclose(found, exact, rtol=0.25, atol=1e-5 * exact.max())  # five standard deviations
        assert not found[5].any() and found[:5].any(axis=1).all()


def test_information_is_the_same_whatever_the_threads_and_the_order():
    params = random_params(300)
    one = list(information(snapshot(params), POSES, [TINY] * 2))
    two = list(information(snapshot(params, 2), POSES[::-1], [TINY] * 2))[::-1]
    np.testing.assert_array_equal(one, two)


def test_fisher_prefers_what_was_not_seen():
    """Gaussians left and right; the left ones were seen: a view of the right ones is worth more."""
    params = random_params(200)
    params[:, :3] = np.random.default_rng(1).normal(0.0, 0.1, (200, 3))
    params[:100, 0] -= 1.0
    params[100:, 0] += 1.0
    narrow = Pinhole.from_fov(16, 16, 20.0)
    poses = np.stack([look_at((x, -2.5, 0.6), (x, 0, 0)) for x in (-1.0, 1.0)])
    known = type("Known", (), {"snapshot": lambda self: snapshot(params)})()
    left = View("left", np.zeros((16, 16, 3), np.uint8), poses[0], narrow)
    candidates = replace(half_hemisphere((0, 0, 0), 2.5, narrow, 2), poses=poses)
    state = CaptureState(candidates, 2, np.random.default_rng(0), lambda views: known, [0], [left])
    state.open[:] = True
    values = FisherRF().values(state)
    assert values[1] > 2.0 * values[0] > 0.0 and params.shape[1] == BASE


SAME = [look_at((1, 0, 1), (0, 0, 0))] * 6
HARD = {
    "all equal": from_poses(SAME, LENS, (0, 0, 0)),
    "1e-7 apart": from_poses([look_at((1, 1e-7 * k, 1), (0, 0, 0)) for k in range(6)], LENS),
    "at the target": from_poses([np.eye(4)] * 3 + SAME[:3], LENS, (0, 0, 0)),
    "only one": from_poses(SAME[:1], LENS),
}
hard = pytest.mark.parametrize("candidates", HARD.values(), ids=HARD)
no_warning = pytest.mark.filterwarnings("error::RuntimeWarning")
FEW = half_hemisphere((0, 0, 0), 1.0, LENS, 12)


@pytest.mark.stability
@no_warning
@pytest.mark.parametrize("name", ["random", "coverage"])
@hard
def test_candidates_that_hardly_differ_are_taken_once_each(candidates: Candidates, name: str) -> None:
    plan = plan_capture(candidates, make_selector(name), Budget(views=4), taker(candidates), seed=0)
    assert len(set(plan.order)) == len(plan.order) == min(4, len(candidates))


@pytest.mark.stability
@no_warning
@pytest.mark.parametrize(
    "answers", [[], [Answer(0, 1, True)], [Answer(0, 1, True), Answer(0, 1, False)] * 30, [Answer(2, 2, True)] * 9]
)
@hard
def test_answers_about_what_hardly_differs_say_nothing(candidates: Candidates, answers: list[Answer]) -> None:
    steps = StepFeatures(candidates)
    features = np.stack([steps.trajectory([k % len(candidates)]) for k in range(4)])
    model = fit_reward(features, answers)
    assert not model.knows
    assert np.isfinite(model.reward(features)).all()


def briefly_trained(candidates: Candidates, value: float, **config: float) -> tuple[CandidatePolicy, list[float]]:
    quick = PolicyConfig(**{"updates": 4, "episodes": 2, "hidden": 8, "way": 0.0, **config})  # type: ignore[arg-type]
    policy, returns = train_policy(candidates, lambda features: np.full(features.shape[:-1], value), quick)
    assert all(np.isfinite(w).all() for w in policy.weights.values())
    return policy, returns


@pytest.mark.stability
@no_warning
@pytest.mark.parametrize("config", [{"episodes": 1}, {"views": 12}], ids=str)
def test_equal_rewards_keep_their_unit(config: dict[str, float]) -> None:
    """Divided by how much they vary, which is nothing, rewards of 5 were 5e9."""
    views = int(config.get("views", 2))
    _, returns = briefly_trained(FEW, 5.0, **{"views": 2, **config})
    assert returns == pytest.approx([5.0 * (views - 1)] * 4)


@pytest.mark.stability
@no_warning
def test_equal_candidates_train_and_one_view_is_refused() -> None:
    briefly_trained(HARD["all equal"], 0.0, views=3)
    for candidates in (HARD["only one"], FEW):
        refused(ViewpointError, "at least 2", briefly_trained, candidates, 0.0, views=1)
