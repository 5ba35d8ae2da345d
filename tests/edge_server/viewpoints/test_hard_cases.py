"""Viewpoints where next to nothing differs: candidates, rewards, answers, one view, one episode."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields import View
from edge_server.viewpoints.candidates import Candidates, ViewpointError, from_poses, half_hemisphere
from edge_server.viewpoints.capture_planner import Budget, plan_capture
from edge_server.viewpoints.features import StepFeatures
from edge_server.viewpoints.policy import CandidatePolicy, PolicyConfig, train_policy
from edge_server.viewpoints.preference_model import Answer, fit_reward, next_pair
from edge_server.viewpoints.registry import make_selector
from freshfield.geometry import Pinhole, look_at

LENS = Pinhole.from_fov(16, 16, 50.0)
SAME = [look_at((1, 0, 1), (0, 0, 0))] * 6
HARD = {
    "all equal": from_poses(SAME, LENS, (0, 0, 0)),
    "1e-7 apart": from_poses([look_at((1, 1e-7 * k, 1), (0, 0, 0)) for k in range(6)], LENS),
    "at the target": from_poses([np.eye(4)] * 3 + SAME[:3], LENS, (0, 0, 0)),
    "only one": from_poses(SAME[:1], LENS),
}
hard = pytest.mark.parametrize("candidates", HARD.values(), ids=HARD)
pytestmark = [pytest.mark.stability, pytest.mark.filterwarnings("error::RuntimeWarning")]
DOME = half_hemisphere((0, 0, 0), 1.0, LENS, 12)


@pytest.mark.parametrize("name", ["random", "coverage"])
@hard
def test_candidates_that_hardly_differ_are_taken_once_each(candidates: Candidates, name: str) -> None:
    def take(k: int) -> View:
        return View(f"v{k}", np.zeros((16, 16, 3), np.uint8), candidates.poses[k], LENS)

    plan = plan_capture(candidates, make_selector(name), Budget(views=4), take, seed=0)
    assert len(set(plan.order)) == len(plan.order) == min(4, len(candidates))


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
    first, second = next_pair(model, features, np.random.default_rng(0))
    assert model.probability(features, np.array([first]), np.array([second])) == pytest.approx(0.5, abs=0.2)


def trained(candidates: Candidates, value: float, **config: float) -> tuple[CandidatePolicy, list[float]]:
    quick = PolicyConfig(**{"updates": 4, "episodes": 2, "hidden": 8, "way": 0.0, **config})  # type: ignore[arg-type]
    policy, returns = train_policy(candidates, lambda features: np.full(features.shape[:-1], value), quick)
    assert all(np.isfinite(w).all() for w in policy.weights.values())
    return policy, returns


@pytest.mark.parametrize("config", [{"episodes": 1}, {"views": 12}], ids=str)
def test_equal_rewards_keep_their_unit(config: dict[str, float]) -> None:
    """Divided by how much they vary, which is nothing, rewards of 5 were 5e9."""
    views = int(config.get("views", 2))
    _, returns = trained(DOME, 5.0, **{"views": 2, **config})
    assert returns == pytest.approx([5.0 * (views - 1)] * 4)


def test_equal_candidates_train_and_one_view_is_refused() -> None:
    trained(HARD["all equal"], 0.0, views=3)
    for candidates in (HARD["only one"], DOME):
        with pytest.raises(ViewpointError, match="at least 2"):
            trained(candidates, 0.0, views=1)
