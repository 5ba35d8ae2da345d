"""A session of comparisons: repeats, undo, resumption, import and export, and what contradictions come to."""

from __future__ import annotations

import json

import numpy as np
import pytest

from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.preference_model import Answer, fit_reward
from edge_server.viewpoints.preference_session import REPEAT_EVERY, PreferenceSession, Question

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
    assert done.question is None
    repeats = [k for k, a in enumerate(done.answers) if a.repeats is not None]
    assert repeats == [5, 11, 17, 23] == list(range(REPEAT_EVERY - 1, 24, REPEAT_EVERY))
    of = [done.answers[k].repeats for k in repeats]
    assert len(set(of)) == 4 and all(k - j > 2 and done.answers[j].repeats is None for k, j in zip(repeats, of))
    for k, j in zip(repeats, of):
        now, before = done.answers[k], done.answers[j]
        assert (now.left, now.right) == (before.right, before.left)
    assert done.agreement == (4, 4)
    with pytest.raises(ViewpointError, match="all questions are answered"):
        done.answered("left")


def test_agreement_is_of_the_pair_and_not_of_the_side():
    for choice, expected in (("left", (0, 4)), ("neither", (4, 4))):
        session = NEW
        for _ in range(24):
            session = session.answered(choice)
        assert session.agreement == expected
        assert not session.model.knows and "it does not know" in session.model.says()


def test_undo_takes_back_one_answer_and_asks_the_same_again():
    seven = by_taste(NEW, 7)
    assert seven.undone() == by_taste(NEW, 6) and NEW.undone().answers == ()
    last = seven.answers[-1]
    assert seven.undone().question == Question(last.left, last.right, last.repeats)
    assert seven.undone().undone().question.repeats is not None  # the sixth was a repeat, and is again
    assert seven.undone().model.answers == 6


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
        (lambda f: f.update(more=1), "unknown field `more`"),
        (lambda f: f.update(scenario="cell"), "other reconstructions"),
        (lambda f: f.update(made_of="of other pictures"), "other reconstructions"),
        (lambda f: f["answers"][2].update(choice="both"), r"answers\[2\].choice"),
        (lambda f: f["answers"][2].update(left=20), "answer 2: 20 and"),
        (lambda f: f["answers"][2].update(left=1, right=1), "no pair"),
        (lambda f: f["answers"][2].update(repeats=2), "answer 2: does not repeat answer 2"),
        (lambda f: f["answers"][2].update(by="simulated expert (edges)"), "they are not mixed"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(change, said):
    file = json.loads(read(by_taste(NEW, 8)))
    change(file)
    with pytest.raises(ViewpointError, match=said) as refused:
        NEW.imported(json.dumps(file).encode())
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("data", [b"{", b"\xff\xfe", b"[" * 100_000])
def test_what_is_no_file_of_answers_is_refused(data):
    with pytest.raises(ViewpointError, match="not a file of answers"):
        NEW.imported(data)


def test_neither_is_half_a_vote_for_each():
    """It says that both are alike: as one vote for each would, at half their weight (4.13)."""
    first, second = np.array([0]), np.array([1])
    lean = fit_reward(FEATURES, [Answer(0, 1, True)] * 4)
    alike = fit_reward(FEATURES, [Answer(0, 1, True)] * 4 + [Answer(0, 1, None)] * 8)
    p = [m.probability(FEATURES, first, second)[0] for m in (lean, alike)]
    assert 0.5 < p[1] < p[0] and alike.odds < lean.odds
    nothing = fit_reward(FEATURES, [Answer(0, 1, None)] * 8)
    both = fit_reward(FEATURES, [Answer(0, 1, True), Answer(0, 1, False)] * 4)
    np.testing.assert_allclose(nothing.mean, 0.0, atol=1e-9)
    np.testing.assert_allclose(nothing.covariance, both.covariance, rtol=1e-6)
    assert nothing.odds < 1.0
