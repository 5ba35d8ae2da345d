"""Preferences: the reward model learns a taste from few and partly wrong answers; a session of comparisons."""

import json

import numpy as np
import pytest

from edge_server.viewpoints.candidates import ViewpointError, half_hemisphere
from edge_server.viewpoints.capture_planner import travel_m
from edge_server.viewpoints.experts import SimulatedExpert, judge
from edge_server.viewpoints.features import GEOMETRY, StepFeatures
from edge_server.viewpoints.preference_model import Answer, fit_reward, random_pair
from edge_server.viewpoints.preference_session import PreferenceSession, Question
from freshfield.geometry import Pinhole
from tests.support import refused

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
    for _ in range(answers):
        expert.answer(*random_pair(len(features), expert.rng))
    return fit_reward(features, expert.asked)


def agreement(model, features, expert, pairs=400):
    """Share of the expert's answers to unseen pairs that the model foresees."""
    first, second = expert.rng.permuted(np.tile(np.arange(len(features)), (pairs, 1)), axis=1)[:, :2].T
    rewards = model.reward(features)
    expected = rewards[first] > rewards[second]
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


def test_tastes_are_of_the_object_of_edges_and_of_detail():
    truth = np.zeros((16, 16, 3))
    truth[4:12, 4:12] = 1.0
    assert judge("object", [truth * 0.8], [truth]) == pytest.approx(-0.04)  # squared, over the object alone
    assert judge("edges", [truth], [truth]) == judge("texture", [truth], [truth]) == 0.0
    at_a_corner = truth.copy()
    at_a_corner[12:, 12:] = 1.0  # of four corners one is the object's
    assert judge("object", [at_a_corner * 0.8], [at_a_corner]) == pytest.approx(-0.04)


def test_from_contradictions_it_knows_nothing():
    known = 0
    for seed in range(4):
        features, scores, rng = pool(seed)
        known += ask(SimulatedExpert("edges", scores, rng, contradicts=True), features, 40).knows
    assert known <= 1


