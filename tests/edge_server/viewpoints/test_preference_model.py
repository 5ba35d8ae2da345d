"""The reward model learns a taste from few and partly wrong answers, and says when it knows nothing."""

from __future__ import annotations

import numpy as np

from edge_server.viewpoints.candidates import half_hemisphere
from edge_server.viewpoints.experts import SimulatedExpert
from edge_server.viewpoints.features import GEOMETRY, StepFeatures
from edge_server.viewpoints.preference_model import Answer, fit_reward, next_pair
from freshfield.geometry import Pinhole

DOME = half_hemisphere((0, 0, 0), 1.0, Pinhole.from_fov(16, 16, 50.0), 40)


def pool(seed, count=120):
    """Trajectories of six views by their features, and scores by a taste that is not quite linear in them."""
    rng = np.random.default_rng(seed)
    steps = StepFeatures(DOME)
    features = np.stack([steps.trajectory(rng.choice(40, 6, replace=False)) for _ in range(count)])
    z = (features - features.mean(0)) / features.std(0)
    scores = np.tanh(z @ rng.normal(size=z.shape[1]) / 2) + 0.1 * rng.normal(size=count)
    return features, scores, rng


def ask(expert, features, answers):
    model = fit_reward(features, [])
    for _ in range(answers):
        expert.answer(*next_pair(model, features, expert.rng))
        model = fit_reward(features, expert.asked)
    return model


def agreement(model, features, expert, pairs=400):
    """Share of the expert's answers to unseen pairs that the model foresees."""
    first, second = expert.rng.permuted(np.tile(np.arange(len(features)), (pairs, 1)), axis=1)[:, :2].T
    expected = model.probability(features, first, second) > 0.5
    return np.mean([expert.answer(i, j).prefers_first == e for i, j, e in zip(first, second, expected)])


def test_after_sixty_answers_with_one_in_ten_wrong_it_agrees_as_the_expert_does():
    found = []
    for seed in range(4):
        features, scores, rng = pool(seed)
        expert = SimulatedExpert("edges", scores, rng, wrong=0.1)
        model = ask(expert, features[:80], 60)
        assert model.answers == 60
        expert.scores = scores[80:]
        itself = 1 - 2 * 0.1 * 0.9  # the same answer twice
        found.append(agreement(model, features[80:], expert) / itself)
    assert np.mean(found) >= 0.9


def test_from_contradictions_it_knows_nothing_and_says_so():
    known = 0
    for seed in range(4):
        features, scores, rng = pool(seed)
        model = ask(SimulatedExpert("edges", scores, rng, contradicts=True), features, 40)
        if not model.knows:
            assert "it does not know" in model.says() and "contradict" in model.says()
        known += model.knows
    assert known <= 1


def test_the_posterior_is_that_of_the_likelihood():
    """Against the exact posterior of two weights on a grid."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(30, 2))
    answers = [Answer(i, j, bool(features[i, 0] > features[j, 0])) for i, j in rng.permutation(30)[:20].reshape(10, 2)]
    model = fit_reward(features, answers)
    w = np.stack(np.meshgrid(*[np.linspace(-40, 40, 401)] * 2), -1).reshape(-1, 2)
    x = np.array([(features[a.first] - features[a.second]) / model.scale * (2 * a.prefers_first - 1) for a in answers])
    first, second = np.array([0, 4, 9]), np.array([7, 2, 5])
    best = None
    for prior in (0.1, 0.3, 1.0, 3.0, 10.0):
        log = -np.logaddexp(0, -w @ x.T).sum(1) - 0.5 * (w**2).sum(1) / prior**2 - 2 * np.log(prior)
        evidence = log.max() + np.log(np.exp(log - log.max()).sum())
        if best is None or evidence > best[0]:
            best = evidence, np.exp(log - log.max()) / np.exp(log - log.max()).sum()
    differences = (features[first] - features[second]) / model.scale
    exact = best[1] @ (1 / (1 + np.exp(-w @ differences.T)))
    np.testing.assert_allclose(model.probability(features, first, second), exact, atol=0.08)


def test_features_of_a_trajectory_are_those_of_its_steps():
    steps = StepFeatures(DOME)
    assert steps.actions([]).shape == (40, len(GEOMETRY))
    order = [3, 17, 30]
    expected = steps.actions([])[3] + steps.actions([3])[17] + steps.actions([3, 17])[30]
    np.testing.assert_allclose(steps.trajectory(order), expected)
    again = steps.actions([3])[3]
    assert np.abs(again[GEOMETRY.index("first view within 0.5 rad")]) < 1e-12 and again[GEOMETRY.index("way")] == 0
    far = int(np.argmax(DOME.travel_m(3)))
    assert steps.actions([3])[far, GEOMETRY.index("first view within 0.5 rad")] > 0