def test_the_odds_are_those_of_the_exact_evidence():
    """Of two weights, on a grid."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(30, 2))
    answers = [Answer(i, j, bool(features[i, 0] > features[j, 0])) for i, j in rng.permutation(30)[:20].reshape(10, 2)]
    model = fit_reward(features, answers)
    w = np.stack(np.meshgrid(*[np.linspace(-40, 40, 401)] * 2), -1).reshape(-1, 2)
    x = np.array([(features[a.first] - features[a.second]) / model.scale * (2 * a.prefers_first - 1) for a in answers])
    evidence = []
    for prior in (0.1, 0.3, 1.0, 3.0, 10.0):
        density = np.exp(-0.5 * (w**2).sum(1) / prior**2)
        evidence.append(density @ np.exp(-np.logaddexp(0, -w @ x.T).sum(1)) / density.sum())
    assert np.log(model.odds) == pytest.approx(np.log(np.mean(evidence) * 2**10), abs=0.3)


def test_features_of_a_trajectory_are_those_of_its_steps():
    steps = StepFeatures(DOME)
    order = [3, 17, 30]
    expected = steps.actions([])[3] + steps.actions([3])[17] + steps.actions([3, 17])[30]
    np.testing.assert_allclose(steps.trajectory(order), expected)
    again = steps.actions([3])[3]
    assert np.abs(again[GEOMETRY.index("first view within 0.5 rad")]) < 1e-12 and again[GEOMETRY.index("way")] == 0
    far = int(np.argmax(travel_m(DOME, 3)))
    assert steps.actions([3])[far, GEOMETRY.index("first view within 0.5 rad")] > 0


FEATURES = np.random.default_rng(0).normal(size=(20, 4))
ORDERS = tuple((k, k + 1) for k in range(20))
NEW = PreferenceSession("tile", ORDERS, FEATURES, wanted=24, seed=3)


def by_taste(session, answers):
    """Answered by who prefers the first feature."""
    for _ in range(answers):
        q = session.question
        better = FEATURES[q.left, 0] > FEATURES[q.right, 0]
        session = session.answered("left" if better else "right")
    return session


def read(session):
    return json.dumps(session.as_json()).encode()


def test_every_sixth_question_repeats_an_earlier_pair_with_its_sides_swapped():
    done = by_taste(NEW, 24)
    repeats = [k for k, a in enumerate(done.answers) if a.repeats is not None]
    assert repeats == [5, 11, 17, 23]
    of = [done.answers[k].repeats for k in repeats]
    assert len(set(of)) == 4 and all(k - j > 2 and done.answers[j].repeats is None for k, j in zip(repeats, of))
    for k, j in zip(repeats, of):
        now, before = done.answers[k], done.answers[j]
        assert (now.left, now.right) == (before.right, before.left)
    assert done.agreement == (4, 4)
    refused(ViewpointError, "all questions are answered", done.answered, "left")


def test_agreement_is_of_the_pair_and_not_of_the_side():
    for choice, expected in (("left", (0, 4)), ("neither", (4, 4))):
        session = NEW
        for _ in range(24):
            session = session.answered(choice)
        assert session.agreement == expected and not session.model.knows


def test_undo_takes_back_one_answer_and_asks_the_same_again():
    seven = by_taste(NEW, 7)
    assert seven.undone() == by_taste(NEW, 6) and NEW.undone().answers == ()
    last = seven.answers[-1]
    assert seven.undone().question == Question(last.left, last.right, last.repeats)
    assert seven.undone().undone().question.repeats is not None  # the sixth was a repeat, and is again


def test_a_session_goes_on_where_its_file_ends():
    part = by_taste(NEW, 8)
    again = NEW.imported(read(part))
    assert again.answers == part.answers and by_taste(again, 16).answers == by_taste(NEW, 24).answers
    # The file's own seed: what was asked there is asked again after an undo.
    other = PreferenceSession("tile", ORDERS, FEATURES, 24, seed=9).imported(read(part))
    assert other.question == part.question and other.undone().question == part.undone().question


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.update(version=2), "version"),
        (lambda f: f.update(made_of="of other pictures"), "other reconstructions"),
        (lambda f: f["answers"][2].update(left=len(ORDERS), right=0), f"answer 2: {len(ORDERS)} and 0"),
        (lambda f: f["answers"][2].update(left=0, right=len(ORDERS)), f"answer 2: 0 and {len(ORDERS)}"),
        (lambda f: f["answers"][2].update(left=-1, right=0), "answer 2: -1 and 0"),
        (lambda f: f["answers"][2].update(left=1, right=1), "no pair"),
        (lambda f: f["answers"][2].update(repeats=2), "answer 2: does not repeat answer 2"),
        (lambda f: f["answers"][2].update(by="simulated expert (edges)"), "they are not mixed"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(change, said):
    file = json.loads(read(by_taste(NEW, 8)))
    change(file)
    refused(ViewpointError, said, NEW.imported, json.dumps(file).encode())
    for data in (b"\xff\xfe", b"[" * 100_000):
        refused(ViewpointError, "not a file of answers", NEW.imported, data)


def test_neither_is_half_a_vote_for_each():
    """It says that both are alike: as one vote for each would, at half their weight (4.13)."""
    lean = fit_reward(FEATURES, [Answer(0, 1, True)] * 4)
    alike = fit_reward(FEATURES, [Answer(0, 1, True)] * 4 + [Answer(0, 1, None)] * 8)
    lead = [float(np.subtract(*m.reward(FEATURES)[:2])) for m in (lean, alike)]
    assert 0.0 < lead[1] < lead[0] and alike.odds < lean.odds
    nothing = fit_reward(FEATURES, [Answer(0, 1, None)] * 8)
    both = fit_reward(FEATURES, [Answer(0, 1, True), Answer(0, 1, False)] * 4)
    np.testing.assert_allclose([nothing.weights, both.weights], 0.0, atol=1e-9)
    assert nothing.odds < 1.0 < lean.odds
